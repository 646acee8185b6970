//! Snaps a rough mask to the photo's own boundaries: the decoder gets it as an earlier answer, with its box and a click in its
//! middle, and of the decoder's masks the one of highest IoU with the rough mask is taken.

use super::decoder::Query;
use super::logits::Logits;
use super::prompt::{CORNERS, INSIDE};
use super::{Encoded, Sam, check};
use crate::VisionError;
use segwild_scene::{Image, Mask, ScoredMask, logit};
use std::time::Instant;

/// Bound of a certainty's logits, either way: a render is less certain than a network.
const SURE: f32 = 6.0;

impl Sam {
    pub(super) fn snap(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError> {
        check(image)?;
        crate::provider::check_certainty(image, certainty)?;
        let (w, h) = (image.width as u32, image.height as u32);
        let rough = Mask::over(w, h, certainty.plane(0), 0.5);
        if rough.is_empty() {
            return Ok(ScoredMask { mask: rough, predicted_iou: 0.0, stability: 0.0 });
        }
        let (encoded, _) = self.encoded(image)?;
        let previous = self.decoder.takes_logits().map(|side| logits_of(certainty, &encoded, side));
        let [low, high] = bounds(&rough);
        let mut points = vec![(low, CORNERS[0]), (high, CORNERS[1])];
        points.retain(|_| self.decoder.takes_boxes());
        points.push((middle(&rough), INSIDE));
        let query = Query { points, previous: previous.as_ref() };
        let began = Instant::now();
        let masks = self.decoder.ask(&encoded, &[query])?.pop().unwrap_or_default();
        let offset = self.stability_offset;
        let like = masks
            .iter()
            .map(|(logits, score)| self.upscale(&encoded, logits).mask(logits, score.clamp(0.0, 1.0), offset))
            .reduce(|best, m| if m.mask.iou(&rough) > best.mask.iou(&rough) { m } else { best });
        self.count(|work| {
            work.prompts += 1;
            work.decode_s += began.elapsed().as_secs_f64();
        });
        like.ok_or_else(|| VisionError::Model("the decoder gave no mask".into()))
    }
}

/// A certainty as the logits of an earlier answer; beside the photo nothing is inside.
fn logits_of(certainty: &Image, encoded: &Encoded, side: usize) -> Logits {
    let plane = Image {
        channels: 1,
        data: certainty.plane(0).iter().map(|v| if v.is_finite() { *v } else { 0.0 }).collect(),
        ..*certainty
    };
    let [width, height] = encoded.fit.cells(side, side);
    let small = plane.resized(width, height);
    let mut data = vec![-SURE; side * side];
    for y in 0..height {
        for x in 0..width {
            data[y * side + x] = logit(small.at(0, x, y)).clamp(-SURE, SURE);
        }
    }
    // Certainties beyond [0, 1] have no logarithm.
    data.iter_mut().filter(|v| v.is_nan()).for_each(|v| *v = -SURE);
    Logits { width: side, height: side, data }
}

/// The corners of a mask's bounding box, pixels' far edges included.
pub(crate) fn bounds(mask: &Mask) -> [[f32; 2]; 2] {
    let (mut low, mut high) = ([f32::MAX; 2], [0.0f32; 2]);
    for (x, y) in mask.pixels() {
        for (axis, v) in [(0, x as f32), (1, y as f32)] {
            low[axis] = low[axis].min(v);
            high[axis] = high[axis].max(v + 1.0);
        }
    }
    [low, high]
}

/// The centre of the pixel farthest from everything outside the mask and from the frame; the first of equals.
pub(crate) fn middle(mask: &Mask) -> [f32; 2] {
    let depths = mask.depths();
    let mut best = (f32::NEG_INFINITY, [0.0; 2]);
    for (x, y) in mask.pixels() {
        let depth = depths[(y * mask.width() + x) as usize];
        if depth > best.0 {
            best = (depth, [x as f32 + 0.5, y as f32 + 0.5]);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_box_and_the_middle_are_those_of_the_mask() {
        let mask = Mask::from_fn(40, 30, |x, y| {
            (10..21).contains(&x) && (5..16).contains(&y) || (y == 25 && x < 30)
        });
        assert_eq!(bounds(&mask), [[0.0, 5.0], [30.0, 26.0]]);
        assert_eq!(middle(&mask), [15.5, 10.5]);
        // All of the photo: nothing is outside, and the middle is that of the frame.
        assert_eq!(middle(&Mask::full(5, 5)), [2.5, 2.5]);
    }
}
