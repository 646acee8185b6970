//! Sky by geometry: where the reconstruction has no points, above its points, out to the photo's boundaries; and sky by
//! colour, alone or together with a network's, without the parts in which the reconstruction has points.

use crate::{Builtin, PromptSegmenter, SkyDetector, SkyNetwork, VisionError};
use segwild_scene::statistics::upper_median;
use segwild_scene::{Image, Mask};
use std::sync::Arc;

/// With fewer points than this a photo's geometry is not used.
const FEW: usize = 20;
/// Columns that a point stands for, to either side, and how far above it the thing may still go on; shares of the
/// photo's width and height.
const BESIDE: f32 = 0.06;
const ABOVE: f32 = 0.03;

/// Finds the sky by the points that lie in a photo. Colours play no part: a night sky is found as well as a blue one, and a
/// wall without points at the top of the photo is taken for sky.
pub(crate) struct GeometrySky(pub Arc<Builtin>);

impl SkyDetector for GeometrySky {
    fn key(&self) -> String {
        format!("sky-by-points-2-{}", PromptSegmenter::key(&*self.0))
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

/// Pixels from the outline of a sky, as a share of the long side, from which a point lies deep in it: objects before
/// a sky have points along its outline.
const DEEP: f32 = 0.01;
/// Density of points deep in a sky, as a share of the photo's density, and their number, from which on the mask is no sky.
/// All but one of 50 skies of `liberty` and `sacre_coeur` have at most .005; the walls of `desk`, which have next to no points,
/// .013 and more, the ceiling of `fern` .004 to .028.
const PEOPLED: (f32, usize) = (0.01, 4);
/// The same for one of a sky's parts, which may be false beside a true one: façades and lawns have .1 to 2.
const PART: (f32, usize) = (0.1, 3);
/// A sky under this share of the photo is more often a ceiling: here the density and number of all its points, not only the
/// deep ones, decide. The ceiling of `fern` is 8 % of its photos, with few points deep in it.
const SMALL: (f32, (f32, usize)) = (0.15, (0.05, 3));

/// Finds the sky by colour and boundaries, without the parts in which points lie.
pub(crate) struct ColourSky(pub Arc<Builtin>);

impl SkyDetector for ColourSky {
    fn key(&self) -> String {
        format!("{}-pruned-2", SkyDetector::key(&*self.0))
    }

    fn by_points(&self) -> bool {
        true
    }

    fn sky(&self, image: &Image) -> Result<Mask, VisionError> {
        SkyDetector::sky(&*self.0, image)
    }

    fn sky_above(&self, image: &Image, seen: &[[f32; 2]]) -> Result<Mask, VisionError> {
        Ok(without_points(self.sky(image)?, seen))
    }
}

/// The union of a network's sky and [`ColourSky`]. Each misses parts that the other finds, and a missed sky is filled with
/// floating splats: colour stops at the edge of a bank of clouds, a network misses a hazy sky above water.
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
        Ok(without_points(self.network.sky(image)?, seen).or(&self.colour.sky_above(image, seen)?))
    }
}

/// A sky without the parts in which points lie; empty where too many points lie in the rest.
fn without_points(sky: Mask, seen: &[[f32; 2]]) -> Mask {
    if seen.len() < FEW || sky.is_empty() {
        return sky;
    }
    let (width, pixels) = (sky.width() as usize, sky.width() as usize * sky.height() as usize);
    let (parts, count) = sky.components();
    let inward = sky.not().distances();
    let deep = DEEP * sky.width().max(sky.height()) as f32;
    let mut found = vec![Peopled::default(); count + 1];
    parts.iter().for_each(|&part| found[part as usize].area += 1);
    for at in seen.iter().filter(|p| sky.at(p[0], p[1])) {
        let i = at[1] as usize * width + at[0] as usize;
        let part = &mut found[parts[i] as usize];
        part.points += 1;
        part.deep += usize::from(inward[i] > deep);
    }
    // Of the points in the photo, for the size of a part of it.
    let over = |points: usize, area: usize, (share, least): (f32, usize)| {
        let expected = seen.len() as f32 * area as f32 / pixels as f32;
        points >= least && points as f32 > share * expected
    };
    let kept: Vec<bool> = found.iter().map(|part| !over(part.deep, part.area, PART)).collect();
    let mut rest = Peopled::default();
    for part in (1..=count).filter(|&k| kept[k]).map(|k| found[k]) {
        rest.area += part.area;
        rest.points += part.points;
        rest.deep += part.deep;
    }
    let small = (rest.area as f32) < SMALL.0 * pixels as f32;
    if over(rest.deep, rest.area, PEOPLED) || small && over(rest.points, rest.area, SMALL.1) {
        return Mask::empty(sky.width(), sky.height());
    }
    Mask::from_fn(sky.width(), sky.height(), |x, y| {
        let part = parts[y as usize * width + x as usize] as usize;
        part > 0 && kept[part]
    })
}

