//! The background of a photo: one colour, or a smooth sky.

use crate::appearances::AffineColour;
use glam::Vec3;
use segwild_raster::compare::{self, BASES, BackgroundSums, ColourSums, SkySums};
use segwild_scene::{Camera, Image, Pose};
use wincode::{SchemaRead, SchemaWrite};

/// Background colour as a function of the world direction: spherical harmonics of order 0 (one
/// entry, a constant) or 2 (nine entries), each r, g, b.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Background {
    /// Coefficients, one per basis function.
    pub coefficients: Vec<[f32; 3]>,
}

/// Weight of the mean colour all around, as a share of the weight of the pixels, where the whole photo is fitted.
/// Five times as much flattens real skies: `liberty` loses .3 dB.
pub(crate) const PRIOR: f64 = 0.01;
/// The same where half of a photo is fitted, and the other half is rendered.
pub(crate) const PRIOR_OF_HALF: f64 = 0.02;

impl Background {
    /// One colour.
    pub fn constant(colour: [f32; 3]) -> Background {
        Background { coefficients: vec![colour] }
    }

    /// Fits a smooth background to the pixels of a photo, by least squares. Directions without pixels
    /// are held to the mean colour, with `prior` of the pixels' weight. `None` when the weights of the pixels
    /// are less than 1 in 500 of them.
    pub(crate) fn fit(mut sums: SkySums, prior: f64) -> Option<Background> {
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
    pub(crate) fn learn(&mut self, seen: &BackgroundSums) {
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
    pub(crate) fn towards(&self, other: &Background, t: f32) -> Background {
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

    /// The background that a colour matrix turns into this one.
    pub(crate) fn before(&self, appearance: &AffineColour) -> Background {
        Background { coefficients: crate::appearances::undo(appearance, &self.coefficients) }
    }

    /// Colour in a direction ([`compare::background`]).
    pub fn colour(&self, direction: Vec3) -> [f32; 3] {
        compare::background(&self.coefficients, direction)
    }

    /// The background of a whole frame.
    pub fn paint(&self, camera: &Camera, pose: &Pose) -> Image {
        compare::paint(&self.coefficients, camera, pose)
    }
}

/// Solves a symmetric positive system for several right sides by Cholesky's factorisation.
pub(crate) fn solve<const N: usize, const M: usize>(
    mut a: [[f64; N]; N],
    mut b: [[f64; M]; N],
) -> [[f64; M]; N] {
    for j in 0..N {
        for k in 0..j {
            for i in j..N {
                a[i][j] -= a[i][k] * a[j][k];
            }
        }
        let pivot = a[j][j].max(1e-12).sqrt();
        for i in j..N {
            a[i][j] /= pivot;
        }
        a[j][j] = pivot;
    }
    for c in 0..M {
        for i in 0..N {
            for k in 0..i {
                b[i][c] -= a[i][k] * b[k][c];
            }
            b[i][c] /= a[i][i];
        }
        for i in (0..N).rev() {
            for k in i + 1..N {
                b[i][c] -= a[k][i] * b[k][c];
            }
            b[i][c] /= a[i][i];
        }
    }
    b
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_raster::compare::direction;

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

    /// The sky of a photo whose appearance makes the scene much darker.
    #[test]
    fn a_bright_sky_around_a_dark_statue_keeps_its_colour() {
        let (camera, pose) = camera();
        let sky = |d: Vec3| [0.95, 0.7 - 0.2 * d.y, 0.6 + 0.1 * d.x];
        let seen = |i: usize| Some((sky(direction(&camera, &pose, i % 40, i / 40)), 1.0));
        let background = Background::fit(SkySums::of(&camera, &pose, 1, seen), PRIOR).unwrap();
        for gain in [0.5, 0.25, 0.12] {
            let appearance = [gain, 0.0, 0.0, 0.0, 0.0, gain, 0.0, 0.02, 0.0, 0.0, 0.8 * gain, 0.0];
            let image = background.before(&appearance).paint(&camera, &pose);
            for i in 0..1200 {
                let x = [image.data[i], image.data[1200 + i], image.data[2400 + i], 1.0];
                let wanted = seen(i).unwrap().0;
                for c in 0..3 {
                    let shown: f32 = (0..4).map(|k| appearance[4 * c + k] * x[k]).sum();
                    assert!((shown - wanted[c]).abs() < 0.08, "{gain} {i} {c}: {shown} for {}", wanted[c]);
                }
            }
        }
    }

    #[test]
    fn the_mean_of_a_constant_and_a_sky_keeps_both() {
        let a = Background::constant([0.2; 3]);
        let mut b = Background { coefficients: vec![[0.0; 3]; BASES] };
        b.coefficients[0] = [0.6; 3];
        assert!((Background::mean([&a, &b]).colour(Vec3::Z)[1] - 0.4).abs() < 1e-6);
    }
}
