//! What an object is made of: the kinds of surface that the prompted masks hold.

use crate::{Evidence, FeatureField};

/// Most kinds that are told apart: bronze, stone, gilt, and what does not fit those.
const KINDS: usize = 4;

/// Share of the masks' evidence that a kind must hold: less is a sliver of what is seen past the outline.
const LEAST_SHARE: f32 = 0.1;

/// Share of a splat's evidence that must lie inside for its feature to count.
const WELL_INSIDE: f32 = 0.8;

/// Rounds of assigning splats to the nearest kind and taking each kind's mean.
const ROUNDS: usize = 6;

/// Mean feature of each kind of surface that the masks hold, by spherical k-means over the splats inside, weighted by
/// their evidence. A click shows one of an object's materials; the mask that answers it shows the others. Empty where
/// the masks hold no splat with a feature.
pub(crate) fn kinds(field: &FeatureField, evidence: &Evidence) -> Vec<Vec<f32>> {
    let inside: Vec<(usize, f32)> = (0..field.len())
        .filter(|&i| evidence.rho(i).is_some_and(|rho| rho >= WELL_INSIDE) && field.has_direction(i))
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
    let mut kinds = vec![first];
    // Each further kind begins at what is least like those before, and is much of the masks.
    let mut like: Vec<f32> = inside.iter().map(|(i, _)| field.cosine_to(*i, &kinds[0])).collect();
    while kinds.len() < KINDS {
        let odd = |k: usize| inside[k].1 * (1.0 - like[k]);
        let Some(next) = (0..inside.len()).max_by(|&a, &b| odd(a).total_cmp(&odd(b))) else { break };
        let Some(kind) = mean(&mut std::iter::once(inside[next])) else { break };
        like.iter_mut().zip(&inside).for_each(|(like, (i, _))| *like = like.max(field.cosine_to(*i, &kind)));
        kinds.push(kind);
    }
    let mut shares = Vec::new();
    for _ in 0..ROUNDS {
        let nearest: Vec<usize> = inside
            .iter()
            .map(|(i, _)| {
                let cosines = kinds.iter().map(|kind| field.cosine_to(*i, kind));
                cosines.enumerate().max_by(|a, b| a.1.total_cmp(&b.1)).map_or(0, |(kind, _)| kind)
            })
            .collect();
        let members = |kind: usize| {
            inside.iter().zip(&nearest).filter(move |(_, n)| **n == kind).map(|(member, _)| *member)
        };
        shares = (0..kinds.len()).map(|kind| members(kind).map(|(_, weight)| weight).sum::<f32>()).collect();
        for kind in 0..kinds.len() {
            if let Some(mean) = mean(&mut members(kind)) {
                kinds[kind] = mean;
            }
        }
    }
    let enough = |share: &f32| *share >= LEAST_SHARE * total;
    kinds.into_iter().zip(shares).filter(|(_, share)| enough(share)).map(|(kind, _)| kind).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_of_stone_and_bronze_holds_both_and_not_the_sliver_of_sky_beside_them() {
        let (stone, bronze, sky) = ([1.0, 0.0, 0.1], [0.0, 1.0, 0.1], [0.0, 0.0, 1.0]);
        let rows = [(stone, 60), (bronze, 30), (sky, 5), ([0.0; 3], 3), ([f32::NAN; 3], 3), (sky, 50)];
        let values: Vec<f32> = rows.iter().flat_map(|(row, n)| row.repeat(*n)).collect();
        let field = FeatureField::new(3, values).unwrap();
        let inside: Vec<f32> = (0..field.len()).map(|i| f32::from(u8::from(i < 101))).collect();
        let outside = inside.iter().map(|x| 1.0 - x).collect();
        let found = kinds(&field, &Evidence { known: inside.clone(), inside, outside });
        let like = |row: [f32; 3]| {
            let norm = row.iter().map(|x| x * x).sum::<f32>().sqrt();
            let cosine = |kind: &Vec<f32>| kind.iter().zip(row).map(|(a, b)| a * b).sum::<f32>() / norm;
            found.iter().map(cosine).fold(0.0, f32::max)
        };
        assert!(like(stone) > 0.999 && like(bronze) > 0.999, "{found:?}");
        assert!(like(sky) < 0.5, "{found:?}");
    }

    #[test]
    fn masks_without_a_splat_that_has_a_feature_hold_no_kind() {
        let field = FeatureField::new(2, vec![0.0; 8]).unwrap();
        assert!(
            kinds(&field, &Evidence { inside: vec![1.0; 4], outside: vec![0.0; 4], known: vec![1.0; 4] })
                .is_empty()
        );
        let field = FeatureField::new(2, vec![1.0; 8]).unwrap();
        assert!(kinds(&field, &Evidence::none(4)).is_empty());
    }
}
