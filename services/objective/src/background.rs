//! The background: one colour, or a smooth sky, and the sums over a photo that it is fitted to.

use crate::photo_target::PhotoTarget;
use glam::{Vec2, Vec3};
use rayon::prelude::*;
use segwild_nn::solve;
use segwild_scene::{Camera, Image, Pose, TASK_PIXELS, in_pieces, per_piece};
use std::array;
use std::ops::Range;
use wincode::{SchemaRead, SchemaWrite};

/// Basis functions of a sky: spherical harmonics up to order 2.
pub const BASES: usize = 9;
/// A sky is fitted to every so many pixels and rows of a photo.
pub const STRIDE: usize = 3;
/// Least weight of a pixel that enters the fit.
pub const LEAST_SEEN: f32 = 0.01;

/// Background colour as a function of the world direction: spherical harmonics of order 0 (one
/// entry, a constant) or 2 (nine entries), each r, g, b.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Background {
    /// Coefficients, one per basis function.
    pub coefficients: Vec<[f32; 3]>,
}

/// Weight of the mean colour all around, as a share of the weight of the pixels, where the whole photo is fitted.
/// Five times as much flattens real skies: `liberty` loses .3 dB.
pub const PRIOR: f64 = 0.01;
/// The same where half of a photo is fitted, and the other half is rendered.
pub const PRIOR_OF_HALF: f64 = 0.02;

impl Background {
    /// One colour.
    pub fn constant(colour: [f32; 3]) -> Background {
        Background { coefficients: vec![colour] }
    }

    /// Fits a smooth background to the pixels of a photo, by least squares. Directions without pixels
    /// are held to the mean colour, with `prior` of the pixels' weight. `None` when the weights of the pixels
    /// are less than 1 in 500 of them.
    pub fn fit(mut sums: SkySums, prior: f64) -> Option<Background> {
        if sums.total * 500.0 < sums.looked || sums.total == 0.0 {
            return None;
        }
        // The mean colour, seen from the corners, edges and faces of a cube all around. The first basis function is 1.
        let mean = sums.colours[0].map(|m| m / sums.total);
        for k in (0..27).filter(|&k| k != 13) {
            let d = Vec3::new((k % 3) as f32 - 1.0, (k / 3 % 3) as f32 - 1.0, (k / 9) as f32 - 1.0);
            sums.add(d.normalize(), mean, prior * sums.total / 26.0);
        }
        for i in 0..BASES {
            for j in 0..i {
                sums.products[j][i] = sums.products[i][j];
            }
        }
        let coefficients =
            solve(sums.products, sums.colours).iter().map(|row| row.map(|v| v as f32)).collect();
        Some(Background { coefficients })
    }

    /// Learns from a photo. A sky is refitted, a quarter of the way per visit. One colour moves towards that which
    /// fits best behind the splats: least squares in closed form, half of the way per visit.
    pub fn learn(&mut self, seen: &BackgroundSums) {
        match seen {
            BackgroundSums::Sky(sums) => {
                if let Some(fitted) = Background::fit(SkySums::clone(sums), PRIOR) {
                    *self = self.towards(&fitted, 0.25);
                }
            }
            BackgroundSums::Colour(ColourSums { pull, total }) => {
                let [colour] = self.coefficients.as_mut_slice() else { return };
                for c in 0..3 {
                    colour[c] = (colour[c] + 0.5 * pull[c] / total).clamp(0.0, 1.0);
                }
            }
        }
    }

    /// The background that lies a share `t` of the way towards another.
    pub fn towards(&self, other: &Background, t: f32) -> Background {
        let at = |b: &Background, k: usize| b.coefficients.get(k).copied().unwrap_or_default();
        let n = self.coefficients.len().max(other.coefficients.len());
        let mix = |k: usize| std::array::from_fn(|c| (1.0 - t) * at(self, k)[c] + t * at(other, k)[c]);
        Background { coefficients: (0..n).map(mix).collect() }
    }

    /// The mean of several; a constant counts as a sky without direction.
    pub fn mean<'a>(of: impl IntoIterator<Item = &'a Background>) -> Background {
        let mut sum = vec![[0.0f32; 3]; BASES];
        let (mut n, mut longest) = (0, 1);
        for b in of {
            n += 1;
            longest = longest.max(b.coefficients.len());
            for (s, c) in sum.iter_mut().zip(&b.coefficients) {
                for k in 0..3 {
                    s[k] += c[k];
                }
            }
        }
        if n == 0 {
            return Background::constant([0.5; 3]);
        }
        sum.truncate(longest);
        Background { coefficients: sum.iter().map(|s| s.map(|v| v / n as f32)).collect() }
    }

    /// Colour in a direction ([`background`]).
    pub fn colour(&self, direction: Vec3) -> [f32; 3] {
        background(&self.coefficients, direction)
    }

    /// The background of a whole frame.
    pub fn paint(&self, camera: &Camera, pose: &Pose) -> Image {
        paint(&self.coefficients, camera, pose)
    }
}

