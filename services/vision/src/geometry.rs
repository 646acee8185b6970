//! Sky by geometry: where the reconstruction saw nothing, above what it saw, out to the photo's boundaries; and sky by
//! colour, doubted where the reconstruction saw something in it, alone or together with a network's.

use crate::{Builtin, PromptSegmenter, SkyDetector, SkyNetwork, VisionError};
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

/// Pixels from the outline of a sky, as a share of the long side, from which a point lies deep in it: what stands before
/// a sky has points along its outline.
const DEEP: f32 = 0.01;
/// Points in a sky, for their size, as a share of those in the photo for its size: from here on it is none. Photos of
/// `liberty` and `sacre_coeur` have at most .008 deep in theirs, façades taken for sky .1 to 1.
const PEOPLED: f32 = 0.15;
/// A sky under this share of the photo is more often a ceiling, and must be clean: so many points of it in all, of so
/// high a share, and it is none. The ceiling of `fern` is 8 % of its photos, with 5 to 11 points at .07 to .13, and fewer at half the size.
const SMALL: (f32, usize, f32) = (0.15, 3, 0.05);

/// Finds the sky by colour and boundaries, and takes it back where points that the photo saw lie in it.
pub(crate) struct ColourSky(pub Arc<Builtin>);

impl SkyDetector for ColourSky {
    fn key(&self) -> String {
        format!("{}-doubted-1", SkyDetector::key(&*self.0))
    }

    fn by_points(&self) -> bool {
        true
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        SkyDetector::sky(&*self.0, image)
    }

    fn sky_above(&self, image: &Image, seen: &[[f32; 2]]) -> Result<Mask, VisionError> {
        Ok(undoubted(self.sky(image)?, seen))
    }
}

/// Finds what a network or [`ColourSky`] takes for sky. Each misses what the other finds, and a sky that is missed is filled
/// with splats that float: colour stops at the edge of a bank of clouds, a network does not see a hazy sky above water.
pub(crate) struct JointSky {
    pub network: SkyNetwork,
    pub colour: ColourSky,
}

impl SkyDetector for JointSky {
    fn key(&self) -> String {
        format!("{}-or-{}", self.network.key(), self.colour.key())
    }

    fn by_points(&self) -> bool {
        true
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        self.sky_above(image, &[])
    }

    fn sky_above(&self, image: &Image, seen: &[[f32; 2]]) -> Result<Mask, VisionError> {
        Ok(undoubted(self.network.sky(image)?, seen).or(&self.colour.sky_above(image, seen)?))
    }
}

/// A sky, or none where points that the photo saw say so.
fn undoubted(sky: Mask, seen: &[[f32; 2]]) -> Mask {
    let none = seen.len() >= FEW && peopled(&sky, seen);
    if none { Mask::empty(sky.width(), sky.height()) } else { sky }
}

/// Whether points lie where there should be nothing.
fn peopled(sky: &Mask, seen: &[[f32; 2]]) -> bool {
    let (w, h) = (sky.width() as usize, sky.height() as usize);
    let share = sky.count() as f32 / (w * h) as f32;
    if share == 0.0 {
        return false;
    }
    let inward = sky.not().distances();
    let deep = DEEP * w.max(h) as f32;
    let within = |least: f32| {
        let counts = |p: &&[f32; 2]| sky.at(p[0], p[1]) && inward[p[1] as usize * w + p[0] as usize] > least;
        seen.iter().filter(counts).count()
    };
    let density = |points: usize| points as f32 / seen.len() as f32 / share;
    let (all, far) = (within(0.0), within(deep));
    let (small, several, high) = SMALL;
    far >= 3 && density(far) > PEOPLED || share < small && all >= several && density(all) > high
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

    #[test]
    fn a_ceiling_or_a_facade_taken_for_sky_is_none_where_points_were_seen_in_it() {
        let beside = |sky: &Mask, inside: usize| {
            let mut seen: Vec<[f32; 2]> =
                (0..200).map(|i| [(i % 20) as f32 * 5.0, 75.0 + (i / 20) as f32]).collect();
            let pixels: Vec<(u32, u32)> = sky.pixels().collect();
            seen.extend((0..inside).map(|i| {
                let (x, y) = pixels[pixels.len() * (2 * i + 1) / (2 * inside)];
                [x as f32 + 0.5, y as f32 + 0.5]
            }));
            peopled(sky, &seen)
        };
        let half = Mask::from_fn(100, 100, |_, y| y < 50);
        assert!(!beside(&half, 0) && !beside(&half, 4), "a kite or two, and what was matched wrongly");
        assert!(beside(&half, 40), "a façade");
        let ceiling = Mask::from_fn(100, 100, |x, y| x < 40 && y < 20);
        assert!(beside(&ceiling, 6) && !beside(&ceiling, 2));
        // Points on a skyline lie on its very outline.
        let skyline: Vec<[f32; 2]> = (0..100).map(|x| [x as f32 + 0.5, 49.5]).collect();
        assert!(!peopled(&half, &skyline));
        assert!(!peopled(&Mask::empty(10, 10), &skyline));
        // A point outside the frame is no point in the sky.
        assert!(!peopled(&half, &vec![[-5.0, -5.0]; 60]));
    }
}
