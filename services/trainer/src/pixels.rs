//! Per-pixel pieces of a training step.

use crate::photos::Stored;
use segwild_objective::background::{Background, PRIOR, SkySums};
use segwild_raster::Projected;
use segwild_scene::{Camera, Image, Pose};

/// A plane at the centre of every splat that is seen, for density control; 0 outside the frame.
pub(crate) fn at_centres(plane: &Image, projected: &dyn Projected) -> Vec<f32> {
    let (w, h) = (plane.width as f32, plane.height as f32);
    projected
        .centres()
        .iter()
        .zip(projected.radii())
        .map(|(c, &r)| {
            let inside = r > 0.0 && c[0] >= 0.0 && c[1] >= 0.0 && c[0] < w && c[1] < h;
            if inside { plane.data[c[1] as usize * plane.width + c[0] as usize] } else { 0.0 }
        })
        .collect()
}

/// The initial background of a photo: a sky fitted to its sky pixels, or else its mean colour.
pub(crate) fn first_background(stored: &Stored, camera: &Camera, pose: &Pose) -> Background {
    let photo = &stored.levels[0];
    let seen = |i: usize| photo.sky(i).then(|| (photo.colour(i), 1.0));
    let fit = || Background::fit(SkySums::of(camera, pose, 2, seen), PRIOR);
    let sky = stored.has_sky.then(fit).flatten();
    sky.unwrap_or_else(|| {
        let (mut sum, mut n) = ([0.0f64; 3], 0.0f64);
        for i in (0..photo.pixels()).filter(|&i| photo.valid(i)) {
            let c = photo.colour(i);
            for k in 0..3 {
                sum[k] += f64::from(c[k]);
            }
            n += 1.0;
        }
        Background::constant(sum.map(|s| (s / n.max(1.0)) as f32))
    })
}
