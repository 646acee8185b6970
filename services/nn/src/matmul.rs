//! Whole matrices, row-major.

use crate::product::{Strided, product};
use rayon::prelude::*;

/// Rows per task. Fixed, so that the result does not depend on the number of threads.
const TASK: usize = 48;

/// `out = a b` with `a` of `rows` x `inner`, `b` of `inner` x `columns`, all row-major. Every sum runs over
/// `inner` in order, whatever the blocking and the number of threads.
///
/// # Panics
/// If a slice is not as long as its matrix.
pub fn matmul(a: &[f32], b: &[f32], rows: usize, inner: usize, columns: usize, out: &mut [f32]) {
    assert_eq!((a.len(), b.len(), out.len()), (rows * inner, inner * columns, rows * columns));
    if columns == 0 {
        return;
    }
    let task = |(t, out): (usize, &mut [f32])| {
        let first = t * TASK;
        let rows = out.len() / columns;
        let left = Strided::of(&a[first * inner..(first + rows) * inner], inner);
        product(left, (b, columns), [rows, inner, columns], (out, columns), false);
    };
    if rows * inner * columns < 1 << 16 {
        out.chunks_mut(TASK * columns).enumerate().for_each(task);
    } else {
        out.par_chunks_mut(TASK * columns).enumerate().for_each(task);
    }
}

/// `[rows][columns]` to `[columns][rows]`.
pub fn transpose(a: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    let mut out = vec![0.0; a.len()];
    for (j, out) in out.chunks_exact_mut(rows.max(1)).enumerate() {
        for (i, out) in out.iter_mut().enumerate() {
            *out = a[i * columns + j];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::Noise;

    #[test]
    fn agrees_with_f64_at_odd_sizes() {
        let mut random = Noise(1);
        for (m, k, n) in [(1, 1, 1), (6, 16, 16), (7, 3, 17), (100, 65, 33), (13, 0, 5), (0, 4, 4), (5, 4, 0)]
        {
            let a: Vec<f32> = random.vec(m * k);
            let b: Vec<f32> = random.vec(k * n);
            let mut out = vec![f32::NAN; m * n];
            matmul(&a, &b, m, k, n, &mut out);
            for i in 0..m {
                for j in 0..n {
                    let exact: f64 = (0..k).map(|l| f64::from(a[i * k + l]) * f64::from(b[l * n + j])).sum();
                    assert!((f64::from(out[i * n + j]) - exact).abs() < 1e-4, "{m} {k} {n}");
                }
            }
            assert_eq!(transpose(&transpose(&a, m, k), k, m), a);
        }
    }
}
