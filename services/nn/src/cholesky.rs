//! Small dense systems of equations.

/// Solves a symmetric positive system for several right sides by Cholesky's factorisation.
pub fn solve<const N: usize, const M: usize>(mut a: [[f64; N]; N], mut b: [[f64; M]; N]) -> [[f64; M]; N] {
    for j in 0..N {
        for k in 0..j {
            for i in j..N {
                a[i][j] -= a[i][k] * a[j][k];
            }
        }
        let pivot = a[j][j].max(1e-12).sqrt();
        for i in j..N {
            a[i][j] /= pivot;
        }
        a[j][j] = pivot;
    }
    for c in 0..M {
        for i in 0..N {
            for k in 0..i {
                b[i][c] -= a[i][k] * b[k][c];
            }
            b[i][c] /= a[i][i];
        }
        for i in (0..N).rev() {
            for k in i + 1..N {
                b[i][c] -= a[k][i] * b[k][c];
            }
            b[i][c] /= a[i][i];
        }
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_system_is_solved_for_every_right_side() {
        let a = [[4.0, 2.0, 0.6], [2.0, 3.0, -0.4], [0.6, -0.4, 2.0]];
        let x = [[1.0, -2.0], [0.5, 3.0], [-1.5, 0.25]];
        let mut b = [[0.0; 2]; 3];
        for i in 0..3 {
            for c in 0..2 {
                b[i][c] = (0..3).map(|k| a[i][k] * x[k][c]).sum();
            }
        }
        let solved = solve(a, b);
        for (row, wanted) in solved.iter().flatten().zip(x.iter().flatten()) {
            assert!((row - wanted).abs() < 1e-12, "{row} for {wanted}");
        }
    }
}
