//! From splats to footprints on the image, and back (method, section 1).
//!
//! A footprint is kept as `q = a u² + e dy²` with `u = dx - slope dy`: the covariance's Cholesky form, in
//! which `1/e` is the variance of y and `1/a` that of x given y. It is a sum of squares, so nothing cancels for
//! long thin splats, and a row of pixels needs one term in `u` only.

use crate::ProjectOptions;
use segwild_scene::{Camera, Pose, Splats, sigmoid};

/// Pixels with a smaller alpha are skipped.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Largest alpha of one splat at one pixel.
pub const ALPHA_MAX: f32 = 0.999;
/// Transmittance below which a pixel is finished.
pub const T_MIN: f32 = 1e-4;
/// Base-2 logarithm of [`ALPHA_MIN`].
pub const LOG2_ALPHA_MIN: f32 = -7.994_353_4;
/// `q / 2` in units of base-2 logarithms.
const HALF_LOG2_E: f32 = 0.5 * std::f32::consts::LOG2_E;
/// Slack of footprint extents in pixels, so that rounding never loses a pixel.
pub const SLACK: f32 = 0.01;
/// How far beyond the frame, in widths or heights, the perspective is still followed when the Jacobian is
/// taken; farther out the linearisation would smear a splat over the whole image.
const JACOBIAN_MARGIN: f32 = 0.15;

type Mat = [[f32; 3]; 3];

/// A splat projected on the image: `log2 alpha = lo - a u² - e dy²`, where `dx, dy` is the pixel's centre minus the
/// splat's and `u = dx - slope dy`.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C)]
pub(crate) struct SplatFootprint {
    /// Centre, x.
    pub x: f32,
    /// Centre, y.
    pub y: f32,
    /// Covariance of x and y over the variance of y.
    pub slope: f32,
    /// Half the inverse variance of x given y, times log2 e.
    pub a: f32,
    /// Half the inverse variance of y, times log2 e.
    pub e: f32,
    /// Base-2 logarithm of the opacity.
    pub lo: f32,
    /// `1 / a`.
    pub inv_a: f32,
    /// Half the height of the ellipse where alpha reaches 1/255, in pixels.
    pub reach: f32,
}

/// Camera, pose and options in the form the projection uses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projector {
    pub width: usize,
    pub height: usize,
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    w: Mat,
    t: [f32; 3],
    limits: [f32; 4],
    low_pass: f32,
    antialias: bool,
    near: f32,
}

/// Intermediate values of the projection that the backward pass needs too.
struct Path {
    cam: [f32; 3],
    /// Whether x/z and y/z were clamped.
    clamped: [bool; 2],
    /// Normalised quaternion, and one over its norm (0 for a quaternion that counts as the identity).
    quat: [f32; 4],
    inv_norm: f32,
    rot: Mat,
    scale: [f32; 3],
    /// `J W`, 2 x 3.
    jw: [[f32; 3]; 2],
    /// `J W R S`, 2 x 3.
    m: [[f32; 3]; 2],
    sxx: f32,
    sxy: f32,
    syy: f32,
    det: f32,
    /// Determinant before the low-pass.
    det0: f32,
    sigmoid: f32,
}

/// Sums over a splat's pixels that carry all geometric gradients; `g` is dL/d ln alpha of a pixel.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Moments {
    pub g: f32,
    pub g_u: f32,
    pub g_uu: f32,
    pub g_y: f32,
    pub g_uy: f32,
    pub g_yy: f32,
    pub abs_x: f32,
    pub abs_y: f32,
}

/// Gradients of one splat.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct GeometryGrads {
    pub mean: [f32; 3],
    pub log_scale: [f32; 3],
    pub rotation: [f32; 4],
    pub opacity: f32,
    pub screen: f32,
    pub screen_abs: f32,
}

/// A projected splat, before it is known which tiles it touches.
pub(crate) struct ProjectedSplat {
    pub footprint: SplatFootprint,
    pub radius: f32,
    /// `dy` of the rightmost point of the ellipse where alpha reaches 1/255.
    pub tip: f32,
}

#[inline(always)]
fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[inline(always)]
fn finite(values: &[f32]) -> bool {
    // One bad number makes the sum of the products with zero bad: no branch per number.
    values.iter().map(|v| v * 0.0).sum::<f32>() == 0.0
}

