//! The reference in f64: the same mathematics in straightforward code, which the kernels are tested against.
//!
//! Every pixel visits every splat, and the backward pass goes back to front through the conic, as in textbooks. It is
//! slow on purpose.

use crate::ProjectOptions;
use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use segwild_scene::{Camera, Pose, Splats};

/// Parameters of splats in f64; also the shape of their gradients.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Parameters {
    /// Centres.
    pub means: Vec<[f64; 3]>,
    /// Log scales.
    pub log_scales: Vec<[f64; 3]>,
    /// Quaternions (w, x, y, z), not normalised.
    pub rotations: Vec<[f64; 4]>,
    /// Opacity logits.
    pub opacities: Vec<f64>,
    /// Spherical-harmonics degree.
    pub sh_degree: u32,
    /// Colour coefficients, laid out as [`Splats::sh`].
    pub sh: Vec<f64>,
}

impl Parameters {
    /// The parameters of splats.
    pub fn of(splats: &Splats) -> Parameters {
        Parameters {
            means: splats.means.iter().map(|v| v.map(f64::from)).collect(),
            log_scales: splats.log_scales.iter().map(|v| v.map(f64::from)).collect(),
            rotations: splats.rotations.iter().map(|v| v.map(f64::from)).collect(),
            opacities: splats.opacities.iter().map(|&v| f64::from(v)).collect(),
            sh_degree: splats.sh_degree,
            sh: splats.sh.iter().map(|&v| f64::from(v)).collect(),
        }
    }

    fn zeros_like(&self) -> Parameters {
        let n = self.means.len();
        Parameters {
            means: vec![[0.0; 3]; n],
            log_scales: vec![[0.0; 3]; n],
            rotations: vec![[0.0; 4]; n],
            opacities: vec![0.0; n],
            sh_degree: self.sh_degree,
            sh: vec![0.0; self.sh.len()],
        }
    }
}

/// A rendered view in f64.
#[derive(Clone, Debug, PartialEq)]
pub struct Render {
    /// Planes, as in [`segwild_scene::Image`].
    pub image: Vec<f64>,
    /// Accumulated alpha.
    pub alpha: Vec<f64>,
    /// Pixels where f32 may decide a cut-off (1/255, 0.999, T < 1e-4) in another way.
    pub unsure: Vec<bool>,
}

/// Gradients in f64.
#[derive(Clone, Debug, PartialEq)]
pub struct Gradients {
    /// Of the geometry; the colour coefficients stay 0.
    pub parameters: Parameters,
    /// Of the blended values.
    pub values: Vec<f64>,
    /// Norm of the centre's gradient in units of half the frame.
    pub screen: Vec<f64>,
    /// The same with absolute values summed over pixels.
    pub screen_abs: Vec<f64>,
}

/// A view of splats to be rendered in f64.
pub struct Reference {
    /// Intrinsics of the camera.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
    /// Projection options.
    pub options: ProjectOptions,
    /// Whether the cut-offs apply. Without them the image is smooth in every parameter, as finite differences
    /// need it.
    pub cutoffs: bool,
}

struct Flat {
    index: usize,
    cam: DVec3,
    tan: DVec2,
    clamped: [bool; 2],
    jacobian: [DVec3; 2],
    covariance: DMat3,
    blurred: DMat2,
    sharp: DMat2,
    conic: DMat2,
    centre: DVec2,
    sigmoid: f64,
    opacity: f64,
}

struct PixelHit {
    splat: usize,
    alpha: f64,
    before: f64,
    offset: DVec2,
    free: bool,
}

fn dmat(m: glam::Mat3) -> DMat3 {
    m.as_dmat3()
}

fn quaternion(q: [f64; 4]) -> Option<DQuat> {
    let q = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    (q.length_squared() > 0.0).then(|| q.normalize())
}

fn row_times(v: DVec3, m: DMat3) -> DVec3 {
    m.transpose() * v
}

