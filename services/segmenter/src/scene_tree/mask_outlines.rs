//! Boundary strengths of a photo from its automatic masks (method, section 13).
//!
//! Masks nest: the outline of a part lies in a mask of the whole. Where few of the masks that hold one of two neighbouring pixels
//! end, the pixels are parts of one thing; where all of them end, the thing does.

use segwild_scene::{Image, MaskSet, ScoredMask};

/// Weight `w` of a mask, in [0, 1].
fn weight(mask: &ScoredMask) -> f32 {
    let weight = mask.predicted_iou * mask.stability;
    if weight.is_finite() { weight.clamp(0.0, 1.0) } else { 0.0 }
}

/// The masks that end at a side of a pixel: the sum of their weights, and of the squares of these.
type EndingMasks = [f32; 2];

/// Boundary strengths in [0, 1], one plane of the masks' size. The strength at the side of two pixels is 1 - S of Eq. 11, each mask
/// counted by its weight, times the mean weight of the masks that end there. A pixel has the larger one of its right and its lower
/// side, so that outlines are one pixel wide and closed.
pub fn mask_outlines(set: &MaskSet) -> Image {
    let (w, h) = (set.width as usize, set.height as usize);
    let mut held = vec![0.0f32; w * h];
    // Per pixel, its right side and its lower side.
    let mut ending = vec![[EndingMasks::default(); 2]; w * h];
    let weighed = set.masks.iter().map(|mask| (weight(mask), &mask.mask));
    for (weight, mask) in weighed.filter(|(weight, _)| *weight > 0.0) {
        for i in 0..w * h {
            let inside = mask.index(i);
            if inside {
                held[i] += weight;
            }
            for (side, j) in sides(i, w, h) {
                if mask.index(j) != inside {
                    let [sum, squares] = &mut ending[i][side];
                    *sum += weight;
                    *squares += weight * weight;
                }
            }
        }
    }
    let strength = |i: usize| {
        let of_sides = sides(i, w, h).map(|(side, j)| {
            let [sum, squares] = ending[i][side];
            // Both pixels' masks, each mask once.
            let either = 0.5 * (held[i] + held[j] + sum);
            if sum > 0.0 { (squares / either).min(1.0) } else { 0.0 }
        });
        of_sides.fold(0.0, f32::max)
    };
    Image { width: w, height: h, channels: 1, data: (0..w * h).map(strength).collect() }
}

/// The right and the lower neighbour of a pixel, as far as there are any.
fn sides(i: usize, w: usize, h: usize) -> impl Iterator<Item = (usize, usize)> {
    let right = (i % w + 1 < w).then_some((0, i + 1));
    let lower = (i + w < w * h).then_some((1, i + w));
    right.into_iter().chain(lower)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Mask;
    use segwild_vision::ContourTree;
    use std::ops::Range;

    const SIZE: (u32, u32) = (40, 20);

    fn boxed(xs: Range<u32>, ys: Range<u32>, predicted_iou: f32) -> ScoredMask {
        let mask = Mask::from_fn(SIZE.0, SIZE.1, |x, y| xs.contains(&x) && ys.contains(&y));
        ScoredMask { mask, predicted_iou, stability: 1.0 }
    }

    fn set(masks: Vec<ScoredMask>) -> MaskSet {
        MaskSet { width: SIZE.0, height: SIZE.1, masks }
    }

    fn at(map: &Image, x: usize, y: usize) -> f32 {
        map.at(0, x, y)
    }

    #[test]
    fn the_outline_of_a_part_is_weaker_than_that_of_the_whole() {
        let whole = boxed(5..35, 3..17, 0.8);
        let part = boxed(5..20, 3..17, 0.8);
        let map = mask_outlines(&set(vec![whole, part]));
        assert!((at(&map, 19, 10) - 0.4).abs() < 1e-6, "one of two masks ends");
        assert!((at(&map, 4, 10) - 0.8).abs() < 1e-6 && (at(&map, 34, 10) - 0.8).abs() < 1e-6, "all end");
        assert_eq!((at(&map, 10, 10), at(&map, 28, 10), at(&map, 1, 1)), (0.0, 0.0, 0.0));
        // They nest: the halves merge first, and then they merge with what lies around.
        let tree = ContourTree::of(&map);
        let pixel = |x: usize| 10 * SIZE.0 as usize + x;
        let (parts, ground) = (tree.height(pixel(10), pixel(28)), tree.height(pixel(28), pixel(38)));
        assert!((0.35..0.55).contains(&parts) && ground > 0.7, "{parts} {ground}");
    }

    #[test]
    fn an_outline_counts_by_the_score_of_its_mask() {
        let strength = |score: f32| at(&mask_outlines(&set(vec![boxed(5..20, 3..17, score)])), 19, 10);
        assert!((strength(0.9) - 0.9).abs() < 1e-6 && (strength(0.3) - 0.3).abs() < 1e-6);
        assert_eq!((strength(f32::NAN), strength(-1.0)), (0.0, 0.0));
        // A good mask that goes on weighs more than a bad one that ends.
        let masks = vec![boxed(5..35, 3..17, 0.9), boxed(5..20, 3..17, 0.3)];
        assert!(at(&mask_outlines(&set(masks)), 19, 10) < 0.1);
    }

    #[test]
    fn neighbours_that_share_no_mask_are_as_far_apart_as_can_be() {
        let map = mask_outlines(&set(vec![boxed(5..20, 3..17, 1.0), boxed(20..35, 3..17, 1.0)]));
        assert_eq!((at(&map, 19, 10), at(&map, 4, 10)), (1.0, 1.0));
    }

    #[test]
    fn no_mask_and_no_pixel_make_no_outline() {
        assert!(mask_outlines(&set(Vec::new())).data.iter().all(|strength| *strength == 0.0));
        let all = boxed(0..40, 0..20, 1.0);
        assert!(
            mask_outlines(&set(vec![all])).data.iter().all(|strength| *strength == 0.0),
            "its frame is none"
        );
        let nothing = MaskSet { width: 0, height: 0, masks: vec![] };
        assert!(mask_outlines(&nothing).data.is_empty());
    }
}