#[inline(always)]
fn rotation_matrix([w, x, y, z]: [f32; 4]) -> Mat {
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
}

/// Range of x/z (first two) and of y/z in which the Jacobian follows the perspective in a camera's whole frame.
pub fn jacobian_limits(camera: &Camera) -> [f32; 4] {
    let (width, height) = (camera.width as f32, camera.height as f32);
    [
        (-JACOBIAN_MARGIN * width - camera.cx) / camera.fx,
        ((1.0 + JACOBIAN_MARGIN) * width - camera.cx) / camera.fx,
        (-JACOBIAN_MARGIN * height - camera.cy) / camera.fy,
        ((1.0 + JACOBIAN_MARGIN) * height - camera.cy) / camera.fy,
    ]
}

impl Projector {
    pub fn new(camera: &Camera, pose: &Pose, options: &ProjectOptions) -> Projector {
        let r = pose.rotation.to_cols_array_2d();
        let mut w = [[0.0; 3]; 3];
        for i in 0..3 {
            for j in 0..3 {
                w[i][j] = r[j][i];
            }
        }
        let limits = options.jacobian_limits.unwrap_or_else(|| jacobian_limits(camera));
        Projector {
            width: camera.width as usize,
            height: camera.height as usize,
            fx: camera.fx,
            fy: camera.fy,
            cx: camera.cx,
            cy: camera.cy,
            w,
            t: pose.translation.to_array(),
            limits,
            low_pass: options.low_pass,
            antialias: options.antialias,
            near: options.near,
        }
    }

    /// Depth and pixel position of a centre; also of splats that will be culled.
    #[inline(always)]
    pub fn centre(&self, mean: [f32; 3]) -> (f32, [f32; 2]) {
        let [x, y, z] = self.camera_point(mean);
        (z, [self.fx * x / z + self.cx, self.fy * y / z + self.cy])
    }

    #[inline(always)]
    fn camera_point(&self, p: [f32; 3]) -> [f32; 3] {
        [dot(self.w[0], p) + self.t[0], dot(self.w[1], p) + self.t[1], dot(self.w[2], p) + self.t[2]]
    }

    #[inline(always)]
    fn path(&self, splats: &Splats, i: usize) -> Option<Path> {
        let (q, ls) = (splats.rotations[i], splats.log_scales[i]);
        let cam = self.camera_point(splats.means[i]);
        let z = cam[2];
        let sane = finite(&cam) && finite(&q) && finite(&ls) && splats.opacities[i].is_finite();
        if !sane || z <= self.near || z <= 0.0 {
            return None;
        }
        let sigmoid = sigmoid(splats.opacities[i]);
        if sigmoid < ALPHA_MIN {
            return None;
        }
        let n2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];
        let usable = n2 > 0.0 && n2.is_finite();
        let inv_norm = if usable { 1.0 / n2.sqrt() } else { 0.0 };
        let quat = if usable { q.map(|v| v * inv_norm) } else { [1.0, 0.0, 0.0, 0.0] };
        let rot = rotation_matrix(quat);
        let scale = ls.map(f32::exp);