impl Reference {
    fn project(&self, p: &Parameters, index: usize) -> Option<Flat> {
        let (k, w) = (&self.camera, dmat(self.pose.rotation));
        let (fx, fy) = (f64::from(k.fx), f64::from(k.fy));
        let (cx, cy) = (f64::from(k.cx), f64::from(k.cy));
        let (width, height) = (f64::from(k.width), f64::from(k.height));
        let cam = w * DVec3::from(p.means[index]) + self.pose.translation.as_dvec3();
        if cam.z <= f64::from(self.options.near) {
            return None;
        }
        let raw = DVec2::new(cam.x, cam.y) / cam.z;
        let limit = |f: f64, c: f64, side: f64| ((-0.15 * side - c) / f, (1.15 * side - c) / f);
        let (lx, ly) = match self.options.jacobian_limits.map(|limits| limits.map(f64::from)) {
            Some([x0, x1, y0, y1]) => ((x0, x1), (y0, y1)),
            None => (limit(fx, cx, width), limit(fy, cy, height)),
        };
        let tan = DVec2::new(raw.x.clamp(lx.0, lx.1), raw.y.clamp(ly.0, ly.1));
        let jacobian = [
            DVec3::new(fx / cam.z, 0.0, -fx * tan.x / cam.z),
            DVec3::new(0.0, fy / cam.z, -fy * tan.y / cam.z),
        ];
        let rotation = quaternion(p.rotations[index]).map_or(DMat3::IDENTITY, DMat3::from_quat);
        let scale = DMat3::from_diagonal(DVec3::from(p.log_scales[index].map(f64::exp)));
        let covariance = rotation * scale * scale * rotation.transpose();
        let rows = jacobian.map(|j| row_times(j, w));
        let at = |a: usize, b: usize| rows[a].dot(covariance * rows[b]);
        let sharp = DMat2::from_cols_array(&[at(0, 0), at(0, 1), at(0, 1), at(1, 1)]);
        let blurred = sharp + DMat2::from_diagonal(DVec2::splat(f64::from(self.options.low_pass)));
        let sigmoid = 1.0 / (1.0 + (-p.opacities[index]).exp());
        let compensation =
            if self.options.antialias { (sharp.determinant() / blurred.determinant()).sqrt() } else { 1.0 };
        Some(Flat {
            index,
            cam,
            tan,
            clamped: [tan.x != raw.x, tan.y != raw.y],
            jacobian,
            covariance,
            blurred,
            sharp,
            conic: blurred.inverse(),
            centre: DVec2::new(fx * raw.x + cx, fy * raw.y + cy),
            sigmoid,
            opacity: sigmoid * compensation,
        })
    }

    fn flats(&self, p: &Parameters) -> Vec<Flat> {
        let mut flats: Vec<Flat> = (0..p.means.len()).filter_map(|i| self.project(p, i)).collect();
        flats.sort_by(|a, b| a.cam.z.total_cmp(&b.cam.z).then(a.index.cmp(&b.index)));
        flats
    }

    /// The splats that a pixel blends, nearest first, and whether a cut-off was close.
    fn hits(&self, flats: &[Flat], x: usize, y: usize) -> (Vec<PixelHit>, bool) {
        let pixel = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
        let near = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-3;
        let (mut transmittance, mut hits, mut unsure) = (1.0, Vec::new(), false);
        for (splat, flat) in flats.iter().enumerate() {
            let offset = pixel - flat.centre;
            let raw = flat.opacity * (-0.5 * offset.dot(flat.conic * offset)).exp();
            unsure |= near(raw, 1.0 / 255.0) || near(raw, 0.999) || near(transmittance, 1e-4);
            if self.cutoffs && (raw < 1.0 / 255.0 || transmittance < 1e-4) {
                continue;
            }
            let free = !self.cutoffs || raw < 0.999;
            let alpha = if free { raw } else { 0.999 };
            hits.push(PixelHit { splat, alpha, before: transmittance, offset, free });
            transmittance *= 1.0 - alpha;
        }
        (hits, unsure)
    }

    /// Blends `count` values per splat.
    pub fn render(&self, p: &Parameters, values: &[f64], count: usize) -> Render {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let pixels = width * height;
        let mut out = Render {
            image: vec![0.0; pixels * count],
            alpha: vec![0.0; pixels],
            unsure: vec![false; pixels],
        };
        let flats = self.flats(p);
        for pixel in 0..pixels {
            let (hits, unsure) = self.hits(&flats, pixel % width, pixel / width);
            out.unsure[pixel] = unsure;
            for hit in hits {
                let weight = hit.alpha * hit.before;
                out.alpha[pixel] += weight;
                for c in 0..count {
                    out.image[c * pixels + pixel] += weight * values[flats[hit.splat].index * count + c];
                }
            }
        }
        out
    }

