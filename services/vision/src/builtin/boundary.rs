//! Boundary strength and direction per pixel.
//!
//! Martin, Fowlkes and Malik (PAMI 2004) compare histograms of brightness, colour and texture in the two halves of a
//! disc, for every orientation. With soft bins and Gaussian weights the difference of the two halves is the
//! directional derivative of the smoothed bin, so their chi-squared distance at orientation d is the quadratic
//! form `d^T M d` with `M = 1/4 sum_k g_k g_k^T / h_k` (`h_k` the smoothed bin, `g_k` its scaled gradient): one 2x2 tensor
//! per pixel holds all orientations at once, and tensors of several cues and scales simply add.

use super::colour::Lab;
use super::plane::FloatPlane;

/// Boundary strength in [0, 1] and normal direction of every pixel.
#[derive(Clone, Debug)]
pub(crate) struct Boundaries {
    /// Probability-like strength; broad ridges, as the watershed wants them.
    pub strength: FloatPlane,
    /// The tensor (xx, xy, yy) that it comes from, scaled so that its larger eigenvalue is `strength`.
    pub tensor: [FloatPlane; 3],
}

/// Soft bins of a value in [0, 1]: triangular weights between `bins` centres.
fn soft_bins(plane: &FloatPlane, bins: usize) -> Vec<FloatPlane> {
    let mut out = vec![FloatPlane::zeros(plane.width, plane.height); bins];
    for (i, &v) in plane.data.iter().enumerate() {
        let u = v.clamp(0.0, 1.0) * (bins - 1) as f32;
        let k = (u as usize).min(bins - 2);
        let f = u - k as f32;
        out[k].data[i] = 1.0 - f;
        out[k + 1].data[i] = f;
    }
    out
}

/// Texture as a distribution: gradient energy over four directions (doubled angle, soft), and a share for `flat`.
pub(crate) fn texture_bins(l: &FloatPlane) -> Vec<FloatPlane> {
    let (gx, gy) = l.blurred(0.8).gradient();
    let mut out = vec![FloatPlane::zeros(l.width, l.height); 5];
    const FLAT: f32 = 0.02;
    for i in 0..l.data.len() {
        let (x, y) = (gx.data[i], gy.data[i]);
        let magnitude = (x * x + y * y).sqrt();
        let angle = y.atan2(x).rem_euclid(std::f32::consts::PI) / std::f32::consts::PI * 4.0;
        let (k, f) = (angle as usize, angle.fract());
        let share = magnitude / (magnitude + FLAT);
        out[k % 4].data[i] += share * (1.0 - f);
        out[(k + 1) % 4].data[i] += share * f;
        out[4].data[i] = 1.0 - share;
    }
    out
}

/// Weight of each cue at each scale (pixel size 1, 2 and 4 at 320 px).
struct Cue {
    bins: Vec<FloatPlane>,
    weights: [f32; 3],
}

/// The built-in detector. `texture` is [`texture_bins`] of the lightness.
pub(crate) fn detect(normal: &Lab, texture: &[FloatPlane]) -> Boundaries {
    let (w, h) = (normal.l.width, normal.l.height);
    let cues = [
        Cue { bins: soft_bins(&normal.l, 6), weights: [0.8, 0.8, 0.6] },
        Cue { bins: soft_bins(&normal.a, 6), weights: [0.3, 0.5, 0.5] },
        Cue { bins: soft_bins(&normal.b, 6), weights: [0.3, 0.5, 0.5] },
        Cue { bins: texture.to_vec(), weights: [0.0, 0.15, 0.5] },
    ];
    let mut sum = [FloatPlane::zeros(w, h), FloatPlane::zeros(w, h), FloatPlane::zeros(w, h)];
    for cue in cues {
        let mut bins = cue.bins;
        for (level, &weight) in cue.weights.iter().enumerate() {
            if level > 0 {
                bins = bins.iter().map(FloatPlane::halved).collect();
            }
            if weight == 0.0 {
                continue;
            }
            let tensor = chi_squared(&bins, 1.2);
            for (total, part) in sum.iter_mut().zip(&tensor) {
                let part = part.resized(w, h);
                for (t, p) in total.data.iter_mut().zip(&part.data) {
                    *t += weight * p;
                }
            }
        }
    }
    Boundaries::from_tensor(sum, 1.0)
}

