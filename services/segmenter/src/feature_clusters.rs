//! Feature clusters: the materials that the prompted masks hold.

use crate::{Evidence, SplatFeatures};

/// Most clusters (method, section 6.2): bronze, stone, gilt, and what does not fit those. IoU by half, half more: -.010, +.003
/// on `sacre_coeur`; +.003, -.004 on the demo.
const MAX_CLUSTERS: usize = 4;

/// Share of the masks' evidence that a cluster must hold (method, section 6.2): less is a sliver of what lies past the outline.
/// By choice. IoU by half, half more: 0, +.004 on `sacre_coeur`; +.007, 0 on the demo.
const MIN_CLUSTER_SHARE: f32 = 0.1;

/// Share `rho` of a splat's evidence that must lie inside for its feature to count (method, section 6.2). By choice. IoU by
/// half, half more: 0, -.002 on `sacre_coeur`; +.002, -.001 on the demo.
const MIN_MEMBER_SHARE: f32 = 0.8;

/// Iterations of k-means: assign splats to the nearest centre, then take each cluster's mean.
const ROUNDS: usize = 6;

/// Centres of the feature clusters that the masks hold (unit vectors), by spherical k-means over the splats inside, weighted
/// by their evidence. A click hits one of an object's materials; its mask holds the others. Empty where the masks hold no
/// splat with a feature.
pub(crate) fn cluster_features(field: &SplatFeatures, evidence: &Evidence) -> Vec<Vec<f32>> {
    let inside: Vec<(usize, f32)> = (0..field.len())
        .filter(|&i| evidence.rho(i).is_some_and(|rho| rho >= MIN_MEMBER_SHARE) && field.has_direction(i))
        .map(|i| (i, evidence.sides(i).0))
        .collect();
    let total: f32 = inside.iter().map(|(_, weight)| weight).sum();
    let mean = |members: &mut dyn Iterator<Item = (usize, f32)>| {
        let mut sum = vec![0.0; field.channels()];
        for (i, weight) in members {
            field.add_direction(i, weight, &mut sum);
        }
        let norm = sum.iter().map(|x| x * x).sum::<f32>().sqrt();
        (norm > 0.0).then(|| sum.iter().map(|x| x / norm).collect::<Vec<f32>>())
    };
    let Some(first) = mean(&mut inside.iter().copied()) else { return Vec::new() };
    let mut centres = vec![first];
    // Each further cluster starts at the splat with the largest product of evidence and distance to the centres so far.
    let mut like: Vec<f32> = inside.iter().map(|(i, _)| field.cosine_to(*i, &centres[0])).collect();
    while centres.len() < MAX_CLUSTERS {
        let odd = |k: usize| inside[k].1 * (1.0 - like[k]);
        let Some(next) = (0..inside.len()).max_by(|&a, &b| odd(a).total_cmp(&odd(b))) else { break };
        let Some(cluster) = mean(&mut std::iter::once(inside[next])) else { break };
        like.iter_mut()
            .zip(&inside)
            .for_each(|(like, (i, _))| *like = like.max(field.cosine_to(*i, &cluster)));
        centres.push(cluster);
    }
    let mut shares = Vec::new();
    for _ in 0..ROUNDS {
        let nearest: Vec<usize> = inside
            .iter()
            .map(|(i, _)| {
                let cosines = centres.iter().map(|cluster| field.cosine_to(*i, cluster));
                cosines.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(cluster, _)| cluster)
            })
            .collect();
        let members = |cluster: usize| {
            inside.iter().zip(&nearest).filter(move |(_, n)| **n == cluster).map(|(member, _)| *member)
        };
        shares = (0..centres.len())
            .map(|cluster| members(cluster).map(|(_, weight)| weight).sum::<f32>())
            .collect();
        for cluster in 0..centres.len() {
            if let Some(mean) = mean(&mut members(cluster)) {
                centres[cluster] = mean;
            }
        }
    }
    let enough = |share: &f32| *share >= MIN_CLUSTER_SHARE * total;
    centres.into_iter().zip(shares).filter(|(_, share)| enough(share)).map(|(cluster, _)| cluster).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_of_stone_and_bronze_holds_both_and_not_the_sliver_of_sky_beside_them() {
        let (stone, bronze, sky) = ([1.0, 0.0, 0.1], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]);
        let rows = [(stone, 60), (bronze, 30), (sky, 5), ([0.0; 3], 3), ([f32::NAN; 3], 3), (sky, 50)];
        let values: Vec<f32> = rows.iter().flat_map(|(row, n)| row.repeat(*n)).collect();
        let field = SplatFeatures::new(3, values).unwrap();
        let inside: Vec<f32> = (0..field.len()).map(|i| f32::from(u8::from(i < 101))).collect();
        let outside = inside.iter().map(|x| 1.0 - x).collect();
        let found = cluster_features(&field, &Evidence { known: inside.clone(), inside, outside });
        let like = |row: [f32; 3]| {
            let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
            let cosine = |cluster: &Vec<f32>| cluster.iter().zip(row).map(|(a, b)| a * b).sum::<f32>() / norm;
            found.iter().map(cosine).fold(0.0, f32::max)
        };
        assert!(like(stone) > 0.999 && like(bronze) > 0.999, "{found:?}");
        assert!(like(sky) < 0.5, "{found:?}");
    }

    #[test]
    fn masks_without_a_splat_that_has_a_feature_hold_no_cluster() {
        let field = SplatFeatures::new(2, vec![0.0; 8]).unwrap();
        assert!(
            cluster_features(
                &field,
                &Evidence { inside: vec![1.0; 4], outside: vec![0.0; 4], known: vec![1.0; 4] }
            )
            .is_empty()
        );
        let field = SplatFeatures::new(2, vec![1.0; 8]).unwrap();
        assert!(cluster_features(&field, &Evidence::none(4)).is_empty());
    }
}
