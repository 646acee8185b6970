//! Eigenvalues and -vectors of symmetric matrices: Householder's tridiagonal form, then implicit QL.

/// Eigenvalues in falling order and the unit eigenvectors, one per row, of a symmetric row-major `n` x `n`
/// matrix. Deterministic; each vector's largest component is positive.
pub fn symmetric(mut a: Vec<f64>, n: usize) -> (Vec<f64>, Vec<f64>) {
    assert_eq!(a.len(), n * n, "a square matrix");
    let mut q = vec![0.0; n * n];
    for i in 0..n {
        q[i * n + i] = 1.0;
    }
    let (mut d, mut e) = (vec![0.0; n], vec![0.0; n]);
    tridiagonal(&mut a, n, &mut d, &mut e, &mut q);
    implicit_ql(&mut d, &mut e, &mut q, n);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&i, &j| d[j].total_cmp(&d[i]));
    let mut vectors = Vec::with_capacity(n * n);
    for &i in &order {
        let v = &q[i * n..(i + 1) * n];
        let largest = v.iter().copied().fold(0.0, |m: f64, x| if x.abs() > m.abs() { x } else { m });
        let sign = if largest < 0.0 { -1.0 } else { 1.0 };
        vectors.extend(v.iter().map(|x| sign * x));
    }
    (order.into_iter().map(|i| d[i]).collect(), vectors)
}

/// Reduces `a` to diagonal `d` and off-diagonal `e` (`e[i]` couples i and i + 1); the rows of `q` become the
/// basis in which `a` has that form.
fn tridiagonal(a: &mut [f64], n: usize, d: &mut [f64], e: &mut [f64], q: &mut [f64]) {
    // The reflections I - beta v v^T, to be multiplied out at the end.
    let mut reflections: Vec<(Vec<f64>, f64)> = Vec::with_capacity(n);
    for k in 0..n.saturating_sub(1) {
        let m = n - k - 1;
        let mut v: Vec<f64> = (0..m).map(|i| a[(k + 1 + i) * n + k]).collect();
        let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        // The sign that does not cancel.
        let alpha = if v[0] > 0.0 { -length } else { length };
        v[0] -= alpha;
        let square = v.iter().map(|x| x * x).sum::<f64>();
        let beta = if square > 0.0 { 2.0 / square } else { 0.0 };
        (d[k], e[k]) = (a[k * n + k], alpha);
        if beta > 0.0 {
            let sub = |i: usize| (k + 1 + i) * n + k + 1;
            let p: Vec<f64> = (0..m).map(|i| beta * dot(&a[sub(i)..][..m], &v)).collect();
            let half = 0.5 * beta * dot(&p, &v);
            let w: Vec<f64> = p.iter().zip(&v).map(|(p, v)| p - half * v).collect();
            for i in 0..m {
                let row = &mut a[sub(i)..][..m];
                for j in 0..m {
                    row[j] -= v[i] * w[j] + w[i] * v[j];
                }
            }
        }
        reflections.push((v, beta));
    }
    if n > 0 {
        d[n - 1] = a[n * n - 1];
    }
    // The basis is the columns of H0 H1 ..., which are the rows of its transpose ... H1 H0.
    for (k, (v, beta)) in reflections.iter().enumerate().rev() {
        for row in q.chunks_exact_mut(n) {
            let tail = &mut row[k + 1..];
            let s = beta * dot(tail, v);
            for (x, v) in tail.iter_mut().zip(v) {
                *x -= s * v;
            }
        }
    }
}

