//! Which connected parts of a selection stay (method, section 6).

use crate::{ClickHit, Evidence, NeighbourGraph};
use segwild_scene::Splats;

/// Share of a click's pixel that a splat must make up to stand for the click (method, section 6.5). By choice. IoU by half,
/// half more: 0, 0 on `sacre_coeur`; -.029, 0 on the demo.
const MIN_CLICK_SHARE: f32 = 0.05;

/// Multi-view support keeps a part however small it is (method, section 6.5): at least this mean number of photos without
/// clicks must see a splat of it. Examples are a shield beside its bearer and the foot of a plinth whose middle no photo sees.
/// From docs/experiments/2026-11-25-occluded-parts.md. IoU by half, half more: -.053, 0 on `sacre_coeur`; 0, 0 on the demo.
const SUPPORT_VIEWS: f64 = 1.0;

/// Share of those photos' evidence that must lie inside for multi-view support (method, section 6.5). What a mask includes past
/// an outline lies inside in one photo and outside in the next. From docs/experiments/2026-11-25-occluded-parts.md. Half and
/// half more move IoU by less than .0005.
const SUPPORT_SHARE: f64 = 0.7;

/// Removes the parts that hold only negative clicks, and those that hold no positive click. A part without a click stays if
/// it holds `share` of the selection's `evidence` (splats that no photo saw count nothing), or if `others`, the evidence
/// of photos without clicks, supports it ([`SUPPORT_SHARE`]). Where none stays, the part with most evidence
/// stays; without positive clicks it always does. Returns how many parts were removed.
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
    // Boxes name no part: a negative click beside them may show the object behind what it means.
    if !clicked.contains(&true) && (positive.is_empty() || !stays.contains(&true)) {
        let heaviest = (0..parts).fold(0, |best, p| if weight[p] > weight[best] { p } else { best });
        stays[heaviest] = true;
    }
    for (label, part) in labels.iter_mut().zip(&part) {
        *label = part.is_some_and(|p| stays[p as usize]);
    }
    stays.iter().filter(|s| !**s).count()
}

/// Which parts have multi-view support ([`SUPPORT_SHARE`]).
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
    sums.iter()
        .map(|&(inside, known, seen, splats)| {
            seen >= SUPPORT_VIEWS * f64::from(splats) && inside >= SUPPORT_SHARE * known
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_negative_click_beside_a_box_takes_no_part_but_small_ones() {
        // A body of 30 splats, a base of 10, and 5 that came along.
        let ends = [30, 40, 45];
        let means: Vec<[f32; 3]> = (0..45)
            .map(|i| {
                let part = ends.iter().filter(|end| i >= **end).count();
                [0.1 * (i % 6) as f32 + 50.0 * part as f32, 0.1 * (i / 6) as f32, 0.0]
            })
            .collect();
        let splats = Splats { means, ..Splats::default() };
        let graph = NeighbourGraph::new(&splats, 4);
        let mut evidence = Evidence::none(45);
        evidence.inside.fill(1.0);
        let negative = |splat: u32| [ClickHit { splats: vec![(splat, 0.5)], alpha: 0.9 }];
        let kept = |negative: &[ClickHit]| {
            let mut labels = vec![true; 45];
            keep_clicked(&graph, &splats, &mut labels, &evidence, None, (&[], negative), 0.05);
            [0, 30, 40].map(|splat: usize| labels[splat])
        };
        assert_eq!(kept(&[]), [true; 3]);
        assert_eq!(kept(&negative(2)), [true; 3], "the object shows behind what was clicked");
        assert_eq!(kept(&negative(42)), [true, true, false]);
    }
}
