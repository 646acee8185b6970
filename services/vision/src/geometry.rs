//! Sky by geometry: where the reconstruction saw nothing, above what it saw, out to the photo's boundaries.

use crate::{Builtin, PromptSegmenter, SkyDetector, VisionError};
use segwild_scene::{Image, Mask};
use std::sync::Arc;

/// With fewer points than this a photo's geometry says nothing.
const FEW: usize = 20;
/// Columns that a point stands for, to either side, and how far above it the thing may still go on; shares of the
/// photo's width and height.
const BESIDE: f32 = 0.06;
const ABOVE: f32 = 0.03;

/// Finds the sky by the points that a photo saw. It knows no colours: a night sky is as good as a blue one, and a wall
/// without points at the top of the photo is taken for sky.
pub(crate) struct GeometrySky(pub Arc<Builtin>);

impl SkyDetector for GeometrySky {
    fn key(&self) -> String {
        format!("sky-by-points-1-{}", PromptSegmenter::key(&*self.0))
    }

    fn by_points(&self) -> bool {
        true
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        self.sky_above(image, &[])
    }

    fn sky_above(&self, image: &Image, seen: &[[f32; 2]]) -> Result<Mask, VisionError> {
        crate::builtin::check(image)?;
        if seen.len() < FEW {
            return Ok(Mask::empty(image.width as u32, image.height as u32));
        }
        let certainty = openness(image.width, image.height, seen);
        Ok(self.0.refine(image, &certainty)?.mask)
    }
}

/// How likely each pixel is open to the sky, by the points alone.
fn openness(width: usize, height: usize, seen: &[[f32; 2]]) -> Image {
    let beside = (BESIDE * width as f32).max(2.0);
    let margin = (ABOVE * height as f32).max(2.0);
    let mut rows: Vec<f32> = seen.iter().map(|p| p[1]).collect();
    rows.sort_by(f32::total_cmp);
    let middle = rows[rows.len() / 2];
    let mut out = Image::zeros(width, height, 1);
    for x in 0..width {
        let near = seen.iter().filter(|p| (p[0] - x as f32 - 0.5).abs() <= beside);
        let top = near.map(|p| p[1]).fold(f32::INFINITY, f32::min);
        for y in 0..height {
            let at = y as f32 + 0.5;
            out.data[y * width + x] = match top.is_finite() {
                true if at < top - margin => 0.9,
                true if at < top => 0.4,
                true => 0.03,
                // Nothing was seen in these columns: open above the middle of what was seen elsewhere.
                false if at < middle => 0.8,
                false => 0.3,
            };
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A dark tower before a sky of one grey.
    fn tower() -> (Image, Vec<[f32; 2]>) {
        let (w, h) = (96, 72);
        let mut image = Image::filled(w, h, 3, 0.55);
        let mut seen = Vec::new();
        for y in 20..h {
            for x in 36..60 {
                for c in 0..3 {
                    image.data[(c * h + y) * w + x] = 0.12 + 0.1 * ((x / 3 + y / 3) % 2) as f32;
                }
                if x % 4 == 0 && y % 5 == 0 {
                    seen.push([x as f32 + 0.5, y as f32 + 0.5]);
                }
            }
        }
        for y in 52..h {
            for x in (0..w).filter(|x| !(36..60).contains(x)) {
                for c in 0..3 {
                    image.data[(c * h + y) * w + x] = 0.3 + 0.1 * ((x / 4 + y / 4) % 2) as f32;
                }
                if x % 6 == 0 && y % 6 == 0 {
                    seen.push([x as f32 + 0.5, y as f32 + 0.5]);
                }
            }
        }
        (image, seen)
    }

    #[test]
    fn what_stands_above_all_points_is_sky_whatever_its_colour() {
        let (image, seen) = tower();
        let detector = GeometrySky(Arc::new(Builtin::new()));
        let sky = detector.sky_above(&image, &seen).unwrap();
        let truth = Mask::from_fn(96, 72, |x, y| y < 20 || (y < 52 && !(36..60).contains(&x)));
        assert!(sky.iou(&truth) > 0.85, "{}", sky.iou(&truth));
        assert!(detector.sky_above(&image, &seen[..5]).unwrap().is_empty(), "five points say nothing");
        assert!(detector.by_points());
    }
}
