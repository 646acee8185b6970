//! Granularity: the candidate levels around a click, nested sets, from fine to coarse.

use super::pool::RegionSet;

/// Shares of the photo between which levels lie, where there are such candidates.
const FINEST: f32 = 0.001;
const COARSEST: f32 = 0.75;
/// Least ratio of the areas of neighbouring levels: where that leaves fewer than [`ENOUGH`], the next ratio is tried.
const RATIOS: [f32; 4] = [1.5, 1.25, 1.1, 1.0];
/// Levels that are enough: as many as a person tries.
const ENOUGH: usize = 5;
/// Worth of an extra level, relative to that of the likeliest one (1).
const LEVEL: f32 = 0.08;

/// The nested sets around a click at pixel `at`, small to large, whose summed worth is highest: indices into `sets`.
pub(crate) fn candidate_levels(sets: &[RegionSet], at: [f32; 2]) -> Vec<usize> {
    let mut order: Vec<usize> =
        (0..sets.len()).filter(|&i| (FINEST..=COARSEST).contains(&sets[i].shape.share)).collect();
    if order.is_empty() {
        order = (0..sets.len()).collect();
    }
    order.sort_by(|&a, &b| sets[a].shape.share.total_cmp(&sets[b].shape.share).then(a.cmp(&b)));
    let likeness: Vec<f32> = order.iter().map(|&i| sets[i].shape.likeness(at)).collect();
    let best = likeness.iter().copied().fold(f32::MIN, f32::max);
    let worth: Vec<f32> =
        likeness.iter().map(|l| (l - best).exp() + LEVEL * (0.3 * (l - best)).exp()).collect();
    let bits: Vec<Vec<u64>> = order.iter().map(|&i| packed(&sets[i].inside)).collect();
    let mut longest = Vec::new();
    for ratio in RATIOS {
        let shares = |k: usize| sets[order[k]].shape.share;
        let (mut value, mut before) = (worth.clone(), vec![usize::MAX; order.len()]);
        for i in 0..order.len() {
            for j in 0..i {
                let fits = shares(i) >= ratio * shares(j) && shares(i) > shares(j);
                if fits && value[j] + worth[i] > value[i] && within(&bits[j], &bits[i]) {
                    (value[i], before[i]) = (value[j] + worth[i], j);
                }
            }
        }
        let mut at = (0..order.len()).fold(0, |b, i| if value[i] > value[b] { i } else { b });
        let mut levels = Vec::new();
        while at < order.len() {
            levels.push(order[at]);
            at = before[at];
        }
        levels.reverse();
        if levels.len() > longest.len() {
            longest = levels;
        }
        if longest.len() >= ENOUGH {
            break;
        }
    }
    longest
}

/// The index of the level for a granularity in [0, 1], of `count` levels.
pub(crate) fn level(count: usize, granularity: f32) -> usize {
    let g = if granularity.is_finite() { granularity.clamp(0.0, 1.0) } else { 0.5 };
    (g * count.saturating_sub(1) as f32).round() as usize
}

fn packed(inside: &[bool]) -> Vec<u64> {
    inside.chunks(64).map(|c| c.iter().enumerate().fold(0, |w, (k, &b)| w | u64::from(b) << k)).collect()
}

fn within(small: &[u64], large: &[u64]) -> bool {
    small.iter().zip(large).all(|(s, l)| s & !l == 0)
}
