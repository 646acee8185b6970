//! From a decoder's small logits to masks of the photo's size.

use super::frame::PhotoFit;
use crate::builtin::Weighed;
use segwild_scene::{Mask, ScoredMask};

/// Logits over the encoder's square (or over the photo, from a decoder that gives no others), row by row.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Logits {
    pub width: usize,
    pub height: usize,
    pub data: Vec<f32>,
}

impl Logits {
    /// Whether a size is theirs.
    pub fn is(&self, width: usize, height: usize) -> bool {
        (self.width, self.height) == (width, height)
    }
}

impl Weighed for Logits {
    fn bytes(&self) -> usize {
        4 * self.data.len()
    }
}

/// Weights of the logits from `first` on that make one pixel of the photo, along one axis.
#[derive(Clone, Debug, PartialEq)]
struct LogitTaps {
    first: usize,
    weights: Vec<f32>,
}

/// Scales logits to a photo as the published code does: linearly to the encoder's square, cut to the photo's part, and
/// linearly to the photo. Both steps are linear along each axis, so each pixel is a weighed sum of a few logits.
pub(super) struct Upscale {
    /// Logits in a row.
    width: usize,
    columns: Vec<LogitTaps>,
    rows: Vec<LogitTaps>,
}

/// Linear interpolation without smoothing, between pixel centres, the border continued (`align_corners=False`): the two
/// neighbours of pixel `i` of `to`, and the weight of the second.
fn neighbours(i: usize, from: usize, to: usize) -> (usize, usize, f64) {
    let at = ((i as f64 + 0.5) * from as f64 / to as f64 - 0.5).max(0.0);
    let low = (at.floor() as usize).min(from - 1);
    (low, (low + 1).min(from - 1), at - low as f64)
}

fn axis(logits: usize, fit: &PhotoFit, axis: usize) -> Vec<LogitTaps> {
    let (content, photo) = (fit.content[axis], fit.photo[axis]);
    let one = |i: usize| {
        let mut parts: Vec<(usize, f64)> = Vec::with_capacity(4);
        let mut small = |pixel: usize, size: usize, weight: f64| {
            let (a, b, share) = neighbours(pixel, logits, size);
            parts.extend([(a, weight * (1.0 - share)), (b, weight * share)]);
        };
        match fit.side {
            None => small(i, photo, 1.0),
            Some(square) => {
                let (a, b, share) = neighbours(i, content, photo);
                small(a, square, 1.0 - share);
                small(b, square, share);
            }
        }
        let first = parts.iter().map(|p| p.0).min().unwrap_or(0);
        let last = parts.iter().map(|p| p.0).max().unwrap_or(0);
        let mut weights = vec![0.0; last - first + 1];
        parts.iter().for_each(|&(k, weight)| weights[k - first] += weight);
        LogitTaps { first, weights: weights.into_iter().map(|w| w as f32).collect() }
    };
    (0..photo).map(one).collect()
}

impl Upscale {
    /// For `width` x `height` logits over the square that a photo lies in.
    pub fn new(width: usize, height: usize, fit: &PhotoFit) -> Upscale {
        Upscale { width, columns: axis(width, fit, 0), rows: axis(height, fit, 1) }
    }

    /// One plane of the photo's size.
    pub fn plane(&self, logits: &Logits) -> Vec<f32> {
        let mut out = Vec::with_capacity(self.columns.len() * self.rows.len());
        let mut line = vec![0.0f32; self.width];
        for row in &self.rows {
            line.fill(0.0);
            for (k, weight) in row.weights.iter().enumerate() {
                let from = &logits.data[(row.first + k) * self.width..][..self.width];
                line.iter_mut().zip(from).for_each(|(sum, v)| *sum += weight * v);
            }
            out.extend(self.columns.iter().map(|column| {
                column.weights.iter().zip(&line[column.first..]).map(|(w, v)| w * v).sum::<f32>()
            }));
        }
        out
    }

    /// The mask at the photo's size: where the logits are over 0; stable as far as it is the same at `offset` and at
    /// `-offset`.
    pub fn mask(&self, logits: &Logits, predicted_iou: f32, offset: f32) -> ScoredMask {
        let plane = self.plane(logits);
        let mask = Mask::over(self.columns.len() as u32, self.rows.len() as u32, &plane, 0.0);
        ScoredMask { mask, predicted_iou, stability: stability(&plane, offset) }
    }
}

