//! The Gaussians.

use crate::{SceneFrame, sigmoid};
use glam::{Mat3, Quat, Vec3};
use wincode::{SchemaRead, SchemaWrite};

/// Gaussian splats, one array per property (INRIA's parametrisation; method, section 0).
#[derive(Clone, Debug, Default, PartialEq, SchemaRead, SchemaWrite)]
pub struct Splats {
    /// Centres.
    pub means: Vec<[f32; 3]>,
    /// Logarithms of the three standard deviations.
    pub log_scales: Vec<[f32; 3]>,
    /// Rotations as quaternions (w, x, y, z); normalised on use, never in place.
    pub rotations: Vec<[f32; 4]>,
    /// Logits of the opacities.
    pub opacities: Vec<f32>,
    /// Spherical-harmonics degree of the colour, 0 to 3.
    pub sh_degree: u32,
    /// Colour coefficients, `[splat][basis function][r, g, b]`, flat; `3 * (sh_degree + 1)^2` per splat.
    pub sh: Vec<f32>,
}

impl Splats {
    /// Number of splats.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Colour coefficients per splat: `3 * (sh_degree + 1)^2`.
    pub fn sh_stride(&self) -> usize {
        3 * (self.sh_degree as usize + 1).pow(2)
    }

    /// Centre of a splat.
    pub fn mean(&self, i: usize) -> Vec3 {
        Vec3::from(self.means[i])
    }

    /// Opacity of a splat, in (0, 1).
    pub fn opacity(&self, i: usize) -> f32 {
        sigmoid(self.opacities[i])
    }

    /// Standard deviations of a splat.
    pub fn scale(&self, i: usize) -> Vec3 {
        Vec3::from(self.log_scales[i].map(f32::exp))
    }

    /// Rotation matrix of a splat; its columns are the axes. A zero quaternion counts as the identity.
    pub fn rotation(&self, i: usize) -> Mat3 {
        let [w, x, y, z] = self.rotations[i];
        let q = Quat::from_xyzw(x, y, z, w);
        let n = q.length_squared();
        if n > 0.0 && n.is_finite() { Mat3::from_quat(q.normalize()) } else { Mat3::IDENTITY }
    }

    /// Covariance of a splat: `R S S^T R^T`.
    pub fn covariance(&self, i: usize) -> Mat3 {
        let m = self.rotation(i) * Mat3::from_diagonal(self.scale(i));
        m * m.transpose()
    }

    /// The splats at `keep`, in that order; an index may occur more than once.
    pub fn select(&self, keep: &[usize]) -> Splats {
        let k = self.sh_stride();
        Splats {
            means: keep.iter().map(|&i| self.means[i]).collect(),
            log_scales: keep.iter().map(|&i| self.log_scales[i]).collect(),
            rotations: keep.iter().map(|&i| self.rotations[i]).collect(),
            opacities: keep.iter().map(|&i| self.opacities[i]).collect(),
            sh_degree: self.sh_degree,
            sh: keep.iter().flat_map(|&i| &self.sh[i * k..(i + 1) * k]).copied().collect(),
        }
    }
}

/// Of the 16 basis functions, whether each changes its sign with x, with y and with z.
const ODD: [[bool; 3]; 16] = {
    const O: bool = true;
    const E: bool = false;
    [
        [E, E, E],
        [E, O, E],
        [E, E, O],
        [O, E, E],
        [O, O, E],
        [E, O, O],
        [E, E, E],
        [O, E, O],
        [E, E, E],
        [E, O, E],
        [O, O, O],
        [E, O, E],
        [E, E, O],
        [O, E, E],
        [E, E, O],
        [O, E, E],
    ]
};

impl Splats {
    /// The same shapes in black, with no directions: what density control works on.
    pub fn uncoloured(&self) -> Splats {
        Splats {
            means: self.means.clone(),
            log_scales: self.log_scales.clone(),
            rotations: self.rotations.clone(),
            opacities: self.opacities.clone(),
            sh_degree: 0,
            sh: vec![0.0; 3 * self.len()],
        }
    }

    /// The splats of a normalised scene in the units and at the position of its file.
    pub fn to_file_frame(&self, frame: &SceneFrame) -> Splats {
        let origin = frame.origin.to_array();
        let map_mean = |mean: [f32; 3]| {
            let mean = mean.map(f64::from);
            [0, 1, 2].map(|k| (mean[k] * frame.scale + origin[k]) as f32)
        };
        self.moved(map_mean, frame.scale.ln())
    }

