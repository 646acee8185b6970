//! What a box leaves out (method, section 6.1).
//!
//! Who draws a box around an object says that nothing outside of it belongs to the object. One photo's mask is one vote among
//! those of many photos, and can be outvoted; this cannot. Without it, the ground that a statue stands on came along from photo
//! to photo, although the box ended at the statue's foot.

use crate::coverage::soft;
use crate::photo_evidence::view_evidence;
use crate::request::{PromptedView, Request, project, view, working_camera};
use crate::{ClickHit, Evidence, SegmentError, occlusion};
use segwild_scene::{BoxPrompt, Camera, Mask};

/// How far around a box the object may reach, as a share `m_b` of the box's longer side (method, section 6.1): people draw boxes
/// a little too small. By choice.
const BOX_MARGIN: f32 = 0.05;

/// The same in pixels of the photo in use, at least: splats are that wide. By choice.
const MIN_MARGIN: f32 = 2.0;

/// Share `rho_b` of its visible light inside of the box and its margin under which a splat is left out (method, section 6.1). By
/// choice.
const MAX_SHARE_INSIDE: f32 = 0.1;

/// Weight `W_b` of what a box leaves out against a photo's mask (method, section 6.1). With 64, no number of photos that a round
/// visits outvotes it where the prompted photo sees a splat well. From
/// docs/experiments/2026-11-29-boxes.md.
const BOX_WEIGHT: f32 = 64.0;

/// Evidence against the splats that the boxes of the prompted photos leave out; none where a positive click hits them: then the
/// boxes are no bounds.
pub(crate) fn against(request: &Request, positive: &[ClickHit]) -> Result<Evidence, SegmentError> {
    let mut against = Evidence::none(request.splats.len());
    for prompt in request.prompts.iter().filter(|p| bounds(p)) {
        let evidence = evidence(request, prompt)?;
        for i in 0..request.splats.len() {
            if evidence.rho(i).is_some_and(|inside| inside < MAX_SHARE_INSIDE) {
                against.outside[i] += BOX_WEIGHT * evidence.outside[i];
                against.known[i] += BOX_WEIGHT * evidence.known[i];
            }
        }
    }
    let contradicts = |hit: &ClickHit| {
        let outside = |s: &&(u32, f32)| against.outside[s.0 as usize] > 0.0;
        hit.splats.iter().filter(outside).map(|s| s.1).sum::<f32>() > 0.5 * hit.alpha
    };
    if positive.iter().any(contradicts) {
        return Ok(Evidence::none(request.splats.len()));
    }
    Ok(against)
}

/// Whether a photo's boxes hold all that was clicked there as part of the object.
fn bounds(prompt: &PromptedView) -> bool {
    let holds = |b: &BoxPrompt, x: f32, y: f32| {
        let (x0, x1, y0, y1) = (b.x0.min(b.x1), b.x0.max(b.x1), b.y0.min(b.y1), b.y0.max(b.y1));
        (x0..=x1).contains(&x) && (y0..=y1).contains(&y)
    };
    !prompt.boxes.is_empty()
        && prompt.points.iter().filter(|p| p.inside).all(|p| prompt.boxes.iter().any(|b| holds(b, p.x, p.y)))
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
    let (sx, sy) = (working.width as f32 / photo.width as f32, working.height as f32 / photo.height as f32);
    let wide = |b: &BoxPrompt| {
        let margin = (BOX_MARGIN * (b.x1 - b.x0).abs().max((b.y1 - b.y0).abs())).max(MIN_MARGIN);
        let (x0, x1) = (b.x0.min(b.x1) - margin, b.x0.max(b.x1) + margin);
        let (y0, y1) = (b.y0.min(b.y1) - margin, b.y0.max(b.y1) + margin);
        (x0 * sx, y0 * sy, x1 * sx, y1 * sy)
    };
    let boxes: Vec<_> = prompt.boxes.iter().map(wide).collect();
    let mask = prompt.mask.resized(working.width, working.height);
    Mask::from_fn(working.width, working.height, |x, y| {
        let (u, v) = (x as f32 + 0.5, y as f32 + 0.5);
        mask.get(x, y) || boxes.iter().any(|&(x0, y0, x1, y1)| u >= x0 && u <= x1 && v >= y0 && v <= y1)
    })
}
