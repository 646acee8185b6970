//! Similarity transforms of splats: from the world of the program that trained them to that of the camera poses.

use crate::Splats;
use glam::{DMat3, DQuat, DVec3, EulerRot};

/// A rotation, a scale and a translation: `x' = scale * rotation * x + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// A rotation; its determinant is 1.
    pub rotation: DMat3,
    /// Larger than 0.
    pub scale: f64,
    /// In the units of the target.
    pub translation: DVec3,
}

impl Similarity {
    /// Changes nothing.
    pub const IDENTITY: Similarity =
        Similarity { rotation: DMat3::IDENTITY, scale: 1.0, translation: DVec3::ZERO };

    /// A rotation alone.
    pub fn turn(rotation: DMat3) -> Similarity {
        Similarity { rotation, ..Similarity::IDENTITY }
    }

    /// Where a point goes.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.rotation * point * self.scale + self.translation
    }

    /// This one after `first`.
    ///
    /// ```
    /// use glam::{DMat3, DVec3};
    /// use segwild_scene::Similarity;
    /// let turn = Similarity::turn(DMat3::from_rotation_z(0.5));
    /// let moved = Similarity { scale: 2.0, translation: DVec3::X, ..Similarity::IDENTITY };
    /// let point = DVec3::new(0.3, -1.0, 2.0);
    /// assert!((moved.after(&turn).apply(point) - moved.apply(turn.apply(point))).length() < 1e-12);
    /// assert!((moved.inverse().apply(moved.apply(point)) - point).length() < 1e-12);
    /// ```
    #[must_use]
    pub fn after(&self, first: &Similarity) -> Similarity {
        Similarity {
            rotation: self.rotation * first.rotation,
            scale: self.scale * first.scale,
            translation: self.apply(first.translation),
        }
    }

    /// The way back.
    #[must_use]
    pub fn inverse(&self) -> Similarity {
        let rotation = self.rotation.transpose();
        Similarity {
            rotation,
            scale: 1.0 / self.scale,
            translation: rotation * self.translation * (-1.0 / self.scale),
        }
    }

    /// In words for a person: what of it is not the identity.
    pub fn in_words(&self) -> String {
        let (z, y, x) = DQuat::from_mat3(&self.rotation).to_euler(EulerRot::ZYX);
        let mut parts = Vec::new();
        let angles = [x, y, z].map(f64::to_degrees);
        if angles.iter().any(|angle| angle.abs() > 0.01) {
            let [x, y, z] = angles;
            parts.push(format!("turned by {x:.2}, {y:.2}, {z:.2} degrees about x, y, z"));
        }
        if (self.scale - 1.0).abs() > 1e-4 {
            parts.push(format!("scaled by {:.4}", self.scale));
        }
        if self.translation.length() > 1e-4 * self.scale {
            let [x, y, z] = self.translation.to_array();
            parts.push(format!("moved by {x:.3}, {y:.3}, {z:.3}"));
        }
        if parts.is_empty() { "as it is".to_owned() } else { parts.join(", ") }
    }
}

/// Highest degree of colour coefficients that splats have.
const DEGREES: usize = 3;
/// Basis functions of that degree and below.
const FUNCTIONS: usize = (DEGREES + 1) * (DEGREES + 1);

impl Splats {
    /// The splats in another world: the same scene from a camera that is moved with them, with its colours.
    #[must_use]
    pub fn transformed(&self, to: &Similarity) -> Splats {
        let turn = DQuat::from_mat3(&to.rotation);
        let log_scale = to.scale.ln();
        let rotate = |&[w, x, y, z]: &[f32; 4]| {
            let own = DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
            let turned = turn * own;
            [turned.w, turned.x, turned.y, turned.z].map(|v| v as f32)
        };
        Splats {
            means: self
                .means
                .iter()
                .map(|&[x, y, z]| {
                    to.apply(DVec3::new(x.into(), y.into(), z.into())).to_array().map(|v| v as f32)
                })
                .collect(),
            log_scales: self
                .log_scales
                .iter()
                .map(|scale| scale.map(|v| (f64::from(v) + log_scale) as f32))
                .collect(),
            rotations: self.rotations.iter().map(rotate).collect(),
            sh: turned_colours(&self.sh, self.sh_degree as usize, &to.rotation),
            ..self.clone()
        }
    }
}

/// Colour coefficients of turned splats. Each degree turns by a matrix of its own, the integral over the sphere of the turned
/// basis functions times the basis functions.
fn turned_colours(sh: &[f32], degree: usize, rotation: &DMat3) -> Vec<f32> {
    let turns = turn_of_functions(rotation);
    let stride = 3 * (degree + 1).pow(2);
    let mut out = sh.to_vec();
    if degree == 0 || *rotation == DMat3::IDENTITY {
        return out;
    }
    for (from, to) in sh.chunks_exact(stride).zip(out.chunks_exact_mut(stride)) {
        for band in 1..=degree {
            let own = band * band..(band + 1) * (band + 1);
            for k in own.clone() {
                for c in 0..3 {
                    let sum: f64 = own.clone().map(|j| turns[k][j] * f64::from(from[3 * j + c])).sum();
                    to[3 * k + c] = sum as f32;
                }
            }
        }
    }
    out
}

