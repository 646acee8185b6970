//! What is seen behind the splats: a colour, or a smooth sky, per photo.

use crate::looks::Affine;
use glam::Vec3;
use rayon::prelude::*;
use segwild_scene::{Camera, Image, Pose};
use wincode::{SchemaRead, SchemaWrite};

/// Colour behind the splats as a function of the world direction: spherical harmonics of order 0 (one
/// entry, a constant) or 2 (nine entries), each r, g, b.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Background {
    /// Coefficients, one per basis function.
    pub coefficients: Vec<[f32; 3]>,
}

/// Weight of the mean colour all around, as a share of the weight of what was seen.
const PRIOR: f64 = 0.05;

/// Basis functions of order 2.
const BASES: usize = 9;

fn basis(d: Vec3) -> [f32; BASES] {
    let Vec3 { x, y, z } = d;
    // Without the usual constants: they would only rescale the coefficients. The first is 1.
    [1.0, x, y, z, x * y, y * z, x * z, x * x - y * y, 3.0 * z * z - 1.0]
}

/// World direction of the ray through a pixel's centre, normalised.
fn direction(camera: &Camera, pose: &Pose, x: usize, y: usize) -> Vec3 {
    let ray = camera.ray(glam::Vec2::new(x as f32 + 0.5, y as f32 + 0.5));
    (pose.rotation.transpose() * ray).normalize()
}

impl Background {
    /// One colour.
    pub fn constant(colour: [f32; 3]) -> Background {
        Background { coefficients: vec![colour] }
    }

    /// Fits a smooth background to the pixels for which `seen` gives a colour and a weight, by least squares.
    /// Directions that no pixel tells of are held to the mean colour. Looks at every `stride`-th pixel of
    /// every `stride`-th row; `None` when their weights are less than 1 in 500 of them.
    pub fn fit(
        camera: &Camera,
        pose: &Pose,
        stride: usize,
        seen: impl Fn(usize) -> Option<([f32; 3], f32)>,
    ) -> Option<Background> {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut ata = [[0.0f64; BASES]; BASES];
        let mut atb = [[0.0f64; 3]; BASES];
        let (mut total, mut looked) = (0.0f64, 0.0f64);
        let mut add = |d: Vec3, colour: [f64; 3], weight: f64| {
            let b = basis(d).map(f64::from);
            for i in 0..BASES {
                let wb = weight * b[i];
                for j in 0..=i {
                    ata[i][j] += wb * b[j];
                }
                for c in 0..3 {
                    atb[i][c] += wb * colour[c];
                }
            }
        };
        let mut mean = [0.0f64; 3];
        for y in (0..h).step_by(stride) {
            for x in (0..w).step_by(stride) {
                looked += 1.0;
                let Some((colour, weight)) = seen(y * w + x) else { continue };
                let (colour, weight) = (colour.map(f64::from), f64::from(weight));
                total += weight;
                for c in 0..3 {
                    mean[c] += weight * colour[c];
                }
                add(direction(camera, pose, x, y), colour, weight);
            }
        }
        if total * 500.0 < looked || total == 0.0 {
            return None;
        }
        // The mean colour, seen from the corners, edges and faces of a cube all around.
        let mean = mean.map(|m| m / total);
        for k in (0..27).filter(|&k| k != 13) {
            let d = Vec3::new((k % 3) as f32 - 1.0, (k / 3 % 3) as f32 - 1.0, (k / 9) as f32 - 1.0);
            add(d.normalize(), mean, PRIOR * total / 26.0);
        }
        for i in 0..BASES {
            for j in 0..i {
                ata[j][i] = ata[i][j];
            }
        }
        let coefficients = solve(ata, atb).iter().map(|row| row.map(|v| v as f32)).collect();
        Some(Background { coefficients })
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

    /// The background that a look turns into this one.
    pub(crate) fn before(&self, look: &Affine) -> Background {
        Background { coefficients: crate::looks::undo(look, &self.coefficients) }
    }

    /// Colour in a direction; far from what it was fitted to it is kept within what looks can need.
    pub fn colour(&self, direction: Vec3) -> [f32; 3] {
        let mut out = [0.0; 3];
        for (b, c) in basis(direction).iter().zip(&self.coefficients) {
            for k in 0..3 {
                out[k] += b * c[k];
            }
        }
        out.map(|v| v.clamp(-1.0, 2.0))
    }

    /// The background of a whole frame.
    pub fn paint(&self, camera: &Camera, pose: &Pose) -> Image {
        let (w, h) = (camera.width as usize, camera.height as usize);
        let mut image = Image::zeros(w, h, 3);
        if let [colour] = self.coefficients.as_slice() {
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
                    [r[x], g[x], b[x]] = self.colour(direction(camera, pose, x, y));
                }
            },
        );
        image
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
        let fit = Background::fit(&camera, &pose, 1, |i| (i < 600).then(|| (truth(i), 1.0))).unwrap();
        let image = fit.paint(&camera, &pose);
        for i in 0..600 {
            for c in 0..3 {
                assert!((image.data[c * 1200 + i] - truth(i)[c]).abs() < 0.02);
            }
        }
        assert!(Background::fit(&camera, &pose, 1, |_| None).is_none());
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
