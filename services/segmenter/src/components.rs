//! Which connected parts of a selection stay (method, section 6).

use crate::{Graph, Hit};
use segwild_scene::Splats;

/// Share of a click's pixel that a splat must make up to stand for the click.
const SEED: f32 = 0.05;

/// Takes away the parts that hold no positive click and less than `share` of the selection's `evidence` (what
/// masks saw of each splat inside: what no photo saw is no reason to keep a part), and those that hold only negative
/// clicks. Where no click lies in any part, the heaviest stays. Returns how many parts
/// went.
pub(crate) fn keep_clicked(
    graph: &Graph,
    splats: &Splats,
    labels: &mut [bool],
    evidence: &[f32],
    positive: &[Hit],
    negative: &[Hit],
    share: f32,
) -> usize {
    let (part, parts) = graph.components(splats, labels);
    if parts == 0 {
        return 0;
    }
    let mut weight = vec![0.0f64; parts];
    for (part, &seen) in part.iter().zip(evidence) {
        if let Some(part) = part {
            weight[*part as usize] += f64::from(seen);
        }
    }
    let holding = |hits: &[Hit]| {
        let mut holds = vec![false; parts];
        for hit in hits {
            for &(splat, s) in &hit.splats {
                if let (Some(part), true) = (part[splat as usize], s >= SEED * hit.alpha) {
                    holds[part as usize] = true;
                }
            }
        }
        holds
    };
    let (clicked, refused) = (holding(positive), holding(negative));
    let total: f64 = weight.iter().sum();
    let mut stays: Vec<bool> =
        (0..parts).map(|p| clicked[p] || (!refused[p] && weight[p] >= f64::from(share) * total)).collect();
    if !clicked.contains(&true) && !stays.contains(&true) {
        let heaviest = (0..parts).fold(0, |best, p| if weight[p] > weight[best] { p } else { best });
        stays[heaviest] = true;
    }
    for (label, part) in labels.iter_mut().zip(&part) {
        *label = part.is_some_and(|p| stays[p as usize]);
    }
    stays.iter().filter(|s| !**s).count()
}
