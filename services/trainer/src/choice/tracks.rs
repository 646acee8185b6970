//! Differences in light between photos, from the reconstructed points, before any training.

use crate::Photos;
use crate::appearances::{AffineColour, IDENTITY, fit, undo};
use segwild_scene::{Image, Scene};
use serde::{Deserialize, Serialize};

/// Photos that must have seen a point for it to count.
const SEEN_BY: usize = 3;

/// How the colours of the reconstructed points differ between photos, as root mean squares in [0, 1].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tracks {
    /// Points that count.
    pub points: usize,
    /// How far a point's colour in a photo is from its mean over photos.
    pub raw: f32,
    /// The same after each photo has a colour matrix, fitted on half of its points and measured on the others.
    pub after_affine: f32,
}

impl Tracks {
    /// How far the light differs between photos: what the colour matrices explain, as a root mean square in [0, 1].
    pub fn light(&self) -> f32 {
        (self.raw.powi(2) - self.after_affine.powi(2)).max(0.0).sqrt()
    }

    /// Share of the variance that the colour matrices explain.
    pub fn explained(&self) -> f32 {
        if self.raw > 0.0 { 1.0 - (self.after_affine / self.raw).powi(2) } else { 0.0 }
    }
}

/// One sighting of a point: its photo, and the colour there.
struct Sighting {
    point: usize,
    colour: [f32; 3],
}

/// How the points' colours differ between photos; `None` with too few points.
pub(super) fn tracks(scene: &Scene, photos: &dyn Photos, views: &[usize]) -> Option<Tracks> {
    let mut of_view: Vec<Vec<Sighting>> = Vec::new();
    let mut seen = vec![0usize; scene.points.len()];
    for &view in views {
        let photo = photos.photo(view).ok()?;
        let full = &scene.views[view].camera;
        let (w, h) = (photo.image.width as f32, photo.image.height as f32);
        let mut sightings = Vec::new();
        for (point, p) in scene.points.iter().enumerate() {
            let Some(o) = p.track.iter().find(|o| o.view as usize == view) else { continue };
            let (x, y) = (o.pixel[0] / full.width as f32 * w, o.pixel[1] / full.height as f32 * h);
            let inside = x >= 1.0 && y >= 1.0 && x < w - 1.0 && y < h - 1.0;
            let i = y as usize * photo.image.width + x as usize;
            if inside && photo.valid.as_ref().is_none_or(|m| m.index(i)) {
                seen[point] += 1;
                sightings.push(Sighting { point, colour: mean_around(&photo.image, x as usize, y as usize) });
            }
        }
        of_view.push(sightings);
    }
    for sightings in &mut of_view {
        sightings.retain(|s| seen[s.point] >= SEEN_BY);
    }
    let points = seen.iter().filter(|&&n| n >= SEEN_BY).count();
    if points < 50 {
        return None;
    }
    // Each point's colour in one light: first its mean, then what fits all photos' matrices best.
    let mut own = means(scene.points.len(), &of_view, &vec![IDENTITY; of_view.len()]);
    let raw = spread(&own, &of_view, &vec![IDENTITY; of_view.len()], |_| true);
    let mut matrices = Vec::new();
    for _ in 0..3 {
        matrices = of_view
            .iter()
            .map(|sightings| {
                let taught = sightings.iter().filter(|s| s.point % 2 == 0);
                fit(taught.map(|s| (own[s.point], 1.0, s.colour, 1.0)))
            })
            .collect();
        own = means(scene.points.len(), &of_view, &matrices);
    }
    let after_affine = spread(&own, &of_view, &matrices, |point| point % 2 == 1);
    Some(Tracks { points, raw, after_affine })
}

/// Mean over 3 x 3 pixels: a point is found to about a pixel.
fn mean_around(image: &Image, x: usize, y: usize) -> [f32; 3] {
    std::array::from_fn(|c| {
        let rows = y - 1..=y + 1;
        rows.flat_map(|v| (x - 1..=x + 1).map(move |u| image.at(c, u, v))).sum::<f32>() / 9.0
    })
}

/// Per point, the mean over its photos of the colour that the photo's matrix turns into the one seen.
fn means(points: usize, of_view: &[Vec<Sighting>], matrices: &[AffineColour]) -> Vec<[f32; 3]> {
    let mut sums = vec![([0.0f32; 3], 0.0f32); points];
    for (sightings, matrix) in of_view.iter().zip(matrices) {
        for s in sightings {
            let colour = undo(matrix, &[s.colour])[0];
            let (sum, n) = &mut sums[s.point];
            (0..3).for_each(|c| sum[c] += colour[c]);
            *n += 1.0;
        }
    }
    sums.into_iter().map(|(sum, n)| sum.map(|s| s / n.max(1.0))).collect()
}

/// Root mean square of the difference of seen and expected colours, without the worst tenth: transients, and wrong
/// matches.
fn spread(
    own: &[[f32; 3]],
    of_view: &[Vec<Sighting>],
    matrices: &[AffineColour],
    measured: impl Fn(usize) -> bool,
) -> f32 {
    let mut squares: Vec<f32> = Vec::new();
    for (sightings, m) in of_view.iter().zip(matrices) {
        for s in sightings.iter().filter(|s| measured(s.point)) {
            let o = own[s.point];
            let off = |c: usize| {
                m[4 * c] * o[0] + m[4 * c + 1] * o[1] + m[4 * c + 2] * o[2] + m[4 * c + 3] - s.colour[c]
            };
            squares.push((0..3).map(|c| off(c).powi(2)).sum::<f32>() / 3.0);
        }
    }
    squares.sort_by(f32::total_cmp);
    squares.truncate(squares.len() * 9 / 10);
    (squares.iter().map(|&s| f64::from(s)).sum::<f64>() / squares.len().max(1) as f64).sqrt() as f32
}
