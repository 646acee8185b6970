//! The spike cut by the votes of all photos that see the object, not by the clicked one alone.
//!
//! One mask is off by up to three pixels, and cuts splats that are right. Here each splat's longest axes are sampled
//! in 3D, every photo that sees the splat votes on each sample by its mask, and what most of them put
//! outside is cut off. The cut itself is the paper's along one axis (Eq. 29-32; method, section 7).
//!
//! A splat astride the outline is an error whichever side it is given to: selected it sticks out, left out it leaves a
//! hole in the object. So a splat that lies mostly outside but reaches in is cut as well, and the piece inside joins.

use crate::screen::Ellipsoid;
use crate::settings::SpikeMode;
use crate::sgc::{CutOutcome, SpikeCut, is_spike, write};
use glam::{DMat3, DVec3};
use segwild_scene::{Camera, Mask, Pose, Splats};

/// Standard deviations `e` at which an opaque splat has lost half of its alpha, `sqrt(2 ln 2)` (method, section 7): what is
/// seen of it ends here. Sampled to the paper's 1.5, the part that is kept would be seen to end a fifth before the outline.
const HALF_ALPHA_END: f64 = 1.177_41;

/// Samples along an axis, and how often the step between two of them is halved to find the end.
const SAMPLES: usize = 16;
const HALVINGS: usize = 5;

/// Share `r_v` of the votes that must put a sample inside for it to stay (method, section 7). Under a half: where something
/// else stands before the object a photo's mask ends as well, and that is no reason to cut. By choice. IoU by half, half more:
/// -.003, +.004 on `sacre_coeur`; 0, -.006 on the demo.
const KEPT_VOTES: f32 = 0.3;

/// Sum of votes, in photos, under which nothing is cut (method, section 7): fewer photos know less than the evidence that chose
/// the splat. By choice. IoU by half, half more: -.003, +.005 on `sacre_coeur`; -.002, -.004 on the demo.
const MIN_VOTES: f32 = 1.0;

/// The vote of a photo's mask, where its own boundaries took part in a selection.
#[derive(Clone, Copy, Debug)]
pub struct MaskVote<'a> {
    /// Intrinsics; any size, the mask is looked up at its own.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
    /// The object's pixels.
    pub mask: &'a Mask,
    /// How well the photo sees each splat, in 1/255 of full weight.
    pub visibility: &'a [u8],
    /// Weight of the photo.
    pub weight: f32,
}

impl SpikeCut {
    /// Cuts the splats of `selected` by the majority of the photos, and adds the inner pieces of the splats `astride` (none of
    /// them selected). `near` is the distance before which nothing is visible. `splats` is untouched; splats
    /// that are not finite are left alone.
    pub fn cut_by_votes(
        splats: &Splats,
        selected: &[bool],
        astride: &[bool],
        votes: &[MaskVote],
        mode: SpikeMode,
        near: f32,
    ) -> SpikeCut {
        if mode == SpikeMode::Off {
            return SpikeCut::default();
        }
        let votes: Vec<MaskVote> = votes
            .iter()
            .map(|j| MaskVote { camera: j.camera.resized(j.mask.width(), j.mask.height()), ..*j })
            .collect();
        let cut_one = |i| cut_splat(splats, i, &votes, mode, near);
        let mut cut = SpikeCut::of(splats, selected, cut_one);
        // A splat that nothing cuts is no spike, and stays whole outside the selection.
        let reaching_in = SpikeCut::of(splats, astride, cut_one).changed;
        cut.joined = reaching_in.iter().map(|c| c.0).collect();
        cut.changed.extend(reaching_in);
        cut.changed.sort_unstable_by_key(|c| c.0);
        cut
    }
}

