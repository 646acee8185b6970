//! Sets of pixels.

use crate::whole::read_whole;
use std::ops::Range;
use wincode::{SchemaRead, SchemaWrite};

/// A bit-packed set of pixels: bit `i % 64` of word `i / 64` is pixel `i = y * width + x`.
#[derive(Clone, Debug, PartialEq, Eq, SchemaWrite)]
pub struct Mask {
    width: u32,
    height: u32,
    words: Vec<u64>,
}

read_whole!(Mask as MaskRecord { width: u32, height: u32, words: Vec<u64> } where Mask::is_whole, "a mask has another number of pixels");

/// A mask with the scores of its provider.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct ScoredMask {
    /// The pixels.
    pub mask: Mask,
    /// Predicted IoU with the intended object, in [0, 1].
    pub predicted_iou: f32,
    /// IoU of the masks at a stricter and a looser threshold, in [0, 1] (docs/method.md, section 5).
    pub stability: f32,
}

/// All masks of one view.
#[derive(Clone, Debug, PartialEq, SchemaWrite)]
pub struct MaskSet {
    /// Width of every mask.
    pub width: u32,
    /// Height of every mask.
    pub height: u32,
    /// The masks; they may overlap and nest.
    pub masks: Vec<ScoredMask>,
}

read_whole!(
    MaskSet as MaskSetRecord { width: u32, height: u32, masks: Vec<ScoredMask> }
    where |set| set.masks.iter().all(|m| (m.mask.width, m.mask.height) == (set.width, set.height)),
    "a mask has another size than the others"
);

impl Mask {
    /// Whether there is a bit for each pixel and none beyond.
    fn is_whole(&self) -> bool {
        let n = self.width as usize * self.height as usize;
        let beyond = |word: &u64| !n.is_multiple_of(64) && word >> (n % 64) != 0;
        self.words.len() == n.div_ceil(64) && !self.words.last().is_some_and(beyond)
    }

    /// No pixel.
    pub fn empty(width: u32, height: u32) -> Mask {
        let n = width as usize * height as usize;
        Mask { width, height, words: vec![0; n.div_ceil(64)] }
    }

    /// Every pixel.
    pub fn full(width: u32, height: u32) -> Mask {
        Mask::from_fn(width, height, |_, _| true)
    }

    /// The pixels for which `inside(x, y)` holds.
    pub fn from_fn(width: u32, height: u32, inside: impl Fn(u32, u32) -> bool) -> Mask {
        let mut mask = Mask::empty(width, height);
        for y in 0..height {
            for x in 0..width {
                if inside(x, y) {
                    mask.set(x, y, true);
                }
            }
        }
        mask
    }

    /// The pixels whose value is over `threshold`; `values` has one number per pixel, row-major.
    /// A NaN is not over anything.
    pub fn over(width: u32, height: u32, values: &[f32], threshold: f32) -> Mask {
        assert_eq!(values.len(), width as usize * height as usize, "one value per pixel");
        let mut mask = Mask::empty(width, height);
        for (i, &v) in values.iter().enumerate() {
            if v > threshold {
                mask.words[i / 64] |= 1 << (i % 64);
            }
        }
        mask
    }

    /// Width in pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Whether a pixel belongs to the mask. Outside the frame nothing does (never clamp to the border).
    pub fn get(&self, x: u32, y: u32) -> bool {
        if x >= self.width || y >= self.height {
            return false;
        }
        self.index(y as usize * self.width as usize + x as usize)
    }

    /// Whether pixel `y * width + x` belongs to the mask.
    pub fn index(&self, i: usize) -> bool {
        self.words[i / 64] >> (i % 64) & 1 == 1
    }

    /// Whether the pixel that holds position `(u, v)` belongs to the mask: looked up at the floor.
    pub fn at(&self, u: f32, v: f32) -> bool {
        u >= 0.0
            && v >= 0.0
            && u < self.width as f32
            && v < self.height as f32
            && self.get(u as u32, v as u32)
    }

    /// Adds a pixel to the mask or removes it.
    pub fn set(&mut self, x: u32, y: u32, inside: bool) {
        assert!(x < self.width && y < self.height, "pixel ({x}, {y}) outside {}x{}", self.width, self.height);
        let i = y as usize * self.width as usize + x as usize;
        if inside {
            self.words[i / 64] |= 1 << (i % 64);
        } else {
            self.words[i / 64] &= !(1 << (i % 64));
        }
    }

