//! Spiky Gaussian cutter: splats of a selection that stick out of the object's mask are moved back and
//! shortened (method, section 7; paper Eq. 29-32).

use crate::screen::{Axes, Ellipsoid, EllipsoidFootprint};
use crate::settings::SpikeMode;
use crate::svd;
use glam::{DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;
use segwild_scene::{Camera, Mask, Pose, Splats};

/// Standard deviations from the centre to each end of the segment that stands for a splat (paper, Eq. 29; method, section 7).
/// Half and half more move IoU by less than .0005.
pub(crate) const SEGMENT_END: f64 = 1.5;

/// A splat whose axes differ by this factor in variance is a candidate (method, section 7). Half and half more changed no
/// measured click.
const MIN_ELONGATION: f64 = 4.0;

/// A splat whose segment reaches further than this, in pixels, is a candidate even when it is round (method, section 7). Half
/// and half more move IoU by less than .0005.
const MIN_HALF_LENGTH: f64 = 2.0;

/// A splat of whose segment a share `r` less than this lies inside is dropped from the selection (method, section 7). Only for
/// the cut by prompted photos, which was not measured.
const MIN_INSIDE: f64 = 0.05;

/// Passes over one splat in one view: moving a splat changes its depth and so, a little, its size.
const PASSES: usize = 4;

/// Samples along a segment at most; longer segments are sampled more coarsely.
const SAMPLES: f64 = 4096.0;

/// Cosine to the viewing ray above which a splat is moved at fixed depth instead of along itself (method, section 7). Only for
/// the cut by prompted photos, which was not measured.
const MAX_RAY_COSINE: f64 = 0.95;

/// Smallest standard deviation written: its logarithm is finite.
const SCALE_MIN: f64 = 1e-12;

/// What a cut changes of a splat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SplatGeometry {
    /// Centre.
    pub mean: [f32; 3],
    /// Logarithms of the standard deviations.
    pub log_scales: [f32; 3],
    /// Rotation (w, x, y, z).
    pub rotation: [f32; 4],
}

/// An edit of a scene that can be applied and undone. The opacities stay.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SpikeCut {
    /// Splats that were shortened: index, what they were, what they become. Ascending.
    pub changed: Vec<(u32, SplatGeometry, SplatGeometry)>,
    /// Splats that leave the selection because (almost) nothing of them lies inside. Ascending; they stay in
    /// the scene as they were.
    pub dropped: Vec<u32>,
    /// Splats that were not selected but reach into the object: what lies inside, in `changed`, joins the selection.
    /// Ascending.
    pub joined: Vec<u32>,
}

/// A prompted photo and the object's mask on it.
#[derive(Clone, Copy, Debug)]
pub struct CutView<'a> {
    /// Intrinsics; any size, the mask is looked up at its own.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
    /// The object's pixels.
    pub mask: &'a Mask,
    /// Splats that this view may cut, such as those it sees; `None`: all. An occluded splat sticks out of
    /// the visible mask without being a spike.
    pub sees: Option<&'a [bool]>,
}

impl SplatGeometry {
    /// Of one splat.
    pub fn of(splats: &Splats, i: usize) -> SplatGeometry {
        SplatGeometry {
            mean: splats.means[i],
            log_scales: splats.log_scales[i],
            rotation: splats.rotations[i],
        }
    }

    fn put(&self, splats: &mut Splats, i: usize) {
        splats.means[i] = self.mean;
        splats.log_scales[i] = self.log_scales;
        splats.rotations[i] = self.rotation;
    }
}

impl SpikeCut {
    /// Cuts the splats of `selected` by the masks of several photos, one after the other. `near` is the
    /// distance before which nothing is visible. `splats` is untouched. Splats that are not finite are left alone.
    pub fn new(
        splats: &Splats,
        selected: &[bool],
        views: &[CutView],
        mode: SpikeMode,
        near: f32,
    ) -> SpikeCut {
        if mode == SpikeMode::Off {
            return SpikeCut::default();
        }
        // The mask is looked up in its own pixels.
        let views: Vec<CutView> = views
            .iter()
            .map(|v| CutView { camera: v.camera.resized(v.mask.width(), v.mask.height()), ..*v })
            .collect();
        SpikeCut::of(splats, selected, |i| cut_splat(splats, i, &views, mode, near))
    }