/// IoU of the mask at a stricter and at a looser threshold; 0 where both are empty. The stricter one lies in the looser.
pub(super) fn stability(plane: &[f32], offset: f32) -> f32 {
    let over = |threshold: f32| plane.iter().filter(|&&v| v > threshold).count();
    match over(-offset) {
        0 => 0.0,
        loose => over(offset) as f32 / loose as f32,
    }
}

/// Chooses among a decoder's masks: at a granularity in [0, 1] by size, 0 the smallest; else the one of the highest predicted
/// IoU, the first of equals.
pub(super) fn choose(masks: &[(Logits, f32)], granularity: Option<f32>) -> Option<usize> {
    match granularity {
        None => {
            let better = |best: usize, i: usize| if masks[i].1 > masks[best].1 { i } else { best };
            (0..masks.len()).reduce(better)
        }
        Some(g) => {
            let size = |i: &usize| masks[*i].0.data.iter().filter(|&&v| v > 0.0).count();
            let mut order: Vec<usize> = (0..masks.len()).collect();
            order.sort_by_key(size);
            let last = order.len().checked_sub(1)? as f32;
            order.get((g.clamp(0.0, 1.0) * last).round() as usize).copied()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logits_grow_to_the_photo_as_published() {
        // 2 x 2 logits over a square of 4, a photo of 8 x 4 in its upper half (content 4 x 2). By hand, along x:
        // 0, 8 -> 0, 2, 6, 8 -> at -0.25, 0.25, 0.75, ... between them: 0, .5, 1.5, 3, 5, 6.5, 7.5, 8.
        // Along y: 0, 4 -> 0, 1, 3, 4, of which the first two stay -> 0, .25, .75, 1.
        let fit = PhotoFit { photo: [8, 4], content: [4, 2], side: Some(4) };
        let logits = Logits { width: 2, height: 2, data: vec![0.0, 8.0, 4.0, 12.0] };
        let plane = Upscale::new(2, 2, &fit).plane(&logits);
        let (columns, rows) = ([0.0, 0.5, 1.5, 3.0, 5.0, 6.5, 7.5, 8.0], [0.0, 0.25, 0.75, 1.0]);
        for (y, row) in rows.iter().enumerate() {
            for (x, column) in columns.iter().enumerate() {
                let got = plane[y * 8 + x];
                assert!((got - (row + column)).abs() < 1e-5, "{x} {y}: {got} is not {}", row + column);
            }
        }
        // A photo that fills the square: one step, to its own size.
        let whole = Upscale::new(2, 2, &PhotoFit::filling([4, 1])).plane(&logits);
        assert_eq!(whole, [2.0, 4.0, 8.0, 10.0]);
    }

    #[test]
    fn stability_is_the_iou_of_a_stricter_and_a_looser_mask() {
        let plane = [3.0, 1.5, 1.0, 0.5, -0.5, -1.0, -2.0];
        assert_eq!(stability(&plane, 1.0), 2.0 / 5.0, "over 1: two; over -1: five");
        assert_eq!(stability(&plane, 0.0), 1.0);
        assert_eq!(stability(&[-5.0, -6.0], 1.0), 0.0, "nothing is not stable");
    }

    #[test]
    fn granularity_goes_by_size_and_the_best_goes_by_score() {
        let mask = |inside: usize, score: f32| {
            let data = (0..16).map(|i| if i < inside { 1.0 } else { -1.0 }).collect();
            (Logits { width: 4, height: 4, data }, score)
        };
        let masks = [mask(9, 0.7), mask(2, 0.9), mask(15, 0.9)];
        assert_eq!(choose(&masks, None), Some(1), "the first of equals");
        for (g, expected) in [(0.0, 1), (0.2, 1), (0.5, 0), (1.0, 2), (7.0, 2)] {
            assert_eq!(choose(&masks, Some(g)), Some(expected), "{g}");
        }
        assert_eq!((choose(&[], None), choose(&[], Some(0.5))), (None, None));
    }
}
