//! The spike cut by all photos that know the object, not by the clicked one alone.
//!
//! One mask is off by a pixel or three, and cuts splats that are right. Here each splat's longest axes are sampled
//! in 3D, every photo that sees the splat says of each sample whether it lies in its mask, and what most of them put
//! outside is cut off. The cut itself is the paper's along one axis (Eq. 29-32; method, section 7).

use crate::screen::Shape;
use crate::settings::SpikeMode;
use crate::sgc::{Cut, Outcome, is_spike, write};
use glam::{DMat3, DVec3};
use segwild_scene::{Camera, Mask, Pose, Splats};

/// Standard deviations at which an opaque splat has lost half of its alpha: what is seen of it ends here. Sampled to the
/// paper's 1.5, the part that is kept would be seen to end a fifth before the outline.
const EDGE: f64 = 1.177_41;

/// Samples along an axis.
const SAMPLES: usize = 16;

/// Share of the voices that must put a sample inside for it to stay. Under a half: where something else stands before
/// the object a photo's mask ends as well, and that is no reason to cut.
const KEEP: f32 = 0.3;

/// Voices, in photos, under which nothing is cut: fewer photos know less than the evidence that chose the splat.
const QUORUM: f32 = 1.0;

/// A photo whose own boundaries took part in a selection.
#[derive(Clone, Copy, Debug)]
pub struct Juror<'a> {
    /// Intrinsics; any size, the mask is looked up at its own.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
    /// The object's pixels.
    pub mask: &'a Mask,
    /// How well the photo sees each splat, in 1/255 of a photo that sees it whole.
    pub voice: &'a [u8],
    /// Weight of the photo.
    pub weight: f32,
}

impl Cut {
    /// Cuts the splats of `selected` by what most of the photos say. `near` is the distance before which nothing is
    /// visible. `splats` is untouched; splats that are not finite are left alone.
    pub fn by_jury(splats: &Splats, selected: &[bool], jury: &[Juror], mode: SpikeMode, near: f32) -> Cut {
        if mode == SpikeMode::Off {
            return Cut::default();
        }
        let jury: Vec<Juror> = jury
            .iter()
            .map(|j| Juror { camera: j.camera.resized(j.mask.width(), j.mask.height()), ..*j })
            .collect();
        Cut::of(splats, selected, |i| cut_splat(splats, i, &jury, mode, near))
    }
}

fn cut_splat(splats: &Splats, i: usize, jury: &[Juror], mode: SpikeMode, near: f32) -> Outcome {
    let Some(mut shape) = Shape::of(splats, i) else { return Outcome::Kept };
    let heard: Vec<&Juror> = jury.iter().filter(|j| j.voice.get(i).is_some_and(|v| *v > 0)).collect();
    let spike = |j: &&Juror| shape.project(&j.camera, &j.pose, near).is_some_and(|f| is_spike(&f.axes()));
    if !heard.iter().any(spike) {
        return Outcome::Kept;
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| shape.root.col(b).length_squared().total_cmp(&shape.root.col(a).length_squared()));
    let mut changed = false;
    // A splat is as flat as the surface it lies on: its two long axes can stick out, its thickness cannot.
    for axis in order.into_iter().take(2) {
        let Some((from, to)) = verdict(&shape, shape.root.col(axis), i, &heard, near) else { continue };
        let share = (to - from) as f64 / SAMPLES as f64;
        if to == from {
            return Outcome::Dropped;
        }
        let middle = place(0.5 * (from + to) as f64);
        let mean = shape.mean + shape.root.col(axis) * middle;
        let root = match mode {
            SpikeMode::Isotropic => shape.root * share,
            _ => {
                let mut kept = DVec3::ONE;
                kept[axis] = share;
                shape.root * DMat3::from_diagonal(kept)
            }
        };
        shape = Shape { mean, root };
        changed = true;
    }
    match changed.then(|| write(&shape)) {
        None => Outcome::Kept,
        Some(Some(after)) => Outcome::Changed(after),
        Some(None) => Outcome::Dropped,
    }
}

/// Where the `k`-th edge between samples lies, in standard deviations.
fn place(k: f64) -> f64 {
    (2.0 * k / SAMPLES as f64 - 1.0) * EDGE
}

/// The longest run of samples along an axis that most photos put inside, `None` where nothing is to be cut.
fn verdict(shape: &Shape, axis: DVec3, splat: usize, jury: &[&Juror], near: f32) -> Option<(usize, usize)> {
    let (mut inside, mut all) = ([0.0f32; SAMPLES], [0.0f32; SAMPLES]);
    for juror in jury {
        let rotation = juror.pose.rotation.as_dmat3();
        let centre = rotation * shape.mean + juror.pose.translation.as_dvec3();
        let step = rotation * axis;
        let voice = juror.weight * f32::from(juror.voice[splat]) / 255.0;
        for k in 0..SAMPLES {
            let p = centre + step * place(k as f64 + 0.5);
            if p.z.is_nan() || p.z <= f64::from(near) {
                continue;
            }
            let x = (f64::from(juror.camera.fx) * p.x / p.z) as f32 + juror.camera.cx;
            let y = (f64::from(juror.camera.fy) * p.y / p.z) as f32 + juror.camera.cy;
            // A photo says nothing of what lies outside its frame.
            if juror.camera.contains(glam::Vec2::new(x, y)) {
                all[k] += voice;
                inside[k] += if juror.mask.at(x, y) { voice } else { 0.0 };
            }
        }
    }
    let mut kept = (0..SAMPLES).map(|k| all[k] < QUORUM || inside[k] >= KEEP * all[k]);
    let (mut best, mut from) = ((0, 0), 0);
    for k in 0..=SAMPLES {
        if k < SAMPLES && kept.next().unwrap_or(false) {
            continue;
        }
        if k - from > best.1 - best.0 {
            best = (from, k);
        }
        from = k + 1;
    }
    (best != (0, SAMPLES)).then_some(best)
}