    /// Collects the outcome of `cut_one` for every selected splat.
    pub(crate) fn of(
        splats: &Splats,
        selected: &[bool],
        cut_one: impl Fn(usize) -> CutOutcome + Sync,
    ) -> SpikeCut {
        let outcomes: Vec<(u32, CutOutcome)> = selected
            .par_iter()
            .enumerate()
            .with_min_len(256)
            .filter(|(_, selected)| **selected)
            .map(|(i, _)| (i as u32, cut_one(i)))
            .collect();
        let mut cut = SpikeCut::default();
        for (i, outcome) in outcomes {
            match outcome {
                CutOutcome::Kept => {}
                CutOutcome::Changed(after) => {
                    cut.changed.push((i, SplatGeometry::of(splats, i as usize), after))
                }
                CutOutcome::Dropped => cut.dropped.push(i),
            }
        }
        cut
    }

    /// Puts the shortened splats in.
    pub fn apply(&self, splats: &mut Splats) {
        for (i, _, after) in &self.changed {
            after.put(splats, *i as usize);
        }
    }

    /// Takes them out again: the splats are bit for bit what they were.
    pub fn undo(&self, splats: &mut Splats) {
        for (i, before, _) in &self.changed {
            before.put(splats, *i as usize);
        }
    }

    /// Takes the dropped splats out of a selection, and those that join it in.
    pub fn trim(&self, labels: &mut [bool]) {
        self.dropped.iter().for_each(|&i| labels[i as usize] = false);
        self.joined.iter().for_each(|&i| labels[i as usize] = true);
    }
}

/// What becomes of one splat.
pub(crate) enum CutOutcome {
    Kept,
    Changed(SplatGeometry),
    Dropped,
}

/// What lies inside the mask of a segment.
struct Inside {
    /// Share of the samples inside.
    share: f64,
    /// Where the middle of the part to keep goes, in -1.5..1.5 standard deviations along the major axis.
    middle: f64,
}

fn cut_splat(splats: &Splats, i: usize, views: &[CutView], mode: SpikeMode, near: f32) -> CutOutcome {
    let Some(mut shape) = Ellipsoid::of(splats, i) else { return CutOutcome::Kept };
    let mut changed = false;
    for view in views.iter().filter(|v| v.sees.is_none_or(|sees| sees[i])) {
        for _ in 0..PASSES {
            let Some(footprint) = shape.project(&view.camera, &view.pose, near) else { break };
            let Some(inside) = sticking_out(&footprint, view.mask) else { break };
            if inside.share < MIN_INSIDE {
                return CutOutcome::Dropped;
            }
            if inside.share >= 1.0 {
                break;
            }
            let Some(next) = shorten(&shape, &footprint, &inside, view, mode) else { break };
            shape = next;
            changed = true;
        }
    }
    match changed.then(|| write(&shape)) {
        None => CutOutcome::Kept,
        Some(Some(after)) => CutOutcome::Changed(after),
        // Too extreme for f32 even after the cut: better no spike than a broken one.
        Some(None) => CutOutcome::Dropped,
    }
}

/// Whether a footprint is long enough to be examined.
pub(crate) fn is_spike(axes: &Axes) -> bool {
    axes.major >= MIN_ELONGATION * axes.minor || SEGMENT_END * axes.major.sqrt() > MIN_HALF_LENGTH
}

/// How much of a candidate lies inside the mask; `None` for splats that are not to be cut.
fn sticking_out(footprint: &EllipsoidFootprint, mask: &Mask) -> Option<Inside> {
    let axes = footprint.axes();
    let half = axes.direction * (SEGMENT_END * axes.major.sqrt());
    let at = |p: DVec2| mask.at(p.x as f32, p.y as f32);
    let (start_in, end_in) = (at(footprint.centre - half), at(footprint.centre + half));
    if (start_in && end_in) || !is_spike(&axes) || !half.is_finite() {
        return None;
    }
    // Samples at the middles of equal steps of at most a pixel, so that the kept part ends inside.
    let samples = (2.0 * half.abs().max_element()).min(SAMPLES).floor() as usize + 1;
    let samples = samples.max(2);
    let position = |k: f64| (2.0 * k / samples as f64 - 1.0) * SEGMENT_END;
    let (mut count, mut run, mut longest, mut longest_end) = (0, 0, 0, 0);
    for k in 0..samples {
        let t = position(k as f64 + 0.5) / SEGMENT_END;
        if at(footprint.centre + half * t) {
            count += 1;
            run += 1;
            if run > longest {
                (longest, longest_end) = (run, k + 1);
            }
        } else {
            run = 0;
        }
    }
    let share = |n: usize| n as f64 / samples as f64;
    Some(match (start_in, end_in) {
        // The kept part is 3 r standard deviations long and touches the inside end.
        (true, false) => Inside { share: share(count), middle: SEGMENT_END * (share(count) - 1.0) },
        (false, true) => Inside { share: share(count), middle: SEGMENT_END * (1.0 - share(count)) },
        _ => Inside { share: share(longest), middle: position(longest_end as f64 - 0.5 * longest as f64) },
    })
}

