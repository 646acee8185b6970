//! The matrix product under every layer.
//!
//! Each element of the result is one chain of fused multiply-adds over the inner index in rising order, whatever the
//! blocking and the instruction set: the same bytes on every machine. Where there is no such instruction (x86-64 before
//! 2013) it is a library call: the same bytes, slowly.

/// A matrix inside a slice: element `(row, column)` is at `row * rows + column * columns`.
#[derive(Clone, Copy, Debug)]
pub struct Strided<'a> {
    /// The numbers.
    pub data: &'a [f32],
    /// Distance between rows.
    pub rows: usize,
    /// Distance between columns.
    pub columns: usize,
}

impl<'a> Strided<'a> {
    /// A row-major matrix whose rows have `width` numbers.
    pub fn of(data: &'a [f32], width: usize) -> Strided<'a> {
        Strided { data, rows: width, columns: 1 }
    }

    /// The transpose of a row-major matrix whose rows have `width` numbers.
    pub fn transposed(data: &'a [f32], width: usize) -> Strided<'a> {
        Strided { data, rows: 1, columns: width }
    }
}

/// Rows computed together: with 32 columns (AVX-512) or 16 (AVX2) twelve registers of sums, which is enough to hide
/// the instruction's latency.
const ROWS: usize = 6;
/// Columns of the narrowest block that is computed in vectors; rests are filled up to it.
const NARROW: usize = 16;

/// `out = a b`, or `out += a b` with `add`, for `a` of `rows` x `inner` and `b` of `inner` x `columns` with rows
/// `b_width` apart; rows of `out` are `out_width` apart.
///
/// # Panics
/// If a slice is too short for its matrix.
pub fn product(
    a: Strided,
    (b, b_width): (&[f32], usize),
    [rows, inner, columns]: [usize; 3],
    (out, out_width): (&mut [f32], usize),
    add: bool,
) {
    if rows == 0 || columns == 0 {
        return;
    }
    assert!(out_width >= columns && out.len() >= (rows - 1) * out_width + columns, "result: length");
    if inner > 0 {
        assert!(a.data.len() > (rows - 1) * a.rows + (inner - 1) * a.columns, "left matrix: length");
        assert!(b_width >= columns && b.len() >= (inner - 1) * b_width + columns, "right matrix: length");
    }
    let vectors = columns / NARROW * NARROW;
    let call = Call { a, b, b_width, rows, inner, columns: vectors, out_width, add };
    if vectors > 0 {
        run(call, out);
    }
    if vectors < columns {
        // The rest as a block of its own, filled up with zeros.
        let rest = columns - vectors;
        let mut filled = vec![0.0; inner * NARROW];
        for (to, k) in filled.chunks_exact_mut(NARROW).zip(0..inner) {
            to[..rest].copy_from_slice(&b[k * b_width + vectors..][..rest]);
        }
        let mut sums = vec![0.0; rows * NARROW];
        if add {
            for (to, r) in sums.chunks_exact_mut(NARROW).zip(0..rows) {
                to[..rest].copy_from_slice(&out[r * out_width + vectors..][..rest]);
            }
        }
        let b = &filled;
        run(Call { b, b_width: NARROW, columns: NARROW, out_width: NARROW, ..call }, &mut sums);
        for (from, r) in sums.chunks_exact(NARROW).zip(0..rows) {
            out[r * out_width + vectors..][..rest].copy_from_slice(&from[..rest]);
        }
    }
}

#[derive(Clone, Copy)]
struct Call<'a> {
    a: Strided<'a>,
    b: &'a [f32],
    b_width: usize,
    rows: usize,
    inner: usize,
    /// A multiple of [`NARROW`].
    columns: usize,
    out_width: usize,
    add: bool,
}

/// Vectors of one instruction set.
///
/// # Safety
/// The functions may be called only where the machine has the instruction set.
trait Vectors {
    /// A register.
    type V: Copy;
    /// Numbers in a register.
    const LANES: usize;
    unsafe fn load(from: *const f32) -> Self::V;
    unsafe fn store(to: *mut f32, v: Self::V);
    unsafe fn splat(v: f32) -> Self::V;
    unsafe fn multiply_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
}

/// No vectors: numbers side by side.
struct ScalarVectors;

impl Vectors for ScalarVectors {
    type V = [f32; 8];
    const LANES: usize = 8;
    #[inline(always)]
    unsafe fn load(from: *const f32) -> [f32; 8] {
        // SAFETY: the caller vouches for eight numbers.
        unsafe { from.cast::<[f32; 8]>().read_unaligned() }
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, v: [f32; 8]) {
        // SAFETY: the caller vouches for space for eight numbers.
        unsafe { to.cast::<[f32; 8]>().write_unaligned(v) }
    }
    #[inline(always)]
    unsafe fn splat(v: f32) -> [f32; 8] {
        [v; 8]
    }
    #[inline(always)]
    unsafe fn multiply_add(a: [f32; 8], b: [f32; 8], c: [f32; 8]) -> [f32; 8] {
        std::array::from_fn(|l| a[l].mul_add(b[l], c[l]))
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::Vectors;
    use std::arch::x86_64::*;

    macro_rules! vectors {
        ($name:ident, $v:ty, $lanes:literal, $load:ident, $store:ident, $splat:ident, $fma:ident) => {
            pub(super) struct $name;

            impl Vectors for $name {
                type V = $v;
                const LANES: usize = $lanes;
                #[inline(always)]
                unsafe fn load(from: *const f32) -> $v {
                    // SAFETY: the caller vouches for a register's numbers and for the instruction set.
                    unsafe { $load(from) }
                }
                #[inline(always)]
                unsafe fn store(to: *mut f32, v: $v) {
                    // SAFETY: the caller vouches for a register's space and for the instruction set.
                    unsafe { $store(to, v) }
                }
                #[inline(always)]
                unsafe fn splat(v: f32) -> $v {
                    // SAFETY: the caller vouches for the instruction set.
                    unsafe { $splat(v) }
                }
                #[inline(always)]
                unsafe fn multiply_add(a: $v, b: $v, c: $v) -> $v {
                    // SAFETY: the caller vouches for the instruction set.
                    unsafe { $fma(a, b, c) }
                }
            }
        };
    }
    vectors!(Avx512, __m512, 16, _mm512_loadu_ps, _mm512_storeu_ps, _mm512_set1_ps, _mm512_fmadd_ps);
    vectors!(Avx2, __m256, 8, _mm256_loadu_ps, _mm256_storeu_ps, _mm256_set1_ps, _mm256_fmadd_ps);
}

/// An instruction set's `blocks`.
type Blocks = unsafe fn(Call, &mut [f32]);

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn avx512(call: Call, out: &mut [f32]) {
    // SAFETY: this function runs only where the instruction set is.
    unsafe { blocks::<x86::Avx512, 2, 1>(call, out) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(call: Call, out: &mut [f32]) {
    // SAFETY: this function runs only where the instruction set is.
    unsafe { blocks::<x86::Avx2, 2, 2>(call, out) }
}

fn plain(call: Call, out: &mut [f32]) {
    // SAFETY: every machine has plain numbers.
    unsafe { blocks::<ScalarVectors, 2, 2>(call, out) }
}

/// The instruction sets of this machine, the widest first.
fn available() -> impl Iterator<Item = Blocks> {
    #[cfg(target_arch = "x86_64")]
    let wide = {
        let fma = is_x86_feature_detected!("fma");
        [
            (fma && is_x86_feature_detected!("avx512f"), avx512 as Blocks),
            (fma && is_x86_feature_detected!("avx2"), avx2 as Blocks),
        ]
    };
    #[cfg(not(target_arch = "x86_64"))]
    let wide: [(bool, Blocks); 0] = [];
    wide.into_iter().filter(|(is_there, _)| *is_there).map(|(_, blocks)| blocks).chain([plain as Blocks])
}

/// Runs `blocks` in the widest instruction set of this machine.
fn run(call: Call, out: &mut [f32]) {
    let widest = available().next().expect("plain numbers are always there");
    // SAFETY: the instruction set was just found on this machine.
    unsafe { widest(call, out) }
}

/// The product, block by block: `W` registers wide, and where that does not fit `N`, which is [`NARROW`] numbers.
///
/// # Safety
/// The machine has `V`, and `product` has checked the lengths.
#[inline(always)]
unsafe fn blocks<V: Vectors, const W: usize, const N: usize>(call: Call, out: &mut [f32]) {
    const { assert!(V::LANES * N == NARROW) };
    let mut column = 0;
    while column < call.columns {
        let wide = call.columns - column >= V::LANES * W;
        let mut row = 0;
        while row < call.rows {
            let high = call.rows - row >= ROWS;
            // SAFETY: rows, columns and inner indices are within what `product` checked.
            unsafe {
                match (high, wide) {
                    (true, true) => block::<V, ROWS, W>(call, row, column, out),
                    (true, false) => block::<V, ROWS, N>(call, row, column, out),
                    (false, true) => block::<V, 1, W>(call, row, column, out),
                    (false, false) => block::<V, 1, N>(call, row, column, out),
                }
            }
            row += if high { ROWS } else { 1 };
        }
        column += V::LANES * if wide { W } else { N };
    }
}

/// `R` rows and `W` registers of columns.
///
/// # Safety
/// As for [`blocks`].
#[inline(always)]
unsafe fn block<V: Vectors, const R: usize, const W: usize>(
    call: Call,
    row: usize,
    column: usize,
    out: &mut [f32],
) {
    // SAFETY: the caller vouches for the instruction set and for all indices.
    unsafe {
        let a = call.a.data.as_ptr().wrapping_add(row * call.a.rows);
        let b = call.b.as_ptr().wrapping_add(column);
        let out = out.as_mut_ptr().add(row * call.out_width + column);
        let mut sums = [[V::splat(0.0); W]; R];
        if call.add {
            for r in 0..R {
                for w in 0..W {
                    sums[r][w] = V::load(out.add(r * call.out_width + w * V::LANES));
                }
            }
        }
        for k in 0..call.inner {
            let (a, b) = (a.add(k * call.a.columns), b.add(k * call.b_width));
            let mut right = [V::splat(0.0); W];
            for w in 0..W {
                right[w] = V::load(b.add(w * V::LANES));
            }
            for r in 0..R {
                let left = V::splat(*a.add(r * call.a.rows));
                for w in 0..W {
                    sums[r][w] = V::multiply_add(left, right[w], sums[r][w]);
                }
            }
        }
        for r in 0..R {
            for w in 0..W {
                V::store(out.add(r * call.out_width + w * V::LANES), sums[r][w]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::noise::Noise;

    #[test]
    fn agrees_with_f64_at_odd_sizes_and_strides() {
        let mut noise = Noise(1);
        let sizes =
            [(1, 1, 1), (6, 16, 16), (7, 3, 17), (13, 65, 49), (13, 0, 5), (0, 4, 4), (5, 4, 0), (8, 5, 32)];
        for (m, k, n) in sizes {
            for (turned, add) in [(false, false), (true, true)] {
                let (a, b) = (noise.vec(m * k), noise.vec(k * (n + 3)));
                let before = noise.vec(m * (n + 2));
                let mut out = before.clone();
                let left = if turned { Strided::transposed(&a, m) } else { Strided::of(&a, k) };
                product(left, (&b, n + 3), [m, k, n], (&mut out, n + 2), add);
                for i in 0..m {
                    for j in 0..n + 2 {
                        let at = i * (n + 2) + j;
                        let left = |l: usize| f64::from(if turned { a[l * m + i] } else { a[i * k + l] });
                        let sum: f64 = (0..k).map(|l| left(l) * f64::from(b[l * (n + 3) + j])).sum();
                        let exact = match j < n {
                            true => sum + if add { f64::from(before[at]) } else { 0.0 },
                            false => f64::from(before[at]),
                        };
                        assert!((f64::from(out[at]) - exact).abs() < 1e-4, "{m} {k} {n}: {i} {j}");
                    }
                }
            }
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_bytes() {
        let mut noise = Noise(2);
        assert!(available().count() >= 1);
        for (rows, inner, columns, add) in [
            (1, 7, 16, false),
            (6, 64, 32, true),
            (13, 33, 48, false),
            (20, 1, 80, true),
            (7, 300, 112, false),
        ] {
            let (left, b) = (noise.vec(rows * inner), noise.vec(inner * columns));
            let before = noise.vec(rows * columns);
            let a = Strided::of(&left, inner);
            let call = Call { a, b: &b, b_width: columns, rows, inner, columns, out_width: columns, add };
            let mut wanted = before.clone();
            plain(call, &mut wanted);
            for blocks in available() {
                let mut got = before.clone();
                // SAFETY: this machine has the instruction set, and the slices hold what the call says.
                unsafe { blocks(call, &mut got) };
                let same = got.iter().zip(&wanted).all(|(g, w)| g.to_bits() == w.to_bits());
                assert!(same, "{rows} x {inner} x {columns}");
            }
        }
    }
}
