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

impl Membership {
    /// Group of a pixel that no mask holds.
    pub const NONE: u32 = u32::MAX;

    /// Looks the masks up under the centres of `width` x `height` pixels.
    pub fn new(masks: &MaskSet, width: usize, height: usize) -> Membership {
        let mut of_pixel: Vec<Vec<u32>> = vec![Vec::new(); width * height];
        for (k, scored) in masks.masks.iter().enumerate() {
            let small: Mask = scored.mask.resized(width as u32, height as u32);
            for (x, y) in small.pixels() {
                of_pixel[y as usize * width + x as usize].push(k as u32);
            }
        }
        let mut groups = Vec::with_capacity(width * height);
        let mut known: BTreeMap<Vec<u32>, u32> = BTreeMap::new();
        let mut sets = Vec::new();
        for set in of_pixel {
            if set.is_empty() {
                groups.push(Membership::NONE);
                continue;
            }
            groups.push(*known.entry(set).or_insert_with_key(|set| {
                sets.push(set.clone());
                sets.len() as u32 - 1
            }));
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
