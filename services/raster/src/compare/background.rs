//! The background: one colour, or a smooth sky, and the sums over a photo that it is fitted to.

use super::PhotoTarget;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use segwild_scene::{Camera, Image, Pose};

/// Basis functions of a sky: spherical harmonics up to order 2.
pub const BASES: usize = 9;
/// A sky is fitted to every so many pixels and rows of a photo.
pub const STRIDE: usize = 3;
/// Least weight of a pixel that enters the fit.
pub const LEAST_SEEN: f32 = 0.01;

/// The basis functions in a direction, without the usual constants: they would only rescale the coefficients. The first
/// is 1.
pub fn basis(d: Vec3) -> [f32; BASES] {
    let Vec3 { x, y, z } = d;
    [1.0, x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0]
}

/// World direction of the ray through a pixel's centre, normalised.
pub fn direction(camera: &Camera, pose: &Pose, x: usize, y: usize) -> Vec3 {
    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
    (pose.rotation.transpose() * ray).normalize()
}

/// Background colour in a direction, in the scene's colours, unbounded: behind a dark statue before a bright sky it is
/// many times the range of an image, and the photo's appearance maps it back.
pub fn background(coefficients: &[[f32; 3]], direction: Vec3) -> [f32; 3] {
    let mut out = [0.0; 3];
    for (b, c) in basis(direction).iter().zip(coefficients) {
        for k in 0..3 {
            out[k] += b * c[k];
        }
    }
    out
}

/// The background of a whole frame, three planes.
pub fn paint(coefficients: &[[f32; 3]], camera: &Camera, pose: &Pose) -> Image {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let mut image = Image::zeros(w, h, 3);
    if let [colour] = coefficients {
        for c in 0..3 {
            image.plane_mut(c).fill(colour[c]);
        }
        return image;
    }
    let (red, rest) = image.data.split_at_mut(w * h);
    let (green, blue) = rest.split_at_mut(w * h);
    red.par_chunks_mut(w).zip(green.par_chunks_mut(w)).zip(blue.par_chunks_mut(w)).enumerate().for_each(
        |(y, ((r, g), b))| {
            for x in 0..w {
                [r[x], g[x], b[x]] = background(coefficients, direction(camera, pose, x, y));
            }
        },
    );
    image
}

/// Sums over a photo that the background is fitted to.
#[derive(Clone, Debug, PartialEq)]
pub enum BackgroundSums {
    /// For the fit of a sky.
    Sky(Box<SkySums>),
    /// For a step towards one colour.
    Colour(ColourSums),
}

/// Normal equations of a sky, from pixels with a colour and a weight.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SkySums {
    /// Sums of weight times the products of two basis functions; the lower half.
    pub products: [[f64; BASES]; BASES],
    /// Sums of weight times basis function times colour.
    pub colours: [[f64; 3]; BASES],
    /// Sum of the weights.
    pub total: f64,
    /// Pixels that were visited.
    pub looked: f64,
}

impl SkySums {
    /// Sums over every `stride`-th pixel of every `stride`-th row for which `seen` gives a colour and a weight.
    pub fn of(
        camera: &Camera,
        pose: &Pose,
        stride: usize,
        seen: impl Fn(usize) -> Option<([f32; 3], f32)>,
    ) -> SkySums {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut sums = SkySums::default();
        for y in (0..h).step_by(stride) {
            for x in (0..w).step_by(stride) {
                sums.looked += 1.0;
                let Some((colour, weight)) = seen(y * w + x) else { continue };
                let (colour, weight) = (colour.map(f64::from), f64::from(weight));
                sums.total += weight;
                sums.add(direction(camera, pose, x, y), colour, weight);
            }
        }
        sums
    }

    /// Of a photo: its sky, and whatever else no splat covers (a sea, a haze), so that no splat has to float there.
    pub(super) fn of_photo(
        camera: &Camera,
        pose: &Pose,
        target: &PhotoTarget,
        alpha: &Image,
        weights: &[f32],
    ) -> SkySums {
        let open = |i: usize| (1.0 - alpha.data[i]).max(0.0).powi(2) * weights[i];
        SkySums::of(camera, pose, STRIDE, |i| {
            let weight = if target.is(i, PhotoTarget::SKY) { 1.0 } else { open(i) };
            (weight > LEAST_SEEN).then(|| (target.colour(i), weight))
        })
    }

    /// Adds a colour seen in a direction; not to [`SkySums::total`].
    pub fn add(&mut self, direction: Vec3, colour: [f64; 3], weight: f64) {
        let b = basis(direction).map(f64::from);
        for i in 0..BASES {
            let wb = weight * b[i];
            for j in 0..=i {
                self.products[i][j] += wb * b[j];
            }
            for c in 0..3 {
                self.colours[i][c] += wb * colour[c];
            }
        }
    }
}

/// How far, and with what weight, a photo pulls the background colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColourSums {
    /// Sums of weight times background transmittance times colour difference, per channel.
    pub pull: [f32; 3],
    /// Sum of weight times squared background transmittance, plus the weight that holds the colour.
    pub total: f32,
}

/// The weight that holds the colour where it is, as a share of the pixels.
pub const HOLD: f32 = 0.01;

impl ColourSums {
    pub(super) fn of(shown: &Image, photo: &Image, alpha: &Image, weights: &[f32]) -> ColourSums {
        let mut sums = ColourSums { pull: [0.0; 3], total: HOLD * alpha.pixels() as f32 };
        for (a, w) in alpha.data.iter().zip(weights) {
            sums.total += w * (1.0 - a) * (1.0 - a);
        }
        for c in 0..3 {
            for (((s, t), a), w) in shown.plane(c).iter().zip(photo.plane(c)).zip(&alpha.data).zip(weights) {
                sums.pull[c] += w * (1.0 - a) * (t - s);
            }
        }
        sums
    }
}