/// The splat moved to the middle of the part to keep and shrunk to it.
fn shorten(
    shape: &Ellipsoid,
    footprint: &EllipsoidFootprint,
    inside: &Inside,
    view: &CutView,
    mode: SpikeMode,
) -> Option<Ellipsoid> {
    let axes = footprint.axes();
    let deviation = axes.major.sqrt();
    // In the splat's own unit sphere, the direction that the photo sees as the major axis.
    let unit =
        ((footprint.u * axes.direction.x + footprint.v * axes.direction.y) / deviation).try_normalize()?;
    let along = shape.root * unit;
    let shift = axes.direction * (inside.middle * deviation);
    let mean = shape.mean + moved(footprint, along, shift, view);
    let root = match mode {
        SpikeMode::Isotropic => shape.root * inside.share,
        // Sigma' = A Sigma A^T with A = I - (1 - r) d n^T, d the direction above and n the photo's dual of it
        // (n = d where d is an axis of the splat): the image of the splat is exactly r times as long along the
        // cut and as wide as before across it.
        _ => shape.root * (DMat3::IDENTITY - outer(unit, unit) * (1.0 - inside.share)),
    };
    let next = Ellipsoid { mean, root };
    (mean.is_finite() && root.is_finite()).then_some(next)
}

/// The step in the world that moves the centre by `shift` pixels: along the splat, or at fixed depth where the
/// splat points along the viewing ray.
fn moved(footprint: &EllipsoidFootprint, along: DVec3, shift: DVec2, view: &CutView) -> DVec3 {
    let rotation = view.pose.rotation.as_dmat3();
    let (fx, fy) = (f64::from(view.camera.fx), f64::from(view.camera.fy));
    let p = footprint.camera_mean;
    let a = rotation * along;
    let target = p.truncate() / p.z + DVec2::new(shift.x / fx, shift.y / fy);
    // The step s for which the projection of p + s a lies at the target, measured along the shift.
    let axis = DVec2::new(shift.x * fx, shift.y * fy);
    let slope = axis.dot(a.truncate() - target * a.z);
    let step = axis.dot(target * p.z - p.truncate()) / slope;
    let steep = a.dot(p).abs() > MAX_RAY_COSINE * a.length() * p.length();
    let depth = p.z + step * a.z;
    // Perspective can turn a short shift into a long way; the kept part of the splat itself is within 1.5
    // standard deviations.
    if !steep && step.abs() <= 2.0 * SEGMENT_END && depth > 0.5 * p.z && depth < 2.0 * p.z {
        along * step
    } else {
        rotation.transpose() * DVec3::new(shift.x * p.z / fx, shift.y * p.z / fy, 0.0)
    }
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// Back to scales and a rotation, `None` where f32 cannot hold them.
pub(crate) fn write(shape: &Ellipsoid) -> Option<SplatGeometry> {
    let (axes, deviations) = svd::left(shape.root);
    let q = DQuat::from_mat3(&axes).normalize();
    let log_scales = deviations.map(|s| s.max(SCALE_MIN).ln() as f32);
    let geometry = SplatGeometry {
        mean: shape.mean.as_vec3().to_array(),
        log_scales,
        rotation: [q.w as f32, q.x as f32, q.y as f32, q.z as f32],
    };
    let finite =
        geometry.mean.iter().chain(&geometry.log_scales).chain(&geometry.rotation).all(|x| x.is_finite());
    finite.then_some(geometry)
}