    /// Gradients for the gradient of a loss with respect to the image's planes and to alpha.
    pub fn backward(
        &self,
        p: &Parameters,
        values: &[f64],
        count: usize,
        grad_image: &[f64],
        grad_alpha: &[f64],
    ) -> Gradients {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let (pixels, n) = (width * height, p.means.len());
        let flats = self.flats(p);
        let mut out = Gradients {
            parameters: p.zeros_like(),
            values: vec![0.0; values.len()],
            screen: vec![0.0; n],
            screen_abs: vec![0.0; n],
        };
        let mut centres = vec![DVec2::ZERO; flats.len()];
        let mut absolute = vec![DVec2::ZERO; flats.len()];
        let mut conics = vec![DMat2::ZERO; flats.len()];
        let mut opacities = vec![0.0; flats.len()];
        for pixel in 0..pixels {
            let (hits, _) = self.hits(&flats, pixel % width, pixel / width);
            // Loss-weighted colour of the splats farther than this one, as if all light arrived there.
            let mut farther = 0.0;
            for hit in hits.iter().rev() {
                let flat = &flats[hit.splat];
                let mut dot = grad_alpha[pixel];
                for c in 0..count {
                    let g = grad_image[c * pixels + pixel];
                    dot += g * values[flat.index * count + c];
                    out.values[flat.index * count + c] += hit.alpha * hit.before * g;
                }
                let d_alpha = hit.before * (dot - farther);
                farther = hit.alpha * dot + (1.0 - hit.alpha) * farther;
                if hit.free {
                    opacities[hit.splat] += d_alpha * hit.alpha / flat.opacity;
                    let d_power = d_alpha * hit.alpha;
                    let d_centre = flat.conic * hit.offset * d_power;
                    centres[hit.splat] += d_centre;
                    absolute[hit.splat] += d_centre.abs();
                    let outer = DMat2::from_cols(hit.offset * hit.offset.x, hit.offset * hit.offset.y);
                    conics[hit.splat] += outer * (-0.5 * d_power);
                }
            }
        }
        let half = DVec2::new(width as f64, height as f64) * 0.5;
        for (k, flat) in flats.iter().enumerate() {
            out.screen[flat.index] = (centres[k] * half).length();
            out.screen_abs[flat.index] = (absolute[k] * half).length();
            self.flat_backward(p, flat, centres[k], conics[k], opacities[k], &mut out.parameters);
        }
        out
    }

    fn flat_backward(
        &self,
        p: &Parameters,
        flat: &Flat,
        centre: DVec2,
        conic: DMat2,
        opacity: f64,
        out: &mut Parameters,
    ) {
        let (k, w, i) = (&self.camera, dmat(self.pose.rotation), flat.index);
        let (fx, fy) = (f64::from(k.fx), f64::from(k.fy));
        // d(C^-1) = -C^-1 dC C^-1.
        let mut d_cov2 = -(flat.conic * conic * flat.conic);
        let compensation = flat.opacity / flat.sigmoid;
        out.opacities[i] = opacity * compensation * flat.sigmoid * (1.0 - flat.sigmoid);
        if self.options.antialias {
            let gap = flat.sharp.inverse() - flat.blurred.inverse();
            d_cov2 += gap * (0.5 * opacity * flat.opacity);
        }
        let rows = flat.jacobian.map(|j| row_times(j, w));
        let d = |a: usize, b: usize| d_cov2.col(b)[a];
        let mut d_cov3 = DMat3::ZERO;
        let mut d_rows = [DVec3::ZERO; 2];
        for a in 0..2 {
            for b in 0..2 {
                let outer = DMat3::from_cols(rows[a] * rows[b].x, rows[a] * rows[b].y, rows[a] * rows[b].z);
                d_cov3 += outer * d(a, b);
                d_rows[a] += flat.covariance * rows[b] * (2.0 * d(a, b));
            }
        }
        // Sigma = sum over axes of s² r r^T.
        let unit = quaternion(p.rotations[i]);
        let rotation = unit.map_or(DMat3::IDENTITY, DMat3::from_quat);
        let mut d_rotation = DMat3::ZERO;
        for axis in 0..3 {
            let s2 = (2.0 * p.log_scales[i][axis]).exp();
            let r = rotation.col(axis);
            out.log_scales[i][axis] = 2.0 * s2 * r.dot(d_cov3 * r);
            *d_rotation.col_mut(axis) = (d_cov3 + d_cov3.transpose()) * r * s2;
        }
        if unit.is_some() {
            // R = (w² - v·v) I + 2 v v^T + 2 w [v]x of the quaternion divided by its squared norm: differentiate
            // R(q / |q|) along each component.
            let q = p.rotations[i];
            let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
            let u = q.map(|v| v / norm);
            let mut du = [0.0; 4];
            for c in 0..4 {
                let derivative = rotation_derivative(u, c);
                for col in 0..3 {
                    du[c] += derivative.col(col).dot(d_rotation.col(col));
                }
            }
            let along: f64 = (0..4).map(|c| du[c] * u[c]).sum();
            for c in 0..4 {
                out.rotations[i][c] = (du[c] - along * u[c]) / norm;
            }
        }
        let z = flat.cam.z;
        let (jx, jy) = (w * d_rows[0], w * d_rows[1]);
        let mut d_cam = DVec3::new(
            centre.x * fx / z,
            centre.y * fy / z,
            -(centre.x * fx * flat.cam.x + centre.y * fy * flat.cam.y) / (z * z),
        );
        d_cam.z += -jx.x * fx / (z * z) - jy.y * fy / (z * z);
        d_cam.z += jx.z * fx * flat.tan.x / (z * z) + jy.z * fy * flat.tan.y / (z * z);
        if !flat.clamped[0] {
            d_cam.x -= jx.z * fx / (z * z);
            d_cam.z += jx.z * fx * flat.tan.x / (z * z);
        }
        if !flat.clamped[1] {
            d_cam.y -= jy.z * fy / (z * z);
            d_cam.z += jy.z * fy * flat.tan.y / (z * z);
        }
        out.means[i] = (w.transpose() * d_cam).to_array();
    }
}