/// The basis functions in a direction, without the usual constants: they would only rescale the coefficients. The first
/// is 1.
#[inline]
pub fn basis(d: Vec3) -> [f32; BASES] {
    let Vec3 { x, y, z } = d;
    [1.0, x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0]
}

/// World direction of the ray through a pixel's centre, normalised.
#[inline]
pub fn direction(camera: &Camera, pose: &Pose, x: usize, y: usize) -> Vec3 {
    let ray = camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
    (pose.rotation.transpose() * ray).normalize()
}

/// Background colour in a direction, in the scene's colours, unbounded: behind a dark statue before a bright sky it is
/// many times the range of an image, and the photo's appearance maps it back.
#[inline]
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
        seen: impl Fn(usize) -> Option<([f32; 3], f32)> + Sync,
    ) -> SkySums {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let of_row = |row: usize| {
            let (y, mut sums) = (row * stride, SkySums::default());
            for x in (0..w).step_by(stride) {
                sums.looked += 1.0;
                let Some((colour, weight)) = seen(y * w + x) else { continue };
                let (colour, weight) = (colour.map(f64::from), f64::from(weight));
                sums.total += weight;
                sums.add(direction(camera, pose, x, y), colour, weight);
            }
            sums
        };
        let task = TASK_PIXELS.div_ceil((w * stride).max(1));
        let rows = (0..h.div_ceil(stride)).into_par_iter().with_min_len(task).map(of_row);
        // In the order of the rows: the same on any number of cores.
        let rows: Vec<SkySums> = rows.collect();
        rows.iter().fold(SkySums::default(), |sums, row| sums.plus(row))
    }

    fn plus(mut self, other: &SkySums) -> SkySums {
        let products = self.products.as_flattened_mut().iter_mut().zip(other.products.as_flattened());
        products.for_each(|(sum, v)| *sum += v);
        let colours = self.colours.as_flattened_mut().iter_mut().zip(other.colours.as_flattened());
        colours.for_each(|(sum, v)| *sum += v);
        self.total += other.total;
        self.looked += other.looked;
        self
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
        let of_piece = |piece: Range<usize>| {
            let mut sums = [0.0f32; 4];
            for i in piece.clone() {
                let open = 1.0 - alpha.data[i];
                sums[3] += weights[i] * open * open;
            }
            for (c, sum) in sums.iter_mut().enumerate().take(3) {
                let (shown, photo) = (&shown.plane(c)[piece.clone()], &photo.plane(c)[piece.clone()]);
                let open = alpha.data[piece.clone()].iter().zip(&weights[piece.clone()]);
                for ((s, t), (a, w)) in shown.iter().zip(photo).zip(open) {
                    *sum += w * (1.0 - a) * (t - s);
                }
            }
            sums.map(f64::from)
        };
        let pieces = per_piece(alpha.pixels(), of_piece);
        let [r, g, b, open] =
            pieces.iter().fold([0.0; 4], |sums, piece| array::from_fn(|k| sums[k] + piece[k]));
        let total = HOLD * alpha.pixels() as f32 + open as f32;
        ColourSums { pull: [r, g, b].map(|v| v as f32), total }
    }
}

/// Adds `(1 - alpha) * background`.
pub fn add_background(image: &mut Image, alpha: &Image, background: &Image) {
    for c in 0..3 {
        let background = background.plane(c);
        in_pieces(image.plane_mut(c), |first, piece| {
            for ((v, a), b) in piece.iter_mut().zip(&alpha.data[first..]).zip(&background[first..]) {
                *v += (1.0 - a) * b;
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> (Camera, Pose) {
        let camera = Camera { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        (camera, Pose::look_at(Vec3::new(1.0, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y))
    }

    #[test]
    fn a_gradient_sky_is_recovered_from_its_upper_half() {
        let (camera, pose) = camera();
        let truth = |i: usize| {
            let d = direction(&camera, &pose, i % 40, i / 40);
            [0.4 - 0.3 * d.y, 0.5, 0.6 + 0.1 * d.x]
        };
        let seen = |i: usize| (i < 600).then(|| (truth(i), 1.0));
        let fit = Background::fit(SkySums::of(&camera, &pose, 1, seen), PRIOR).unwrap();
        let image = fit.paint(&camera, &pose);
        for i in 0..600 {
            for c in 0..3 {
                assert!((image.data[c * 1200 + i] - truth(i)[c]).abs() < 0.02);
            }
        }
        assert!(Background::fit(SkySums::of(&camera, &pose, 1, |_| None), PRIOR).is_none());
        // Far from what it saw it stays bounded.
        assert!(fit.colour(Vec3::new(0.0, 1.0, 0.0)).iter().all(|v| (0.0..=1.0).contains(v)));
    }

    #[test]
    fn the_mean_of_a_constant_and_a_sky_keeps_both() {
        let a = Background::constant([0.2; 3]);
        let mut b = Background { coefficients: vec![[0.0; 3]; BASES] };
        b.coefficients[0] = [0.6; 3];
        assert!((Background::mean([&a, &b]).colour(Vec3::Z)[1] - 0.4).abs() < 1e-6);
    }
}