/// Points in a part of a sky.
#[derive(Clone, Copy, Default)]
struct Peopled {
    /// Its pixels.
    area: usize,
    /// All points in it.
    points: usize,
    /// Those that do not lie along its outline.
    deep: usize,
}

/// Probability per pixel of being sky, by the points alone.
fn openness(width: usize, height: usize, seen: &[[f32; 2]]) -> Image {
    let beside = (BESIDE * width as f32).max(2.0);
    let margin = (ABOVE * height as f32).max(2.0);
    let middle = upper_median(seen.iter().map(|p| p[1]).collect()).expect("points are seen");
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
    fn what_lies_above_all_points_is_sky_whatever_its_colour() {
        let (image, seen) = tower();
        let detector = GeometrySky(Arc::new(Builtin::new()));
        let sky = detector.sky_above(&image, &seen).unwrap();
        let truth = Mask::from_fn(96, 72, |x, y| y < 20 || (y < 52 && !(36..60).contains(&x)));
        assert!(sky.iou(&truth) > 0.85, "{}", sky.iou(&truth));
        assert!(detector.sky_above(&image, &seen[..5]).unwrap().is_empty(), "five points are too few");
        assert!(detector.by_points());
    }

    /// The rest of a sky in a photo with 200 points below it and `inside` points in it.
    fn left(sky: &Mask, inside: usize) -> Mask {
        let below = (0..200).map(|i| [(i % 20) as f32 * 5.0, 75.0 + (i / 20) as f32]);
        let pixels: Vec<(u32, u32)> = sky.pixels().collect();
        let within = (0..inside).map(|i| {
            let (x, y) = pixels[pixels.len() * (2 * i + 1) / (2 * inside)];
            [x as f32 + 0.5, y as f32 + 0.5]
        });
        without_points(sky.clone(), &below.chain(within).collect::<Vec<_>>())
    }

    #[test]
    fn a_ceiling_or_a_wall_taken_for_sky_is_none_where_points_lie_in_it() {
        let half = Mask::from_fn(100, 100, |_, y| y < 50);
        for inside in [0, 3] {
            assert_eq!(left(&half, inside), half, "a kite or two, and what was matched wrongly");
        }
        assert!(left(&half, 10).is_empty(), "a wall with next to nothing on it");
        assert!(left(&half, 60).is_empty(), "a façade");
        let ceiling = Mask::from_fn(100, 100, |x, y| x < 40 && y < 20);
        assert!(left(&ceiling, 6).is_empty());
        assert_eq!(left(&ceiling, 2), ceiling);
        // Points on a skyline lie on its very outline.
        let skyline: Vec<[f32; 2]> = (0..100).map(|x| [x as f32 + 0.5, 49.5]).collect();
        assert_eq!(without_points(half.clone(), &skyline), half);
        assert!(without_points(Mask::empty(10, 10), &skyline).is_empty());
        // A point outside the frame is no point in the sky.
        assert_eq!(without_points(half.clone(), &vec![[-5.0, -5.0]; 60]), half);
    }

    #[test]
    fn a_facade_taken_for_sky_does_not_take_the_sky_beside_it_along() {
        let sky = Mask::from_fn(100, 100, |x, y| x < 70 && y < 40);
        let facade = Mask::from_fn(100, 100, |x, y| x > 75 && y < 30);
        let mut seen: Vec<[f32; 2]> =
            (0..200).map(|i| [(i % 20) as f32 * 5.0, 75.0 + (i / 20) as f32]).collect();
        seen.extend((0..40).map(|i| [80.0 + (i % 4) as f32 * 4.0, 5.0 + (i / 4) as f32 * 2.0]));
        assert_eq!(without_points(sky.or(&facade), &seen), sky);
    }
}
