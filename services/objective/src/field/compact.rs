//! The compactness loss (method, section 4; paper Eq. 11-13 with its sign set right).
//!
//! For pixels p, q with features F and mask sets m: `S = |m_p and m_q| / (|m_p or m_q| + 1e-5)`,
//! `C = max(0, cos(F_p, F_q))`. Minimised: `mean(-S C)` over pairs with S > 0 plus `mean(C)` over pairs with
//! S = 0. The paper's sign would pull apart what shares a mask. Pairs of a pixel with itself do not count:
//! their cosine is 1 whatever the features.

use super::Membership;
use segwild_nn::{matmul, transpose};

/// Features shorter than this have no direction and take no part.
pub const SHORTEST: f32 = 1e-6;
/// Pairs summed side by side, so that the compiler may use SIMD.
const LANES: usize = 8;

/// The loss over one sample of pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Compactness {
    /// The loss, in [-1, 1]: -1 when the features within masks are alike and those across are at right angles.
    pub loss: f32,
    /// Mean of `C` over pairs whose mask sets are equal or nested or overlap (S > 0).
    pub within: f32,
    /// Mean of `C` over pairs that share no mask.
    pub across: f32,
}

/// The loss over pixels with `features` (`[pixel][channel]`, flat) and their `groups` in `membership`; pixels
/// in no group take no part. Writes the gradient with respect to the features to `grad`.
pub fn compactness(
    features: &[f32],
    channels: usize,
    groups: &[u32],
    membership: &Membership,
    grad: &mut [f32],
) -> Compactness {
    assert_eq!((features.len(), grad.len()), (groups.len() * channels, groups.len() * channels));
    grad.fill(0.0);
    // Unit features of the pixels that take part, ordered by group so that S is constant over runs of pairs.
    let length = |p: usize| {
        let f = &features[p * channels..(p + 1) * channels];
        f.iter().map(|v| v * v).sum::<f32>().sqrt()
    };
    let mut pixels: Vec<(u32, usize, f32)> = groups
        .iter()
        .enumerate()
        .map(|(p, &g)| (g, p, length(p)))
        .filter(|&(g, _, length)| g != Membership::NONE && length > SHORTEST && length.is_finite())
        .collect();
    pixels.sort_by_key(|&(g, p, _)| (g, p));
    let runs: Vec<&[(u32, usize, f32)]> = pixels.chunk_by(|a, b| a.0 == b.0).collect();
    let n = pixels.len();
    let mut units = Vec::with_capacity(n * channels);
    for &(_, p, length) in &pixels {
        units.extend(features[p * channels..(p + 1) * channels].iter().map(|v| v / length));
    }

    // Ordered pairs of both kinds, without p = q.
    let g = runs.len();
    let mut similar = vec![0.0; g * g];
    let (mut near, mut far) = (0u64, 0u64);
    for (i, a) in runs.iter().enumerate() {
        for (j, b) in runs.iter().enumerate().take(i + 1) {
            let s = membership.similarity(a[0].0, b[0].0);
            (similar[i * g + j], similar[j * g + i]) = (s, s);
            let pairs = if i == j { a.len() * (a.len() - 1) } else { 2 * a.len() * b.len() } as u64;
            if s > 0.0 { near += pairs } else { far += pairs }
        }
    }
    let (per_near, per_far) = (1.0 / near.max(1) as f64, 1.0 / far.max(1) as f64);

    // Cosines of all pairs, turned in place into dL/dC where C > 0. Pixels of a group share their weights.
    let mut pairs = vec![0.0; n * n];
    matmul(&units, &transpose(&units, n, channels), n, channels, n, &mut pairs);
    let (mut total, mut row, mut weights) = (PairSums::default(), 0, vec![0.0; n]);
    for (i, a) in runs.iter().enumerate() {
        let mut start = 0;
        for (b, &s) in runs.iter().zip(&similar[i * g..(i + 1) * g]) {
            let weight = if s > 0.0 { -f64::from(s) * per_near } else { per_far };
            weights[start..start + b.len()].fill(weight as f32);
            start += b.len();
        }
        for _ in 0..a.len() {
            let line = &mut pairs[row * n..(row + 1) * n];
            line[row] = 0.0;
            total.add(line, &weights);
            row += 1;
        }
    }

    // Each unordered pair was counted twice, so dL/du_p = 2 sum_q (dL/dC_pq) u_q.
    let mut unit_grads = vec![0.0; n * channels];
    matmul(&pairs, &units, n, n, channels, &mut unit_grads);
    for (i, &(_, p, length)) in pixels.iter().enumerate() {
        let (unit, unit_grad) = (&units[i * channels..][..channels], &unit_grads[i * channels..][..channels]);
        let along: f32 = unit.iter().zip(unit_grad).map(|(u, d)| u * d).sum();
        for ((g, d), u) in grad[p * channels..(p + 1) * channels].iter_mut().zip(unit_grad).zip(unit) {
            *g = 2.0 * (d - along * u) / length;
        }
    }
    Compactness {
        loss: total.loss as f32,
        within: (total.within * per_near) as f32,
        across: (total.across * per_far) as f32,
    }
}

/// Sums over pairs.
#[derive(Default)]
struct PairSums {
    loss: f64,
    within: f64,
    across: f64,
}

impl PairSums {
    /// Adds one pixel's cosines and replaces each by its weight where it is over 0 and by 0 elsewhere.
    fn add(&mut self, cosines: &mut [f32], weights: &[f32]) {
        let mut lanes = [[0.0f32; LANES]; 3];
        let (wide, rest) = cosines.as_chunks_mut::<LANES>();
        let (wide_weights, rest_weights) = weights.as_chunks::<LANES>();
        for (cosines, weights) in wide.iter_mut().zip(wide_weights) {
            PairSums::add_lanes(&mut lanes, cosines, weights);
        }
        if !rest.is_empty() {
            let (mut cosines, mut weights) = ([0.0; LANES], [0.0; LANES]);
            cosines[..rest.len()].copy_from_slice(rest);
            weights[..rest.len()].copy_from_slice(rest_weights);
            PairSums::add_lanes(&mut lanes, &mut cosines, &weights);
            rest.copy_from_slice(&cosines[..rest.len()]);
        }
        let sum = |lanes: [f32; LANES]| lanes.iter().map(|&v| f64::from(v)).sum::<f64>();
        self.loss += sum(lanes[0]);
        self.within += sum(lanes[1]);
        self.across += sum(lanes[2]);
    }

    #[inline(always)]
    fn add_lanes(lanes: &mut [[f32; LANES]; 3], cosines: &mut [f32; LANES], weights: &[f32; LANES]) {
        for l in 0..LANES {
            let (c, weight) = (cosines[l].max(0.0), weights[l]);
            lanes[0][l] += weight * c;
            lanes[1][l] += if weight < 0.0 { c } else { 0.0 };
            lanes[2][l] += if weight > 0.0 { c } else { 0.0 };
            cosines[l] = if c > 0.0 { weight } else { 0.0 };
        }
    }
}
