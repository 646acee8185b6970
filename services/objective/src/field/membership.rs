//! Which masks hold which pixels.

use segwild_scene::{Mask, MaskSet};
use std::collections::BTreeMap;

/// For each pixel, the set of masks that hold it. Pixels with the same set share a group.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Membership {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Group of each pixel, row by row; [`Membership::NONE`] in no mask.
    pub groups: Vec<u32>,
    /// The masks of each group, rising, never empty.
    pub sets: Vec<Vec<u32>>,
    /// The same as bits, `words` for each group.
    bits: Vec<u64>,
    words: usize,
}

/// Sets of masks that are found mask by mask: each is an earlier one and a further mask.
#[derive(Default)]
struct SetPrefixes(Vec<(u32, u32)>);

impl SetPrefixes {
    /// Adds the set `before`, [`Membership::NONE`] for the empty one, with a further mask. Returns its number.
    fn add(&mut self, before: u32, mask: u32) -> u32 {
        self.0.push((before, mask));
        self.0.len() as u32 - 1
    }

    /// The masks of a set, rising.
    fn set(&self, mut number: u32) -> Vec<u32> {
        let mut masks = Vec::new();
        while number != Membership::NONE {
            let (before, mask) = self.0[number as usize];
            masks.push(mask);
            number = before;
        }
        masks.reverse();
        masks
    }
}

impl Membership {
    /// Group of a pixel that no mask holds.
    pub const NONE: u32 = u32::MAX;

    /// Looks the masks up under the centres of `width` x `height` pixels.
    pub fn new(masks: &MaskSet, width: usize, height: usize) -> Membership {
        let mut groups = vec![Membership::NONE; width * height];
        let mut prefixes = SetPrefixes::default();
        for (k, scored) in masks.masks.iter().enumerate() {
            let small: Mask = scored.mask.resized(width as u32, height as u32);
            let mut longer = BTreeMap::new();
            for (x, y) in small.pixels() {
                let group = &mut groups[y as usize * width + x as usize];
                *group = *longer.entry(*group).or_insert_with_key(|&before| prefixes.add(before, k as u32));
            }
        }
        // Groups are numbered by their first pixel.
        let (mut numbers, mut sets) = (vec![Membership::NONE; prefixes.0.len()], Vec::new());
        for group in groups.iter_mut().filter(|group| **group != Membership::NONE) {
            let number = &mut numbers[*group as usize];
            if *number == Membership::NONE {
                *number = sets.len() as u32;
                sets.push(prefixes.set(*group));
            }
            *group = *number;
        }
        let words = masks.masks.len().div_ceil(64);
        let mut bits = vec![0; words * sets.len()];
        for (set, bits) in sets.iter().zip(bits.chunks_exact_mut(words.max(1))) {
            set.iter().for_each(|&k| bits[k as usize / 64] |= 1 << (k % 64));
        }
        Membership { width, height, groups, sets, bits, words }
    }

    /// The masks of each group as bits, so many words for each.
    pub fn bits(&self) -> (&[u64], usize) {
        (&self.bits, self.words)
    }

    /// Jaccard similarity of the mask sets of two groups: `|A and B| / (|A or B| + 1e-5)` (Eq. 11).
    pub fn similarity(&self, a: u32, b: u32) -> f32 {
        let bits = |g: u32| &self.bits[g as usize * self.words..][..self.words];
        let (mut both, mut either) = (0, 0);
        for (a, b) in bits(a).iter().zip(bits(b)) {
            both += (a & b).count_ones();
            either += (a | b).count_ones();
        }
        both as f32 / (either as f32 + 1e-5)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::ScoredMask;

    #[test]
    fn groups_are_the_sets_of_masks_that_hold_a_pixel_numbered_by_their_first() {
        let (width, height) = (37u32, 23u32);
        let mut state = 11u64;
        let mut random = |below: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((state >> 33) % below) as u32
        };
        let mut masks = Vec::new();
        for _ in 0..80 {
            let (left, top, wide, high) = (random(37), random(23), random(30), random(20));
            let mask = Mask::from_fn(width, height, |x, y| {
                (left..left + wide).contains(&x) && (top..top + high).contains(&y)
            });
            masks.push(ScoredMask { mask, predicted_iou: 0.9, stability: 0.9 });
        }
        let set = MaskSet { width, height, masks };
        let found = Membership::new(&set, width as usize, height as usize);
        let mut known: Vec<Vec<u32>> = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let holds = |k: &u32| set.masks[*k as usize].mask.get(x, y);
                let expected: Vec<u32> = (0..80).filter(holds).collect();
                let group = found.groups[(y * width + x) as usize];
                if expected.is_empty() {
                    assert_eq!(group, Membership::NONE);
                    continue;
                }
                let number = known.iter().position(|set| *set == expected).unwrap_or_else(|| {
                    known.push(expected);
                    known.len() - 1
                });
                assert_eq!(group as usize, number, "{x} {y}");
            }
        }
        assert_eq!(found.sets, known);
    }
}
