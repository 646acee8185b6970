//! Evidence of masks on photos for and against splats (method, section 6).

use crate::screen::Ellipsoid;
use crate::settings::Vote;
use rayon::prelude::*;
use segwild_raster::{ALPHA_MIN, ProjectOptions, Projected, RasterError};
use segwild_scene::{Camera, Image, Mask, Pose, Splats};

/// Pixels `l_0` added to a splat's footprint when its vote is formed (method, section 6.1): splats much smaller than a pixel
/// carry little information about where a boundary runs. By choice. IoU by half, half more: +.006, 0 on `sacre_coeur`; 0, +.002
/// on the demo.
pub(crate) const VOTE_FLOOR: f32 = 1.0;

/// Exponent `q` of coverage evidence (method, section 6.1): where a photo sees a share of a splat's light, its evidence counts
/// as known by that share to this power. A tenth that shows beside something else determines the side of that tenth, and little
/// of the rest. From docs/experiments/2026-11-26-small-coverage.md. IoU by half, half more: +.005, +.005 on `sacre_coeur`;
/// -.026, +.018 on the demo.
const COVERAGE_EXPONENT: f32 = 1.5;

/// Evidence for and against each splat, summed over views. The unit is a view: one that sees a splat whole
/// and large adds 1 to the two together; with [`Vote::Light`] it is a pixel's light.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Evidence {
    /// `A_1`: visible light of the splat inside the masks.
    pub inside: Vec<f32>,
    /// `A_0`: visible light of the splat outside the masks.
    pub outside: Vec<f32>,
    /// How much is known of the splat by them, in the same unit: the reliability of the share of the two. It is
    /// less than their sum where views see little of the splat, more where a prompted photo sees it.
    pub known: Vec<f32>,
}

impl Evidence {
    /// No evidence about `splats` splats.
    pub fn none(splats: usize) -> Evidence {
        let none = vec![0.0; splats];
        Evidence { inside: none.clone(), outside: none.clone(), known: none }
    }

    /// The evidence for and against a splat together.
    pub fn seen(&self, splat: usize) -> f32 {
        self.inside[splat] + self.outside[splat]
    }

    /// `rho = sum(alpha T M) / sum(alpha T)`, or `None` where no view sees the splat.
    pub fn rho(&self, splat: usize) -> Option<f32> {
        let total = self.seen(splat);
        (total > 0.0).then(|| self.inside[splat] / total)
    }

    /// How much is known for a splat and against it: [`Evidence::known`], divided as `A_1` to `A_0`.
    pub fn sides(&self, splat: usize) -> (f32, f32) {
        let known = self.known[splat];
        self.rho(splat).map_or((0.0, 0.0), |rho| (known * rho, known * (1.0 - rho)))
    }

    /// The label that the evidence gives, `None` where nothing or less than `least` is known: inside wins where
    /// `A_1 (1 - rho) >= (A_0 + gamma) rho`, which at `rho` 0.5 is the larger of `A_1` and `A_0 + gamma`.
    pub fn label(&self, splat: usize, rho: f32, gamma: f32, least: f32) -> Option<bool> {
        let (inside, outside, known) = (self.inside[splat], self.outside[splat], self.known[splat]);
        (known > 0.0 && known >= least).then_some(inside * (1.0 - rho) >= (outside + gamma) * rho)
    }

    /// How well one view sees each splat, in 1/255 of full weight ([`Evidence::seen`], rounded).
    pub(crate) fn visibility(&self) -> Vec<u8> {
        (0..self.inside.len()).map(|i| (255.0 * self.seen(i).clamp(0.0, 1.0)).round() as u8).collect()
    }

    /// Without another that was added to it.
    pub(crate) fn minus(&self, other: &Evidence) -> Evidence {
        let rest = |sum: &[f32], part: &[f32]| sum.iter().zip(part).map(|(a, b)| (a - b).max(0.0)).collect();
        Evidence {
            inside: rest(&self.inside, &other.inside),
            outside: rest(&self.outside, &other.outside),
            known: rest(&self.known, &other.known),
        }
    }

    /// Adds `weight` times another.
    pub fn add(&mut self, other: &Evidence, weight: f32) {
        let add = |sum: &mut [f32], x: &[f32]| sum.iter_mut().zip(x).for_each(|(sum, x)| *sum += weight * x);
        add(&mut self.inside, &other.inside);
        add(&mut self.outside, &other.outside);
        add(&mut self.known, &other.known);
    }
}

/// Light that each splat would send to each pixel if nothing stood before it: `sum of alpha` over the plane,
/// which is `2 pi sqrt(det) (o - 1/255)` with the rasteriser's cut-off; at most the whole frame.
/// 0 for splats that are not in front of the camera.
pub fn unoccluded(splats: &Splats, camera: &Camera, pose: &Pose, options: &ProjectOptions) -> Vec<f32> {
    let light = |i| unoccluded_light(splats, camera, pose, options, i);
    (0..splats.len()).into_par_iter().with_min_len(1024).map(light).collect()
}