    /// The inverse of [`Splats::to_file_frame`].
    pub fn from_file_frame(&self, frame: &SceneFrame) -> Splats {
        let origin = frame.origin.to_array();
        let map_mean = |mean: [f32; 3]| {
            let mean = mean.map(f64::from);
            [0, 1, 2].map(|k| ((mean[k] - origin[k]) / frame.scale) as f32)
        };
        self.moved(map_mean, -frame.scale.ln())
    }

    /// The same splats turned by half a turn about an axis (0: x, 1: y, 2: z). Every basis function of the colour keeps its form or
    /// changes its sign.
    pub fn half_turned(&self, axis: usize) -> Splats {
        self.flipped([0, 1, 2].map(|k| if k == axis { 1.0 } else { -1.0 }))
    }

    /// The same splats with a sign, 1 or -1, for each axis of their world: mirrored, where the product of the signs is -1.
    pub(crate) fn flipped(&self, signs: [f32; 3]) -> Splats {
        let of_basis = ODD.map(|odd| (0..3).filter(|&k| odd[k]).map(|k| signs[k]).product::<f32>());
        let [a, b, c] = signs;
        let of_rotation = [b * c, a * c, a * b];
        let stride = self.sh_stride();
        Splats {
            means: self.means.iter().map(|&[x, y, z]| [a * x, b * y, c * z]).collect(),
            // The axes of a splat have no direction: the signs of two of them may change as well.
            rotations: self
                .rotations
                .iter()
                .map(|&[w, x, y, z]| [w, of_rotation[0] * x, of_rotation[1] * y, of_rotation[2] * z])
                .collect(),
            log_scales: self.log_scales.clone(),
            opacities: self.opacities.clone(),
            sh_degree: self.sh_degree,
            sh: self.sh.iter().enumerate().map(|(i, v)| v * of_basis[i % stride / 3]).collect(),
        }
    }

    fn moved(&self, map_mean: impl Fn([f32; 3]) -> [f32; 3], log_scale: f64) -> Splats {
        Splats {
            means: self.means.iter().map(|&m| map_mean(m)).collect(),
            log_scales: self
                .log_scales
                .iter()
                .map(|s| s.map(|v| (f64::from(v) + log_scale) as f32))
                .collect(),
            rotations: self.rotations.clone(),
            opacities: self.opacities.clone(),
            sh_degree: self.sh_degree,
            sh: self.sh.clone(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The basis functions, without their constants.
    fn basis([x, y, z]: [f32; 3]) -> [f32; 16] {
        let zz = 2.0 * z * z - x * x - y * y;
        let edge = 4.0 * z * z - x * x - y * y;
        [
            1.0,
            y,
            z,
            x,
            x * y,
            y * z,
            zz,
            x * z,
            x * x - y * y,
            y * (3.0 * x * x - y * y),
            x * y * z,
            y * edge,
            z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y),
            x * edge,
            z * (x * x - y * y),
            x * (x * x - 3.0 * y * y),
        ]
    }

    #[test]
    fn turned_and_mirrored_splats_render_the_same_from_the_turned_or_mirrored_camera() {
        let splats = Splats {
            means: vec![[1.0, 2.0, 3.0]],
            log_scales: vec![[-1.0, 0.0, 0.5]],
            rotations: vec![[0.8, 0.3, -0.4, 0.33]],
            opacities: vec![0.0],
            sh_degree: 3,
            sh: (0..48).map(|i| (i as f32).sin()).collect(),
        };
        for axis in 0..3 {
            let signs = [0, 1, 2].map(|k| if k == axis { 1.0 } else { -1.0 });
            assert_eq!(splats.half_turned(axis), splats.flipped(signs));
        }
        for of in 0..8 {
            let signs = [0, 1, 2].map(|k| if of >> k & 1 == 0 { 1.0 } else { -1.0 });
            let turned = splats.flipped(signs);
            let flip = Mat3::from_diagonal(Vec3::from(signs));
            assert_eq!(turned.mean(0), flip * splats.mean(0));
            let off = turned.covariance(0) - flip * splats.covariance(0) * flip;
            assert!(off.to_cols_array().iter().all(|v| v.abs() < 1e-5), "{off}");
            let from = Vec3::new(0.36, -0.48, 0.8);
            let colour = |s: &Splats, from: Vec3| -> f32 {
                basis(from.to_array()).iter().enumerate().map(|(k, b)| b * s.sh[3 * k]).sum()
            };
            let there = colour(&turned, flip * from);
            assert!((colour(&splats, from) - there).abs() < 1e-5, "{there}");
            assert_eq!(turned.flipped(signs), splats);
        }
    }
}
