//! Granularity: nested candidates around a click, from fine to coarse.

use super::pool::Choice;

/// Shares of the photo between which rungs lie, where there are such candidates.
const FINEST: f32 = 0.001;
const COARSEST: f32 = 0.75;
/// Least ratio of the areas of neighbouring rungs: where that leaves fewer than [`ENOUGH`], the next one is tried.
const RATIOS: [f32; 4] = [1.5, 1.25, 1.1, 1.0];
/// Rungs that are enough: as many as a person tries.
const ENOUGH: usize = 5;
/// What every rung is worth, beside what the best-looking one is (1).
const RUNG: f32 = 0.08;

/// The nested sets around a click at pixel `at`, small to large, that together look most like things: positions in `choices`.
pub(crate) fn ladder(choices: &[Choice], at: [f32; 2]) -> Vec<usize> {
    let mut order: Vec<usize> =
        (0..choices.len()).filter(|&i| (FINEST..=COARSEST).contains(&choices[i].shape.share)).collect();
    if order.is_empty() {
        order = (0..choices.len()).collect();
    }
    order.sort_by(|&a, &b| choices[a].shape.share.total_cmp(&choices[b].shape.share).then(a.cmp(&b)));
    let likeness: Vec<f32> = order.iter().map(|&i| choices[i].shape.likeness(at)).collect();
    let best = likeness.iter().copied().fold(f32::MIN, f32::max);
    let worth: Vec<f32> =
        likeness.iter().map(|l| (l - best).exp() + RUNG * (0.3 * (l - best)).exp()).collect();
    let bits: Vec<Vec<u64>> = order.iter().map(|&i| packed(&choices[i].inside)).collect();
    let mut longest = Vec::new();
    for ratio in RATIOS {
        let shares = |k: usize| choices[order[k]].shape.share;
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
        let mut rungs = Vec::new();
        while at < order.len() {
            rungs.push(order[at]);
            at = before[at];
        }
        rungs.reverse();
        if rungs.len() > longest.len() {
            longest = rungs;
        }
        if longest.len() >= ENOUGH {
            break;
        }
    }
    longest
}

/// The rung that a granularity in [0, 1] stands for, of `count`.
pub(crate) fn rung(count: usize, granularity: f32) -> usize {
    let g = if granularity.is_finite() { granularity.clamp(0.0, 1.0) } else { 0.5 };
    (g * count.saturating_sub(1) as f32).round() as usize
}

fn packed(inside: &[bool]) -> Vec<u64> {
    inside.chunks(64).map(|c| c.iter().enumerate().fold(0, |w, (k, &b)| w | u64::from(b) << k)).collect()
}

fn within(small: &[u64], large: &[u64]) -> bool {
    small.iter().zip(large).all(|(s, l)| s & !l == 0)
}