/// Diagonalises the tridiagonal matrix, turning the rows of `q` along.
fn implicit_ql(d: &mut [f64], e: &mut [f64], q: &mut [f64], n: usize) {
    let norm = d.iter().chain(e.iter()).fold(0.0f64, |m, x| m.max(x.abs()));
    for l in 0..n {
        // Two or three turns are usual; the bound only keeps poisoned input from hanging.
        for _ in 0..100 {
            let small = |i: usize| {
                e[i].abs() <= f64::EPSILON * (d[i].abs() + d[i + 1].abs()) || e[i].abs() <= 1e-30 * norm
            };
            let m = (l..n - 1).find(|&i| small(i)).unwrap_or(n - 1);
            if m == l {
                break;
            }
            let mut g = (d[l + 1] - d[l]) / (2.0 * e[l]);
            let mut r = g.hypot(1.0);
            g = d[m] - d[l] + e[l] / (g + r.copysign(g));
            let (mut s, mut c, mut p) = (1.0, 1.0, 0.0);
            let mut split = false;
            for i in (l..m).rev() {
                let (f, b) = (s * e[i], c * e[i]);
                r = f.hypot(g);
                e[i + 1] = r;
                if r == 0.0 {
                    d[i + 1] -= p;
                    e[m] = 0.0;
                    split = true;
                    break;
                }
                (s, c) = (f / r, g / r);
                g = d[i + 1] - p;
                r = (d[i] - g) * s + 2.0 * c * b;
                p = s * r;
                d[i + 1] = g + p;
                g = c * r - b;
                let (low, high) = q.split_at_mut((i + 1) * n);
                for (x, y) in low[i * n..].iter_mut().zip(&mut high[..n]) {
                    (*x, *y) = (c * *x - s * *y, s * *x + c * *y);
                }
            }
            if !split {
                d[l] -= p;
                e[l] = g;
                e[m] = 0.0;
            }
        }
    }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    // Four sums, so that the compiler may use SIMD.
    let mut sum = [0.0; 4];
    let (x, y) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = x.remainder().iter().zip(y.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in x.zip(y) {
        for i in 0..4 {
            sum[i] += a[i] * b[i];
        }
    }
    sum[0] + sum[1] + sum[2] + sum[3] + rest
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::Noise;

    fn check(a: &[f64], n: usize) -> Vec<f64> {
        let (values, vectors) = symmetric(a.to_vec(), n);
        let norm = a.iter().fold(1e-300f64, |m, x| m.max(x.abs())) * n as f64;
        for i in 0..n {
            let v = &vectors[i * n..(i + 1) * n];
            for j in 0..n {
                let product: f64 = dot(&a[j * n..(j + 1) * n], v);
                assert!((product - values[i] * v[j]).abs() <= 1e-12 * norm, "{n}: A v is not lambda v");
                let unit = dot(v, &vectors[j * n..(j + 1) * n]);
                assert!((unit - f64::from(u8::from(i == j))).abs() < 1e-11, "{n}: not orthonormal");
            }
            assert!(i == 0 || values[i - 1] >= values[i]);
        }
        values
    }

    #[test]
    fn decomposes_random_and_degenerate_matrices() {
        let mut noise = Noise(5);
        for n in [1, 2, 3, 7, 40, 130] {
            let m: Vec<f64> = (0..n * n).map(|_| f64::from(noise.next())).collect();
            let full: Vec<f64> = (0..n * n).map(|i| m[i] + m[(i % n) * n + i / n]).collect();
            check(&full, n);
            let scaled: Vec<f64> = full.iter().map(|x| x * 1e-20).collect();
            check(&scaled, n);
            check(&vec![0.0; n * n], n);
            let one: Vec<f64> = (0..n * n).map(|i| m[i / n] * m[i % n]).collect();
            let values = check(&one, n);
            assert!((values[0] - dot(&m[..n], &m[..n])).abs() < 1e-9 * values[0].max(1.0));
            let identity: Vec<f64> = (0..n * n).map(|i| f64::from(u8::from(i / n == i % n))).collect();
            assert!(check(&identity, n).iter().all(|v| (v - 1.0).abs() < 1e-12));
        }
        // Known: eigenvalues of the path graph's Laplacian.
        let n = 12usize;
        let path: Vec<f64> = (0..n * n)
            .map(|i| match (i / n, i % n) {
                (r, c) if r == c => 2.0 - f64::from(u8::from(r == 0 || r == n - 1)),
                (r, c) if r.abs_diff(c) == 1 => -1.0,
                _ => 0.0,
            })
            .collect();
        for (k, value) in check(&path, n).iter().rev().enumerate() {
            let exact = 2.0 - 2.0 * (std::f64::consts::PI * k as f64 / n as f64).cos();
            assert!((value - exact).abs() < 1e-12);
        }
    }

    #[test]
    fn poison_ends() {
        symmetric(vec![f64::NAN; 16], 4);
        symmetric(vec![f64::INFINITY; 16], 4);
        assert_eq!(symmetric(vec![], 0), (vec![], vec![]));
    }
}
