//! The inner loop of a click: cosines of many rows to a few queries, fused, in one pass over the rows.
//!
//! The loops are laid out for the compiler's vectoriser and compiled three times; no variant fuses
//! multiplications with additions or changes their order, so all give the same bytes.

/// Lanes of a dot product: sums are formed per lane and added in one fixed order.
const LANES: usize = 16;

/// Rows whose cosines are fused together.
const BLOCK: usize = 64;

/// Unit vectors to compare with.
#[derive(Clone, Copy, Debug)]
pub struct Queries<'a> {
    /// Numbers per row.
    pub channels: usize,
    /// The unit vectors.
    pub units: &'a [Vec<f32>],
    /// One over the temperature of the softmax.
    pub sharpness: f32,
}

/// Fused similarity of each row: `sum_i softmax_i(s_i sharpness) s_i` (paper, Eq. 27). `inverse_norms` has one number per
/// row; 0 makes the similarity 0 whatever the row holds.
pub fn score(queries: &Queries, values: &[f32], inverse_norms: &[f32], out: &mut [f32]) {
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            // SAFETY: the processor has AVX-512F.
            return unsafe { score_avx512(queries, values, inverse_norms, out) };
        }
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2.
            return unsafe { score_avx2(queries, values, inverse_norms, out) };
        }
    }
    score_plain(queries, values, inverse_norms, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn score_avx512(queries: &Queries, values: &[f32], inverse_norms: &[f32], out: &mut [f32]) {
    score_plain(queries, values, inverse_norms, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn score_avx2(queries: &Queries, values: &[f32], inverse_norms: &[f32], out: &mut [f32]) {
    score_plain(queries, values, inverse_norms, out);
}

#[inline(always)]
fn score_plain(queries: &Queries, values: &[f32], inverse_norms: &[f32], out: &mut [f32]) {
    // The usual widths have loops of their own, which the compiler unrolls.
    match queries.channels {
        16 => score_rows::<16>(queries, values, inverse_norms, out),
        32 => score_rows::<32>(queries, values, inverse_norms, out),
        64 => score_rows::<64>(queries, values, inverse_norms, out),
        128 => score_rows::<128>(queries, values, inverse_norms, out),
        _ => score_rows::<0>(queries, values, inverse_norms, out),
    }
}

/// `WIDTH` is the number of channels, or 0 for any.
#[inline(always)]
fn score_rows<const WIDTH: usize>(queries: &Queries, values: &[f32], inverse_norms: &[f32], out: &mut [f32]) {
    let channels = if WIDTH == 0 { queries.channels } else { WIDTH };
    let mut cosines = vec![[0.0f32; BLOCK]; queries.units.len()];
    for (block, out) in out.chunks_mut(BLOCK).enumerate() {
        let rows = &values[block * BLOCK * channels..][..out.len() * channels];
        let norms = &inverse_norms[block * BLOCK..][..out.len()];
        // The block stays in the nearest cache for all queries: memory is read once.
        for (unit, cosines) in queries.units.iter().zip(&mut cosines) {
            let unit = &unit[..channels];
            for ((row, &norm), cosine) in rows.chunks_exact(channels).zip(norms).zip(cosines.iter_mut()) {
                *cosine = if norm > 0.0 { (dot(unit, row) * norm).clamp(-1.0, 1.0) } else { 0.0 };
            }
        }
        match &cosines[..] {
            [only] => out.copy_from_slice(&only[..out.len()]),
            all => out.copy_from_slice(&fuse(all, queries.sharpness)[..out.len()]),
        }
    }
}

/// Dot product with a fixed order of additions.
#[inline(always)]
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = [0.0f32; LANES];
    for (x, y) in a.iter().zip(b) {
        for l in 0..LANES {
            lanes[l] += x[l] * y[l];
        }
    }
    let rest: f32 = a_rest.iter().zip(b_rest).map(|(x, y)| x * y).sum();
    let eight: [f32; 8] = std::array::from_fn(|l| lanes[l] + lanes[l + 8]);
    let four: [f32; 4] = std::array::from_fn(|l| eight[l] + eight[l + 4]);
    (four[0] + four[2]) + (four[1] + four[3]) + rest
}

#[inline(always)]
fn fuse(cosines: &[[f32; BLOCK]], sharpness: f32) -> [f32; BLOCK] {
    let mut top = [-1.0f32; BLOCK];
    for s in cosines {
        for r in 0..BLOCK {
            top[r] = top[r].max(s[r]);
        }
    }
    let (mut sum, mut weight) = ([0.0f32; BLOCK], [0.0f32; BLOCK]);
    for s in cosines {
        for r in 0..BLOCK {
            let w = exp_of_negative((s[r] - top[r]) * sharpness);
            weight[r] += w;
            sum[r] += w * s[r];
        }
    }
    for r in 0..BLOCK {
        sum[r] /= weight[r];
    }
    sum
}

/// `exp(x)` for `x <= 0` to 2e-7 of its value, without a call, so that it vectorises.
#[inline(always)]
fn exp_of_negative(x: f32) -> f32 {
    // Adding this leaves a whole number in the low bits of the mantissa.
    const WHOLE: f32 = 12_582_912.0;
    let y = x.max(-80.0) * std::f32::consts::LOG2_E;
    let shifted = y + WHOLE;
    let f = y - (shifted - WHOLE);
    // Taylor series of 2^f over [-1/2, 1/2].
    let p = 1.540_353e-4;
    let p = p * f + 1.333_355_8e-3;
    let p = p * f + 9.618_129e-3;
    let p = p * f + 5.550_411e-2;
    let p = p * f + 2.402_265e-1;
    let p = p * f + 6.931_472e-1;
    let p = p * f + 1.0;
    let power = shifted.to_bits().wrapping_sub(WHOLE.to_bits()).wrapping_add(127) << 23;
    p * f32::from_bits(power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_exp() {
        for i in 0..80_000 {
            let x = -(i as f32) * 1e-3;
            let want = f64::from(x).exp();
            assert!((f64::from(exp_of_negative(x)) / want - 1.0).abs() < 5e-6, "{x}");
        }
        assert!(exp_of_negative(-1e30) < 1e-30 && exp_of_negative(0.0) == 1.0);
    }

    #[test]
    fn every_instruction_set_gives_the_same_bytes() {
        let channels = 37;
        let values: Vec<f32> =
            (0..channels * 200).map(|i| ((i * 7919 % 1013) as f32 - 500.0) * 1e-3).collect();
        let norms = vec![0.1; 200];
        let units: Vec<Vec<f32>> =
            (0..6).map(|k| values[k * channels..(k + 1) * channels].to_vec()).collect();
        for count in 1..=6 {
            let queries = Queries { channels, units: &units[..count], sharpness: 7.0 };
            let (mut fast, mut plain) = (vec![0.0; 200], vec![0.0; 200]);
            score(&queries, &values, &norms, &mut fast);
            score_plain(&queries, &values, &norms, &mut plain);
            assert_eq!(fast, plain, "{count} clicks");
        }
    }
}