/// Per pair of basis functions, the integral of `Y_k(R d) Y_j(d)` over all directions `d`: a sum over the nodes of a product of
/// Gauss' and the rectangle rule, which is exact for polynomials of degree 7.
fn turn_of_functions(rotation: &DMat3) -> [[f64; FUNCTIONS]; FUNCTIONS] {
    /// Nodes and weights of Gauss' rule of four points on -1 to 1.
    const GAUSS: [(f64, f64); 4] = [
        (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
        (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
        (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
        (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    ];
    const AROUND: usize = 8;
    let mut out = [[0.0; FUNCTIONS]; FUNCTIONS];
    for (z, weight) in GAUSS {
        for step in 0..AROUND {
            let angle = std::f64::consts::TAU * step as f64 / AROUND as f64;
            let r = (1.0 - z * z).sqrt();
            let direction = DVec3::new(r * angle.cos(), r * angle.sin(), z);
            let (turned, own) = (functions(*rotation * direction), functions(direction));
            let weight = weight * std::f64::consts::TAU / AROUND as f64;
            for (row, turned) in out.iter_mut().zip(turned) {
                row.iter_mut().zip(own).for_each(|(sum, own)| *sum += weight * turned * own);
            }
        }
    }
    out
}

/// The real spherical harmonics of degree 0 to 3 in a direction of length 1, in the order and with the signs of 3D Gaussian
/// splatting.
fn functions(direction: DVec3) -> [f64; FUNCTIONS] {
    let [x, y, z] = direction.to_array();
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        0.282_094_791_773_878_14,
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079_2 * x * y,
        -1.092_548_430_592_079_2 * y * z,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * x * z,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Mat3;

    fn some() -> Splats {
        Splats {
            means: vec![[1.0, 2.0, 3.0], [-0.5, 0.25, 4.0]],
            log_scales: vec![[-1.0, 0.0, 0.5], [-2.0, -2.5, -3.0]],
            rotations: vec![[0.8, 0.3, -0.4, 0.33], [0.1, -0.7, 0.2, 0.6]],
            opacities: vec![0.0, 1.5],
            sh_degree: 3,
            sh: (0..96).map(|i| (i as f32).sin()).collect(),
        }
    }

    fn colour(splats: &Splats, i: usize, from: DVec3) -> [f64; 3] {
        let stride = splats.sh_stride();
        let values = functions(from);
        [0, 1, 2].map(|c| {
            let own = |(k, v): (usize, &f64)| v * f64::from(splats.sh[i * stride + 3 * k + c]);
            values[..stride / 3].iter().enumerate().map(own).sum()
        })
    }

    #[test]
    fn transformed_splats_render_the_same_from_the_camera_that_moved_with_them() {
        for (axis, angle) in [(DVec3::X, 0.3), (DVec3::new(0.48, -0.6, 0.64), 2.1), (DVec3::Z, -1.5)] {
            let rotation = DMat3::from_axis_angle(axis, angle);
            let to = Similarity { rotation, scale: 2.5, translation: DVec3::new(3.0, -1.0, 0.5) };
            for degree in 0..=3usize {
                let splats = some();
                let stride = 3 * (degree + 1).pow(2);
                let sh = splats.sh.chunks_exact(48).flat_map(|own| own[..stride].to_vec()).collect();
                let splats = Splats { sh_degree: degree as u32, sh, ..splats };
                let moved = splats.transformed(&to);
                for i in 0..2 {
                    let mean = to.apply(splats.mean(i).as_dvec3());
                    assert!((moved.mean(i).as_dvec3() - mean).length() < 1e-5);
                    let turn = rotation.as_mat3();
                    let wanted: Mat3 = turn * splats.covariance(i) * turn.transpose() * 6.25;
                    assert!(moved.covariance(i).abs_diff_eq(wanted, 1e-4));
                    for from in [DVec3::new(0.36, -0.48, 0.8), DVec3::NEG_Y, DVec3::new(-0.6, 0.0, 0.8)] {
                        let (a, b) = (colour(&splats, i, from), colour(&moved, i, rotation * from));
                        assert!((0..3).all(|c| (a[c] - b[c]).abs() < 1e-5), "{degree}: {a:?} {b:?}");
                    }
                }
                let back = moved.transformed(&to.inverse());
                assert!(splats.sh.iter().zip(&back.sh).all(|(a, b)| (a - b).abs() < 1e-5));
            }
        }
    }

    #[test]
    fn a_half_turn_is_the_change_of_signs_that_exports_make() {
        let half = some().transformed(&Similarity::turn(DMat3::from_rotation_x(std::f64::consts::PI)));
        let signs = some().half_turned(0);
        assert!(half.sh.iter().zip(&signs.sh).all(|(a, b)| (a - b).abs() < 1e-5));
        assert!((half.mean(0) - signs.mean(0)).length() < 1e-5);
    }
}
