//! The one dense kernel that compression and the losses need: a matrix product.

use rayon::prelude::*;

/// Rows computed together: with 16 columns, as many sums as the registers hold.
const ROWS: usize = 6;
/// Columns computed together: one AVX-512 register, two of AVX2.
const LANES: usize = 16;
/// Rows per task. Fixed, so that the result does not depend on the number of threads.
const TASK: usize = 8 * ROWS;

/// `out = a b` with `a` of `rows` x `inner`, `b` of `inner` x `columns`, all row-major. Every sum runs over
/// `inner` in order, whatever the blocking.
pub(crate) fn matmul(a: &[f32], b: &[f32], rows: usize, inner: usize, columns: usize, out: &mut [f32]) {
    assert_eq!((a.len(), b.len(), out.len()), (rows * inner, inner * columns, rows * columns));
    if columns == 0 {
        return;
    }
    let task = |(t, out): (usize, &mut [f32])| {
        let first = t * TASK;
        block(&a[first * inner..(first + out.len() / columns) * inner], b, inner, columns, out);
    };
    if rows * inner * columns < 1 << 16 {
        out.chunks_mut(TASK * columns).enumerate().for_each(task);
    } else {
        out.par_chunks_mut(TASK * columns).enumerate().for_each(task);
    }
}

/// `row-major [rows][columns]` to `[columns][rows]`.
pub(crate) fn transpose(a: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    let mut out = vec![0.0; a.len()];
    for (j, out) in out.chunks_exact_mut(rows.max(1)).enumerate() {
        for (i, out) in out.iter_mut().enumerate() {
            *out = a[i * columns + j];
        }
    }
    out
}

/// Runs `block_body` in the widest instruction set of this machine.
fn block(a: &[f32], b: &[f32], inner: usize, columns: usize, out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f,fma")]
        fn avx512(a: &[f32], b: &[f32], inner: usize, columns: usize, out: &mut [f32]) {
            block_body::<true>(a, b, inner, columns, out);
        }
        #[target_feature(enable = "avx2,fma")]
        fn avx2(a: &[f32], b: &[f32], inner: usize, columns: usize, out: &mut [f32]) {
            block_body::<true>(a, b, inner, columns, out);
        }
        if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("fma") {
            // SAFETY: the instruction sets were just found on this machine.
            return unsafe { avx512(a, b, inner, columns, out) };
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            // SAFETY: the instruction sets were just found on this machine.
            return unsafe { avx2(a, b, inner, columns, out) };
        }
    }
    block_body::<{ cfg!(target_arch = "aarch64") }>(a, b, inner, columns, out);
}

#[inline(always)]
fn block_body<const FMA: bool>(a: &[f32], b: &[f32], inner: usize, columns: usize, out: &mut [f32]) {
    let rows = out.len() / columns;
    let mut row = 0;
    while row + ROWS <= rows {
        rows_body::<FMA, ROWS>(&a[row * inner..], b, inner, columns, &mut out[row * columns..]);
        row += ROWS;
    }
    while row < rows {
        rows_body::<FMA, 1>(&a[row * inner..], b, inner, columns, &mut out[row * columns..]);
        row += 1;
    }
}

#[inline(always)]
fn rows_body<const FMA: bool, const R: usize>(
    a: &[f32],
    b: &[f32],
    inner: usize,
    columns: usize,
    out: &mut [f32],
) {
    let mut column = 0;
    while column + LANES <= columns {
        let mut sum = [[0.0f32; LANES]; R];
        for k in 0..inner {
            let b: &[f32; LANES] = b[k * columns + column..][..LANES].try_into().expect("LANES long");
            for r in 0..R {
                let a = a[r * inner + k];
                for l in 0..LANES {
                    sum[r][l] = multiply_add::<FMA>(a, b[l], sum[r][l]);
                }
            }
        }
        for r in 0..R {
            out[r * columns + column..][..LANES].copy_from_slice(&sum[r]);
        }
        column += LANES;
    }
    for column in column..columns {
        for r in 0..R {
            let mut sum = 0.0;
            for k in 0..inner {
                sum = multiply_add::<FMA>(a[r * inner + k], b[k * columns + column], sum);
            }
            out[r * columns + column] = sum;
        }
    }
}

/// Without the instruction, `mul_add` would be a library call.
#[inline(always)]
fn multiply_add<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    #[test]
    fn agrees_with_f64_at_odd_sizes() {
        let mut random = Random::new(1);
        for (m, k, n) in [(1, 1, 1), (6, 16, 16), (7, 3, 17), (100, 65, 33), (13, 0, 5), (0, 4, 4), (5, 4, 0)]
        {
            let a: Vec<f32> = (0..m * k).map(|_| random.normal()).collect();
            let b: Vec<f32> = (0..k * n).map(|_| random.normal()).collect();
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