fn cut_splat(splats: &Splats, i: usize, votes: &[MaskVote], mode: SpikeMode, near: f32) -> CutOutcome {
    let Some(mut shape) = Ellipsoid::of(splats, i) else { return CutOutcome::Kept };
    let seeing: Vec<&MaskVote> =
        votes.iter().filter(|j| j.visibility.get(i).is_some_and(|v| *v > 0)).collect();
    let spike = |j: &&MaskVote| shape.project(&j.camera, &j.pose, near).is_some_and(|f| is_spike(&f.axes()));
    if !seeing.iter().any(spike) {
        return CutOutcome::Kept;
    }
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| shape.root.col(b).length_squared().total_cmp(&shape.root.col(a).length_squared()));
    let mut changed = false;
    // A splat is as flat as the surface it lies on: its two long axes can stick out, its thickness cannot.
    for axis in order.into_iter().take(2) {
        let Some((from, to)) = kept_range(&shape, shape.root.col(axis), i, &seeing, near) else { continue };
        let share = 0.5 * (to - from) / HALF_ALPHA_END;
        if share <= 0.0 {
            return CutOutcome::Dropped;
        }
        let mean = shape.mean + shape.root.col(axis) * (0.5 * (from + to));
        let root = match mode {
            SpikeMode::Isotropic => shape.root * share,
            _ => {
                let mut kept = DVec3::ONE;
                kept[axis] = share;
                shape.root * DMat3::from_diagonal(kept)
            }
        };
        shape = Ellipsoid { mean, root };
        changed = true;
    }
    match changed.then(|| write(&shape)) {
        None => CutOutcome::Kept,
        Some(Some(after)) => CutOutcome::Changed(after),
        Some(None) => CutOutcome::Dropped,
    }
}

/// One photo's vote on one axis of one splat.
struct AxisVote<'a> {
    mask_vote: &'a MaskVote<'a>,
    centre: DVec3,
    step: DVec3,
    visibility: f32,
}

/// Whether the votes leave the point `t` standard deviations along the axis inside.
fn stays(sights: &[AxisVote], t: f64, near: f32) -> bool {
    let (mut inside, mut all) = (0.0, 0.0);
    for AxisVote { mask_vote, centre, step, visibility } in sights {
        let p = *centre + *step * t;
        if p.z.is_nan() || p.z <= f64::from(near) {
            continue;
        }
        let x = (f64::from(mask_vote.camera.fx) * p.x / p.z) as f32 + mask_vote.camera.cx;
        let y = (f64::from(mask_vote.camera.fy) * p.y / p.z) as f32 + mask_vote.camera.cy;
        // A photo has no vote outside its frame.
        if mask_vote.camera.contains(glam::Vec2::new(x, y)) {
            all += visibility;
            inside += if mask_vote.mask.at(x, y) { *visibility } else { 0.0 };
        }
    }
    all < MIN_VOTES || inside >= KEPT_VOTES * all
}

/// The longest stretch of an axis, in standard deviations, that the votes leave inside; `None` where nothing is to be cut. An
/// empty one lies wholly outside.
fn kept_range(
    shape: &Ellipsoid,
    axis: DVec3,
    splat: usize,
    votes: &[&MaskVote],
    near: f32,
) -> Option<(f64, f64)> {
    let sights: Vec<AxisVote> = votes
        .iter()
        .map(|mask_vote| {
            let rotation = mask_vote.pose.rotation.as_dmat3();
            AxisVote {
                mask_vote,
                centre: rotation * shape.mean + mask_vote.pose.translation.as_dvec3(),
                step: rotation * axis,
                visibility: mask_vote.weight * f32::from(mask_vote.visibility[splat]) / 255.0,
            }
        })
        .collect();
    let position = |k: f64| (2.0 * k / SAMPLES as f64 - 1.0) * HALF_ALPHA_END;
    let middle = |k: usize| position(k as f64 + 0.5);
    let (mut best, mut from) = ((0, 0), 0);
    for k in 0..=SAMPLES {
        if k < SAMPLES && stays(&sights, middle(k), near) {
            continue;
        }
        if k - from > best.1 - best.0 {
            best = (from, k);
        }
        from = k + 1;
    }
    let (from, to) = best;
    if to == from {
        return Some((0.0, 0.0));
    }
    // The end itself, between the last sample that stays and the first that does not. What is kept lies inside to its
    // last sample, so that a second cut finds nothing.
    let end = |inside: usize, outside: usize| {
        let (mut kept, mut lost) = (middle(inside), middle(outside));
        for _ in 0..HALVINGS {
            let midpoint = 0.5 * (kept + lost);
            *if stays(&sights, midpoint, near) { &mut kept } else { &mut lost } = midpoint;
        }
        kept
    };
    let low = if from == 0 { -HALF_ALPHA_END } else { end(from, from - 1) };
    let high = if to == SAMPLES { HALF_ALPHA_END } else { end(to - 1, to) };
    (best != (0, SAMPLES)).then_some((low, high))
}