    /// Adds pixels to the mask, by their indexes, or removes them.
    pub(crate) fn fill(&mut self, pixels: Range<usize>, inside: bool) {
        let mut at = pixels.start;
        while at < pixels.end {
            let until = (at / 64 * 64 + 64).min(pixels.end);
            let bits = (u64::MAX >> (64 - (until - at))) << (at % 64);
            let word = &mut self.words[at / 64];
            *word = if inside { *word | bits } else { *word & !bits };
            at = until;
        }
    }

    /// Index of the first pixel from `at` on that is inside, or that is not; the number of pixels where there is none.
    pub(crate) fn next(&self, at: usize, inside: bool) -> usize {
        let pixels = self.width as usize * self.height as usize;
        let wanted = |word: u64| if inside { word } else { !word };
        let mut k = at / 64;
        let mut from = u64::MAX << (at % 64);
        while let Some(&word) = self.words.get(k) {
            let found = wanted(word) & from;
            if found != 0 {
                return (k * 64 + found.trailing_zeros() as usize).min(pixels);
            }
            (k, from) = (k + 1, u64::MAX);
        }
        pixels
    }

    /// Number of pixels in the mask.
    pub fn count(&self) -> usize {
        self.words.iter().map(|w| w.count_ones() as usize).sum()
    }

    /// Whether no pixel is in the mask.
    pub fn is_empty(&self) -> bool {
        self.words.iter().all(|&w| w == 0)
    }

    /// Pixels in both.
    pub fn and(&self, other: &Mask) -> Mask {
        self.zip(other, |a, b| a & b)
    }

    /// Pixels in either.
    pub fn or(&self, other: &Mask) -> Mask {
        self.zip(other, |a, b| a | b)
    }

    /// Pixels here that are not there.
    pub fn minus(&self, other: &Mask) -> Mask {
        self.zip(other, |a, b| a & !b)
    }

    /// Pixels that are not in the mask.
    pub fn not(&self) -> Mask {
        Mask::full(self.width, self.height).minus(self)
    }

    /// Number of pixels in both, without making a mask.
    pub fn overlap(&self, other: &Mask) -> usize {
        self.same_size(other);
        self.words.iter().zip(&other.words).map(|(a, b)| (a & b).count_ones() as usize).sum()
    }

    /// Intersection over union; 1 when both are empty.
    pub fn iou(&self, other: &Mask) -> f64 {
        let both = self.overlap(other);
        let either = self.count() + other.count() - both;
        if either == 0 { 1.0 } else { both as f64 / either as f64 }
    }

    /// The pixels of the mask, row by row.
    pub fn pixels(&self) -> impl Iterator<Item = (u32, u32)> + '_ {
        let width = self.width as usize;
        self.words.iter().enumerate().flat_map(move |(k, &word)| {
            std::iter::successors((word != 0).then_some(word), |w| {
                let rest = w & (w - 1);
                (rest != 0).then_some(rest)
            })
            .map(move |w| {
                let i = k * 64 + w.trailing_zeros() as usize;
                ((i % width) as u32, (i / width) as u32)
            })
        })
    }

    /// The mask at another size, each pixel taken from the pixel under its centre.
    pub fn resized(&self, width: u32, height: u32) -> Mask {
        let nearest = |size: u32, own: u32| -> Vec<u32> {
            let at = |k: u32| (f64::from(k) + 0.5) * f64::from(own) / f64::from(size);
            (0..size).map(|k| at(k) as u32).collect()
        };
        let (us, vs) = (nearest(width, self.width), nearest(height, self.height));
        Mask::from_fn(width, height, |x, y| self.get(us[x as usize], vs[y as usize]))
    }

    fn zip(&self, other: &Mask, op: impl Fn(u64, u64) -> u64) -> Mask {
        self.same_size(other);
        let words = self.words.iter().zip(&other.words).map(|(&a, &b)| op(a, b)).collect();
        Mask { width: self.width, height: self.height, words }
    }

    fn same_size(&self, other: &Mask) {
        assert_eq!((self.width, self.height), (other.width, other.height), "masks of two sizes");
    }
}
