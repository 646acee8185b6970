//! What a box leaves out (method, section 6.1).
//!
//! Who draws a box around an object says that nothing outside of it belongs to the object. One photo's mask is one vote among
//! those of many photos, and is easily outvoted: the ground that a statue stands on came along from photo to photo, although the
//! box ended at the statue's foot. What the box leaves out weighs more, and what lies beyond the photo's frame cannot be selected:
//! the photo cannot speak against it.

use crate::coverage::soft;
use crate::photo_evidence::view_evidence;
use crate::request::{PosedView, PromptedView, Request, project, view, working_camera};
use crate::{ClickHit, Evidence, SegmentError, occlusion};
use glam::Vec3;
use segwild_scene::{BoxPrompt, Camera, Mask, Prompts};

/// How far around a box the object may reach, as a share `m_b` of the box's longer side (method, section 6.1): people draw boxes
/// a little too small. By choice.
const BOX_MARGIN: f32 = 0.05;

/// The same in pixels of the photo in use, at least: splats are that wide. By choice.
const MIN_MARGIN: f32 = 2.0;

/// Share `rho_b` of its visible light inside of the box and its margin under which a splat is left out (method, section 6.1). By
/// choice.
const MAX_SHARE_INSIDE: f32 = 0.1;

/// Weight `W_b` of what a box leaves out against a photo's mask (method, section 6.1). About as much as
/// all photos that a round visits, where the prompted photo sees a splat whole. From docs/experiments/2026-11-29-boxes.md.
const BOX_WEIGHT: f32 = 64.0;

/// How near a box must come to the photo's frame for the object to go on beyond it, as a share `m_f` of the photo's long side
/// (method, section 6.1). By choice.
const FRAME_MARGIN: f32 = 0.01;

/// Coverage evidence `K_f`, in views, from which a splat whose centre lies beyond the frame reaches into the photo: its pixels
/// there decide (method, section 6.1). By choice.
const MIN_COVERAGE_INSIDE: f32 = 0.1;

/// What the boxes of all prompted photos leave out.
pub(crate) struct BoxBounds {
    /// Evidence against the splats that the photos see outside of their boxes.
    pub against: Evidence,
    /// The splats that can never be selected: those of the request, and those beyond the frame of a photo whose boxes lie within
    /// it. `None` where there are none.
    pub frozen: Option<Vec<bool>>,
}

impl BoxBounds {
    /// Of a request. A positive click that hits what the boxes leave out says that they are no bounds.
    pub fn of(request: &Request, positive: &[ClickHit]) -> Result<BoxBounds, SegmentError> {
        let n = request.splats.len();
        let (mut against, mut beyond) = (Evidence::none(n), vec![false; n]);
        for prompt in request.prompts.iter().filter(|p| bounds(p)) {
            let seen = evidence(request, prompt)?;
            let PosedView { camera, pose, .. } = view(request, prompt.view)?;
            let ends: Vec<BoxPrompt> = prompt.boxes.iter().map(|b| open_at_frame(b, camera)).collect();
            for i in 0..n {
                if seen.rho(i).is_some_and(|inside| inside < MAX_SHARE_INSIDE) {
                    against.outside[i] += BOX_WEIGHT * seen.outside[i];
                    against.known[i] += BOX_WEIGHT * seen.known[i];
                }
                beyond[i] |= seen.known[i] < MIN_COVERAGE_INSIDE
                    && lies_beyond(&ends, camera, pose.to_camera(request.splats.mean(i)));
            }
        }
        if contradicted(positive, |splat| against.outside[splat] > 0.0 || beyond[splat]) {
            (against, beyond) = (Evidence::none(n), Vec::new());
        }
        let own = request.frozen.unwrap_or(&[]);
        let frozen = match beyond.contains(&true) {
            true => Some((0..n).map(|i| beyond[i] || own.get(i) == Some(&true)).collect()),
            false => request.frozen.map(<[bool]>::to_vec),
        };
        Ok(BoxBounds { against, frozen })
    }
}

/// How far around a box the object may reach, in its pixels.
fn margin(b: &BoxPrompt) -> f32 {
    (BOX_MARGIN * (b.x1 - b.x0).abs().max((b.y1 - b.y0).abs())).max(MIN_MARGIN)
}

/// A box with its margin, its corners in order.
pub(crate) fn with_margin(b: &BoxPrompt) -> BoxPrompt {
    widened(b, margin(b))
}

/// A box widened on each side by a margin, its corners in order.
pub(crate) fn widened(b: &BoxPrompt, margin: f32) -> BoxPrompt {
    let (low, high) = (|a: f32, b: f32| a.min(b) - margin, |a: f32, b: f32| a.max(b) + margin);
    BoxPrompt { x0: low(b.x0, b.x1), y0: low(b.y0, b.y1), x1: high(b.x0, b.x1), y1: high(b.y0, b.y1) }
}