/// [`unoccluded`] of one splat.
pub(crate) fn unoccluded_light(
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
    options: &ProjectOptions,
    splat: usize,
) -> f32 {
    let seen = Ellipsoid::of(splats, splat).and_then(|s| s.project(camera, pose, options.near));
    let opacity = splats.opacity(splat);
    let (Some(footprint), true) = (seen, opacity > ALPHA_MIN) else { return 0.0 };
    // Anti-aliasing lowers the opacity by as much as the low-pass widened the splat.
    let low_pass = if options.antialias { 0.0 } else { f64::from(options.low_pass) };
    let area = std::f64::consts::TAU * footprint.determinant(low_pass).sqrt();
    let frame = camera.width as f32 * camera.height as f32;
    ((opacity - ALPHA_MIN) * area as f32).min(opacity * frame)
}

/// Evidence of one view in coverage mode. `inside` and `weight` have one number per pixel: how much of the
/// pixel the mask covers times the pixel's weight, and the weight. Weights are in [0, 1]. `worth` is the unit of
/// the evidence.
pub fn coverage(
    projected: &dyn Projected,
    unoccluded: &[f32],
    inside: &[f32],
    weight: &[f32],
    size: (u32, u32),
    worth: Vote,
) -> Result<Evidence, RasterError> {
    coverage_by(projected, |i| unoccluded[i], inside, weight, size, worth)
}

/// The same where [`unoccluded`] is computed of the splats that the view sees alone: they are the fewer ones.
pub(crate) fn coverage_by(
    projected: &dyn Projected,
    unoccluded: impl Fn(usize) -> f32 + Sync,
    inside: &[f32],
    weight: &[f32],
    size: (u32, u32),
    worth: Vote,
) -> Result<Evidence, RasterError> {
    let mut data = Vec::with_capacity(2 * inside.len());
    data.extend_from_slice(inside);
    data.extend_from_slice(weight);
    let image = Image { width: size.0 as usize, height: size.1 as usize, channels: 2, data };
    let sums = projected.gather(&image)?;
    let mut evidence = Evidence::none(sums.len() / 2);
    let Evidence { inside, outside, known } = &mut evidence;
    let sides = inside.par_iter_mut().zip(outside).zip(known);
    let splats = sides.zip(sums.par_chunks_exact(2)).enumerate().with_min_len(1024);
    splats.for_each(|(i, (((inside, outside), known), sum))| {
        let (within, all) = (sum[0].min(sum[1]), sum[1]);
        if all > 0.0 {
            let vote = match worth {
                Vote::View => 1.0 / (unoccluded(i).max(all) + VOTE_FLOOR),
                Vote::Light => 1.0,
            };
            *inside = within * vote;
            *outside = (all - within) * vote;
            *known = match worth {
                Vote::View => (all * vote).powf(COVERAGE_EXPONENT),
                Vote::Light => all,
            };
        }
    });
    Ok(evidence)
}

/// Evidence of one view in centre mode: each splat in the frame whose centre lies in the mask is inside.
/// Occlusion does not matter (the paper's reading).
pub fn centre(projected: &dyn Projected, mask: &Mask, near: f32) -> Evidence {
    let centres = projected.centres();
    let mut evidence = Evidence::none(centres.len());
    for (i, (&[u, v], &depth)) in centres.iter().zip(projected.depths()).enumerate() {
        let in_frame = u >= 0.0 && v >= 0.0 && u < mask.width() as f32 && v < mask.height() as f32;
        if depth > near && in_frame {
            let side = if mask.at(u, v) { &mut evidence.inside } else { &mut evidence.outside };
            side[i] = 1.0;
            evidence.known[i] = 1.0;
        }
    }
    evidence
}

/// Which splats a view sees: some of their light reaches the camera.
pub fn visible(projected: &dyn Projected, size: (u32, u32)) -> Result<Vec<bool>, RasterError> {
    let sums = projected.gather(&Image::filled(size.0 as usize, size.1 as usize, 1, 1.0))?;
    Ok(sums.into_iter().map(|sum| sum > 0.0).collect())
}

/// A rendered share, clamped to [0, 1]; NaN counts as 0.
pub(crate) fn clean(share: f32) -> f32 {
    if share.is_nan() { 0.0 } else { share.clamp(0.0, 1.0) }
}

/// A mask at another size: the share of each new pixel that it covers when it shrinks, the pixel under the
/// centre when it grows.
pub fn soft(mask: &Mask, width: u32, height: u32) -> Vec<f32> {
    let (w, h) = (mask.width(), mask.height());
    if (w, h) == (width, height) {
        return (0..w as usize * h as usize).map(|i| f32::from(u8::from(mask.index(i)))).collect();
    }
    let span = |k: u32, new: u32, old: u32| {
        let at = |k: u32| (u64::from(k) * u64::from(old) / u64::from(new)) as u32;
        let centre = (u64::from(2 * k + 1) * u64::from(old) / u64::from(2 * new)) as u32;
        if new < old { at(k)..at(k + 1) } else { centre..centre + 1 }
    };
    let mut out = Vec::with_capacity(width as usize * height as usize);
    for y in 0..height {
        let rows = span(y, height, h);
        for x in 0..width {
            let columns = span(x, width, w);
            let inside =
                rows.clone().map(|y| columns.clone().filter(|&x| mask.get(x, y)).count()).sum::<usize>();
            out.push(inside as f32 / (rows.len() * columns.len()).max(1) as f32);
        }
    }
    out
}