/// Derivative of a unit quaternion's rotation matrix (as the polynomial `1 - 2(y² + z²)`, ...) by a component.
fn rotation_derivative([w, x, y, z]: [f64; 4], component: usize) -> DMat3 {
    let rows = match component {
        0 => [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]],
        1 => [[0.0, y, z], [y, -2.0 * x, -w], [z, w, -2.0 * x]],
        2 => [[-2.0 * y, x, w], [x, 0.0, z], [-w, z, -2.0 * y]],
        _ => [[-2.0 * z, -w, x], [w, -2.0 * z, y], [x, y, 0.0]],
    };
    DMat3::from_cols_array_2d(&rows).transpose() * 2.0
}

/// Colours of all splats towards a camera, clamped at 0: the sum of spherical harmonics from their definition
/// by associated Legendre functions, real, with the Condon-Shortley phase.
pub fn shade(p: &Parameters, pose: &Pose) -> Vec<f64> {
    let eye = -(dmat(pose.rotation).transpose() * pose.translation.as_dvec3());
    let count = (p.sh_degree as usize + 1).pow(2);
    let mut out = Vec::with_capacity(p.means.len() * 3);
    for (i, mean) in p.means.iter().enumerate() {
        let direction = (DVec3::from(*mean) - eye).normalize();
        for c in 0..3 {
            let sum: f64 = (0..count).map(|k| harmonic(k, direction) * p.sh[(i * count + k) * 3 + c]).sum();
            out.push((0.5 + sum).max(0.0));
        }
    }
    out
}

/// Real spherical harmonic number `k = l (l + 1) + m`.
fn harmonic(k: usize, d: DVec3) -> f64 {
    let l = k.isqrt();
    let m = k as i64 - (l * (l + 1)) as i64;
    let order = m.unsigned_abs() as usize;
    let factorial = |n: usize| (1..=n).map(|v| v as f64).product::<f64>();
    // P_l^m with the phase (-1)^m, by upward recursion in l.
    let sin = (1.0 - d.z * d.z).max(0.0).sqrt();
    let mut previous = 0.0;
    let mut legendre = (0..order).fold(1.0, |p, n| -p * (2 * n + 1) as f64 * sin);
    for n in order + 1..=l {
        let next =
            ((2 * n - 1) as f64 * d.z * legendre - (n + order - 1) as f64 * previous) / (n - order) as f64;
        previous = legendre;
        legendre = next;
    }
    let scale = ((2 * l + 1) as f64 / (4.0 * std::f64::consts::PI) * factorial(l - order)
        / factorial(l + order))
    .sqrt();
    let angle = d.y.atan2(d.x) * order as f64;
    let root = std::f64::consts::SQRT_2;
    match m {
        0 => scale * legendre,
        m if m > 0 => root * scale * legendre * angle.cos(),
        _ => root * scale * legendre * angle.sin(),
    }
}