/// A box with its margin, whose sides at the photo's frame are moved to infinity: the object may go on there.
fn open_at_frame(b: &BoxPrompt, photo: &Camera) -> BoxPrompt {
    let (w, h) = (photo.width as f32, photo.height as f32);
    let near = FRAME_MARGIN * w.max(h);
    let (ends, wide) = (widened(b, 0.0), with_margin(b));
    let low = |end: f32, wide: f32| if end <= near { f32::NEG_INFINITY } else { wide };
    let high = |end: f32, wide: f32, side: f32| if end >= side - near { f32::INFINITY } else { wide };
    BoxPrompt {
        x0: low(ends.x0, wide.x0),
        y0: low(ends.y0, wide.y0),
        x1: high(ends.x1, wide.x1, w),
        y1: high(ends.y1, wide.y1, h),
    }
}

/// Whether a position in the photo's camera lies outside of its frame and of boxes that [`open_at_frame`] made.
fn lies_beyond(boxes: &[BoxPrompt], photo: &Camera, at: Vec3) -> bool {
    if at.z <= 0.0 {
        let closed = |b: &BoxPrompt| [b.x0, b.y0, b.x1, b.y1].iter().all(|side| side.is_finite());
        return boxes.iter().all(closed);
    }
    let pixel = photo.pixel(at);
    !photo.contains(pixel) && !boxes.iter().any(|b| holds(b, pixel.x, pixel.y))
}

/// Whether a positive click hits mostly splats that the boxes leave out: then the boxes are no bounds.
fn contradicted(positive: &[ClickHit], left_out: impl Fn(usize) -> bool) -> bool {
    positive.iter().any(|hit| {
        let out = hit.splats.iter().filter(|s| left_out(s.0 as usize));
        out.map(|s| s.1).sum::<f32>() > 0.5 * hit.alpha
    })
}

/// Whether a photo's boxes hold all that was clicked there as part of the object.
fn bounds(prompt: &PromptedView) -> bool {
    let mut meant = prompt.points.iter().filter(|p| p.inside);
    !prompt.boxes.is_empty() && meant.all(|p| prompt.boxes.iter().any(|b| holds(b, p.x, p.y)))
}

/// Whether a box, whatever the order of its corners, holds a position; both in pixels of one photo.
fn holds(b: &BoxPrompt, x: f32, y: f32) -> bool {
    let ordered = widened(b, 0.0);
    (ordered.x0..=ordered.x1).contains(&x) && (ordered.y0..=ordered.y1).contains(&y)
}

/// A mask of a photo without what lies outside of its box and margin, unless a positive click does. Prompts have the pixels of
/// `camera`.
pub(crate) fn within_box(mask: &Mask, prompts: &Prompts, camera: &Camera) -> Mask {
    let Some(wide) = prompts.boxes.first().map(with_margin) else { return mask.clone() };
    if prompts.points.iter().any(|point| point.inside && !holds(&wide, point.x, point.y)) {
        return mask.clone();
    }
    let (width, height) = (mask.width(), mask.height());
    let scale = [camera.width as f32 / width as f32, camera.height as f32 / height as f32];
    Mask::from_fn(width, height, |x, y| {
        mask.get(x, y) && holds(&wide, (x as f32 + 0.5) * scale[0], (y as f32 + 0.5) * scale[1])
    })
}

/// Per splat, its visible light within and outside of the boxes and the photo's own mask, without what a transient occludes.
fn evidence(request: &Request, prompt: &PromptedView) -> Result<Evidence, SegmentError> {
    let view = view(request, prompt.view)?;
    let camera = working_camera(request, view, Some(prompt.mask));
    let within = within(prompt, &view.camera, &camera);
    let inside = soft(&within, camera.width, camera.height);
    let transients = request.transients_in(prompt.view);
    let weights = occlusion::pixel_visibility(&inside, transients.as_ref(), None, &camera);
    let projected = project(request, view, &camera)?;
    view_evidence(request, &*projected, view, &camera, &within, &weights)
}

/// The pixels of the boxes with their margins, and of the mask. `photo`: the camera in whose pixels boxes are given.
fn within(prompt: &PromptedView, photo: &Camera, working: &Camera) -> Mask {
    let (sx, sy) = (photo.width as f32 / working.width as f32, photo.height as f32 / working.height as f32);
    let mask = prompt.mask.resized(working.width, working.height);
    Mask::from_fn(working.width, working.height, |x, y| {
        let (u, v) = ((x as f32 + 0.5) * sx, (y as f32 + 0.5) * sy);
        mask.get(x, y) || prompt.boxes.iter().any(|b| holds(&with_margin(b), u, v))
    })
}