/// The chi-squared tensor of a histogram field at scale `sigma`.
fn chi_squared(bins: &[FloatPlane], sigma: f32) -> [FloatPlane; 3] {
    let (w, h) = (bins[0].width, bins[0].height);
    let mut out = [FloatPlane::zeros(w, h), FloatPlane::zeros(w, h), FloatPlane::zeros(w, h)];
    // A step of 1 blurred by sigma has the slope 1 / (sigma sqrt(2 pi)) at its middle.
    let scale = sigma * (2.0 * std::f32::consts::PI).sqrt();
    for bin in bins {
        let smooth = bin.blurred(sigma);
        let (gx, gy) = smooth.gradient();
        for i in 0..w * h {
            let weight = 0.25 * scale * scale / (smooth.data[i] + 0.05);
            let (x, y) = (gx.data[i], gy.data[i]);
            out[0].data[i] += weight * x * x;
            out[1].data[i] += weight * x * y;
            out[2].data[i] += weight * y * y;
        }
    }
    out
}

/// Larger eigenvalue of a symmetric 2x2 matrix.
fn larger_eigenvalue(xx: f32, xy: f32, yy: f32) -> f32 {
    0.5 * (xx + yy) + (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()
}

impl Boundaries {
    fn from_tensor(mut tensor: [FloatPlane; 3], gain: f32) -> Boundaries {
        let (w, h) = (tensor[0].width, tensor[0].height);
        let mut strength = FloatPlane::zeros(w, h);
        for i in 0..w * h {
            let value = larger_eigenvalue(tensor[0].data[i], tensor[1].data[i], tensor[2].data[i]);
            let p = 1.0 - (-gain * value).exp();
            strength.data[i] = p;
            let scale = if value > 1e-12 { p / value } else { 0.0 };
            for t in &mut tensor {
                t.data[i] *= scale;
            }
        }
        Boundaries { strength, tensor }
    }

    /// From the strength alone, as an edge network gives it: the normal is that of the ridge (the direction of the
    /// strongest negative curvature).
    pub fn from_strength(strength: FloatPlane) -> Boundaries {
        let smooth = strength.blurred(1.5);
        let (gx, gy) = smooth.gradient();
        let ((xx, xy), (_, yy)) = (gx.gradient(), gy.gradient());
        let (w, h) = (strength.width, strength.height);
        let mut tensor = [FloatPlane::zeros(w, h), FloatPlane::zeros(w, h), FloatPlane::zeros(w, h)];
        for i in 0..w * h {
            let (a, b, c) = (-xx.data[i], -xy.data[i], -yy.data[i]);
            let top = larger_eigenvalue(a, b, c);
            let (nx, ny) = if b.abs() > 1e-9 {
                (top - c, b)
            } else if a >= c {
                (1.0, 0.0)
            } else {
                (0.0, 1.0)
            };
            let scale = strength.data[i] / (nx * nx + ny * ny).max(1e-20);
            tensor[0].data[i] = scale * nx * nx;
            tensor[1].data[i] = scale * nx * ny;
            tensor[2].data[i] = scale * ny * ny;
        }
        Boundaries { strength, tensor }
    }

    /// The unit normal of the boundary at pixel `i`.
    fn normal(&self, i: usize) -> (f32, f32) {
        let (xx, xy, yy) = (self.tensor[0].data[i], self.tensor[1].data[i], self.tensor[2].data[i]);
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        (angle.cos(), angle.sin())
    }

    /// One pixel wide: strength kept where it is a maximum along the normal, 0 elsewhere.
    pub fn thinned(&self) -> FloatPlane {
        let (w, h) = (self.strength.width, self.strength.height);
        let at = |x: f32, y: f32| {
            let (x, y) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
            let (x0, y0) = (x as usize, y as usize);
            let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
            let (fx, fy) = (x - x0 as f32, y - y0 as f32);
            let s = &self.strength.data;
            let top = s[y0 * w + x0] * (1.0 - fx) + s[y0 * w + x1] * fx;
            let low = s[y1 * w + x0] * (1.0 - fx) + s[y1 * w + x1] * fx;
            top * (1.0 - fy) + low * fy
        };
        let mut out = FloatPlane::zeros(w, h);
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                let (nx, ny) = self.normal(i);
                let (x, y, v) = (x as f32, y as f32, self.strength.data[i]);
                if v >= at(x + nx, y + ny) && v > at(x - nx, y - ny) {
                    out.data[i] = v;
                }
            }
        }
        out
    }
}
