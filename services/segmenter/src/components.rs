//! Which connected parts of a selection stay (method, section 6).

use crate::{ClickHit, Evidence, NeighbourGraph};
use segwild_scene::Splats;

/// Share of a click's pixel that a splat must make up to stand for the click.
const MIN_CLICK_SHARE: f32 = 0.05;

/// Multi-view support that keeps a part however small it is: the mean number of photos without clicks that see a splat of
/// it, and the share of their evidence that must lie inside. Examples are a shield beside its bearer and the foot of a
/// plinth whose middle no photo sees. What a mask includes past an outline lies inside in one photo and outside in the next.
const SUPPORTED: (f64, f64) = (1.0, 0.7);

/// Removes the parts that hold only negative clicks, and those that hold no positive click. A part without a click stays if
/// it holds `share` of the selection's `evidence` (splats that no photo saw count nothing), or if `others`, the evidence
/// of photos without clicks, supports it ([`SUPPORTED`]). Where no click lies in any part, the part with most evidence
/// stays. Returns how many parts were removed.
pub(crate) fn keep_clicked(
    graph: &NeighbourGraph,
    splats: &Splats,
    labels: &mut [bool],
    evidence: &Evidence,
    others: Option<&Evidence>,
    (positive, negative): (&[ClickHit], &[ClickHit]),
    share: f32,
) -> usize {
    let (part, parts) = graph.components(splats, labels);
    if parts == 0 {
        return 0;
    }
    let mut weight = vec![0.0f64; parts];
    for (i, part) in part.iter().enumerate() {
        if let Some(part) = part {
            weight[*part as usize] += f64::from(evidence.sides(i).0);
        }
    }
    let supported = others.map_or(vec![false; parts], |others| supported(others, &part, parts));
    let holding = |hits: &[ClickHit]| {
        let mut holds = vec![false; parts];
        for hit in hits {
            for &(splat, s) in &hit.splats {
                if let (Some(part), true) = (part[splat as usize], s >= MIN_CLICK_SHARE * hit.alpha) {
                    holds[part as usize] = true;
                }
            }
        }
        holds
    };
    let (clicked, refused) = (holding(positive), holding(negative));
    let total: f64 = weight.iter().sum();
    let large = |p: usize| weight[p] >= f64::from(share) * total;
    let mut stays: Vec<bool> =
        (0..parts).map(|p| clicked[p] || (!refused[p] && (large(p) || supported[p]))).collect();
    if !clicked.contains(&true) && !stays.contains(&true) {
        let heaviest = (0..parts).fold(0, |best, p| if weight[p] > weight[best] { p } else { best });
        stays[heaviest] = true;
    }
    for (label, part) in labels.iter_mut().zip(&part) {
        *label = part.is_some_and(|p| stays[p as usize]);
    }
    stays.iter().filter(|s| !**s).count()
}

/// Which parts have multi-view support ([`SUPPORTED`]).
fn supported(evidence: &Evidence, part: &[Option<u32>], parts: usize) -> Vec<bool> {
    let mut sums = vec![(0.0f64, 0.0f64, 0.0f64, 0u32); parts];
    for (i, part) in part.iter().enumerate() {
        if let Some(part) = part {
            let (inside, known, seen, splats) = &mut sums[*part as usize];
            *inside += f64::from(evidence.sides(i).0);
            *known += f64::from(evidence.known[i]);
            *seen += f64::from(evidence.seen(i));
            *splats += 1;
        }
    }
    let (views, share) = SUPPORTED;
    sums.iter()
        .map(|&(inside, known, seen, splats)| seen >= views * f64::from(splats) && inside >= share * known)
        .collect()
}