        let inv_z = 1.0 / z;
        let (tx, ty) = (cam[0] * inv_z, cam[1] * inv_z);
        let tan = [tx.clamp(self.limits[0], self.limits[1]), ty.clamp(self.limits[2], self.limits[3])];
        let clamped = [tan[0] != tx, tan[1] != ty];
        let (jx, jy) = (self.fx * inv_z, self.fy * inv_z);
        let w = &self.w;
        let mut jw = [[0.0; 3]; 2];
        for k in 0..3 {
            jw[0][k] = jx * (w[0][k] - tan[0] * w[2][k]);
            jw[1][k] = jy * (w[1][k] - tan[1] * w[2][k]);
        }
        let mut m = [[0.0; 3]; 2];
        for r in 0..2 {
            for k in 0..3 {
                m[r][k] = (jw[r][0] * rot[0][k] + jw[r][1] * rot[1][k] + jw[r][2] * rot[2][k]) * scale[k];
            }
        }
        let (sxx0, sxy, syy0) = (dot(m[0], m[0]), dot(m[0], m[1]), dot(m[1], m[1]));
        // Cauchy-Binet: the determinant of M M^T is the sum of the squared minors, which cannot cancel.
        let minor = |j: usize, k: usize| m[0][j] * m[1][k] - m[0][k] * m[1][j];
        let (m01, m02, m12) = (minor(0, 1), minor(0, 2), minor(1, 2));
        let det0 = m01 * m01 + m02 * m02 + m12 * m12;
        let lp = self.low_pass;
        let det = det0 + lp * (sxx0 + syy0) + lp * lp;
        let (sxx, syy) = (sxx0 + lp, syy0 + lp);
        let good = det > 0.0 && det.is_finite() && sxx > 0.0 && syy > 0.0 && sxy.is_finite();
        good.then_some(Path {
            cam,
            clamped,
            quat,
            inv_norm,
            rot,
            scale,
            jw,
            m,
            sxx,
            sxy,
            syy,
            det,
            det0,
            sigmoid,
        })
    }

    /// Opacity after the anti-aliasing compensation.
    #[inline(always)]
    fn opacity(&self, path: &Path) -> f32 {
        if self.antialias { path.sigmoid * (path.det0 / path.det).sqrt() } else { path.sigmoid }
    }

    /// The footprint of a splat, or nothing if it cannot be seen.
    #[inline(always)]
    pub fn shape(&self, splats: &Splats, i: usize) -> Option<ProjectedSplat> {
        let p = self.path(splats, i)?;
        let opacity = self.opacity(&p);
        if opacity < ALPHA_MIN {
            return None;
        }
        let lo = opacity.log2();
        let (a, e) = (HALF_LOG2_E * (p.syy / p.det), HALF_LOG2_E / p.syy);
        let (x, y) = (self.fx * p.cam[0] / p.cam[2] + self.cx, self.fy * p.cam[1] / p.cam[2] + self.cy);
        // Twice the natural logarithm of how far the peak stands above the threshold: the largest q blended.
        let q = ((lo - LOG2_ALPHA_MIN) / HALF_LOG2_E).max(0.0);
        let (reach_x, reach_y) = ((q * p.sxx).sqrt() + SLACK, (q * p.syy).sqrt() + SLACK);
        let half_gap = 0.5 * (p.sxx - p.syy);
        let largest = 0.5 * (p.sxx + p.syy) + (half_gap * half_gap + p.sxy * p.sxy).sqrt();
        let radius = (q * largest).sqrt();
        let footprint =
            SplatFootprint { x, y, slope: p.sxy / p.syy, a, e, lo, inv_a: 1.0 / a, reach: reach_y };
        let tip = p.sxy / p.sxx * reach_x;
        let numbers = [x, y, footprint.slope, a, e, lo, footprint.inv_a, reach_y, radius, tip];
        let (right, bottom) = (self.width as f32 - 0.5, self.height as f32 - 0.5);
        let inside =
            x + reach_x >= 0.5 && x - reach_x <= right && y + reach_y >= 0.5 && y - reach_y <= bottom;
        (finite(&numbers) && a > 0.0 && inside).then_some(ProjectedSplat { footprint, radius, tip })
    }

    /// From the sums over pixels to the gradients of the parameters. All finite: what overflows is dropped.
    #[inline(always)]
    pub fn backward(&self, splats: &Splats, i: usize, s: &Moments) -> GeometryGrads {
        let Some(p) = self.path(splats, i) else { return GeometryGrads::default() };
        let (a, e, r) = (p.syy / p.det, 1.0 / p.syy, p.sxy / p.syy);

        // ln alpha = ln o - q/2 with q = a u² + e dy².
        let (gx, gy) = (a * s.g_u, e * s.g_y - a * r * s.g_u);
        let dv = 0.5 * a * a * s.g_uu;
        let dr = a * s.g_uy;
        let mut dxx = dv;
        let mut dxy = e * dr - 2.0 * r * dv;
        let mut dyy = r * r * dv - r * e * dr + 0.5 * e * e * s.g_yy;
        if self.antialias && p.det0 > 0.0 {
            let lp = self.low_pass;
            let (i0, i1, h) = (1.0 / p.det0, 1.0 / p.det, 0.5 * s.g);
            dxx += h * ((p.syy - lp) * i0 - p.syy * i1);
            dyy += h * ((p.sxx - lp) * i0 - p.sxx * i1);
            dxy += h * 2.0 * p.sxy * (i1 - i0);
        }

        let mut dm = [[0.0; 3]; 2];
        for k in 0..3 {
            dm[0][k] = 2.0 * dxx * p.m[0][k] + dxy * p.m[1][k];
            dm[1][k] = 2.0 * dyy * p.m[1][k] + dxy * p.m[0][k];
        }
        // M = (J W) (R S).
        let mut djw = [[0.0; 3]; 2];
        let mut drot = [[0.0; 3]; 3];
        let mut log_scale = [0.0; 3];
        for j in 0..3 {
            for k in 0..3 {
                let rs = p.rot[j][k] * p.scale[k];
                djw[0][j] += dm[0][k] * rs;
                djw[1][j] += dm[1][k] * rs;
                let drs = p.jw[0][j] * dm[0][k] + p.jw[1][j] * dm[1][k];
                log_scale[k] += drs * rs;
                drot[j][k] = drs * p.scale[k];
            }
        }

        let inv_z = 1.0 / p.cam[2];
        let (jx, jy) = (self.fx * inv_z, self.fy * inv_z);
        // Row r of J W is j_r (W_r - tan_r W_z).
        let w = &self.w;
        let dtan = [-jx * dot(djw[0], w[2]), -jy * dot(djw[1], w[2])];
        let mut dcam = [jx * gx, jy * gy, 0.0];
        let (tx, ty) = (p.cam[0] * inv_z, p.cam[1] * inv_z);
        dcam[2] -= jx * tx * gx + jy * ty * gy;
        dcam[2] -= inv_z * (dot(djw[0], p.jw[0]) + dot(djw[1], p.jw[1]));
        if !p.clamped[0] {
            dcam[0] += dtan[0] * inv_z;
            dcam[2] -= dtan[0] * tx * inv_z;
        }
        if !p.clamped[1] {
            dcam[1] += dtan[1] * inv_z;
            dcam[2] -= dtan[1] * ty * inv_z;
        }
        let mut mean = [0.0; 3];
        for k in 0..3 {
            mean[k] = w[0][k] * dcam[0] + w[1][k] * dcam[1] + w[2][k] * dcam[2];
        }

        let [qw, qx, qy, qz] = p.quat;
        let d = &drot;
        let dq = [
            2.0 * (qx * (d[2][1] - d[1][2]) + qy * (d[0][2] - d[2][0]) + qz * (d[1][0] - d[0][1])),
            2.0 * (qy * (d[0][1] + d[1][0]) + qz * (d[0][2] + d[2][0]) + qw * (d[2][1] - d[1][2])
                - 2.0 * qx * (d[1][1] + d[2][2])),
            2.0 * (qx * (d[0][1] + d[1][0]) + qz * (d[1][2] + d[2][1]) + qw * (d[0][2] - d[2][0])
                - 2.0 * qy * (d[0][0] + d[2][2])),
            2.0 * (qx * (d[0][2] + d[2][0]) + qy * (d[1][2] + d[2][1]) + qw * (d[1][0] - d[0][1])
                - 2.0 * qz * (d[0][0] + d[1][1])),
        ];
        let along = dq[0] * qw + dq[1] * qx + dq[2] * qy + dq[3] * qz;
        let mut rotation = [0.0; 4];
        for k in 0..4 {
            rotation[k] = (dq[k] - p.quat[k] * along) * p.inv_norm;
        }

        let (half_w, half_h) = (0.5 * self.width as f32, 0.5 * self.height as f32);
        let norm = |x: f32, y: f32| (x * x * half_w * half_w + y * y * half_h * half_h).sqrt();
        let kept = |v: f32| if v.is_finite() { v } else { 0.0 };
        GeometryGrads {
            mean: mean.map(kept),
            log_scale: log_scale.map(kept),
            rotation: rotation.map(kept),
            opacity: kept(s.g * (1.0 - p.sigmoid)),
            screen: kept(norm(gx, gy)),
            screen_abs: kept(norm(s.abs_x, s.abs_y)),
        }
    }
}
