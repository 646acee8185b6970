//! The evidence of one photo's mask for the splats (method, section 6).

use crate::coverage::{centre, coverage_by, soft, unoccluded_light};
use crate::request::{PosedView, PromptedView, Request, project, view, working_camera};
use crate::settings::EvidenceMode;
use crate::{Evidence, SegmentError, depth_layers, occlusion};
use segwild_raster::Projected;
use segwild_scene::{Camera, Mask};

/// Factor `c` on how much is known by a prompted photo against one that was only refined (method, section 6.1): where its mask
/// leaves nothing open, no other photo may treat as unknown what it puts outside, however little it sees of any splat there.
/// From the test `carried.rs` (docs/experiments/2026-11-26-small-coverage.md). IoU by half, half more: 0, -.001 on
/// `sacre_coeur`; -.001, +.001 on the demo.
const PROMPTED_COVERAGE: f32 = 4.0;

/// The evidence of a prompted photo.
pub(crate) fn prompted_evidence(request: &Request, prompt: &PromptedView) -> Result<Evidence, SegmentError> {
    let view = view(request, prompt.view)?;
    let camera = working_camera(request, view, Some(prompt.mask));
    let projected = project(request, view, &camera)?;
    if prompt.refused {
        let (nothing, weights) = (Mask::empty(1, 1), soft(prompt.mask, camera.width, camera.height));
        return view_evidence(request, &*projected, view, &camera, &nothing, &weights);
    }
    let mut weights = vec![1.0; camera.width as usize * camera.height as usize];
    if let Some(open) = prompt.open {
        // The inside of the mask was prompted; where it ends is a guess. A pixel that is as likely part of the object as not
        // has no weight.
        let open = open.resized(camera.width as usize, camera.height as usize);
        for (weight, chance) in weights.iter_mut().zip(open.plane(0)) {
            let certainty = 1.0 - 2.0 * chance;
            *weight = if certainty.is_nan() { 1.0 } else { certainty.clamp(0.0, 1.0) };
        }
    }
    let inside = soft(prompt.mask, camera.width, camera.height);
    let transients = request.transients_in(prompt.view);
    let pixel_visibility = occlusion::pixel_visibility(&inside, transients.as_ref(), None, &camera);
    weights.iter_mut().zip(&pixel_visibility).for_each(|(weight, visible)| *weight *= visible);
    let mut evidence = view_evidence(request, &*projected, view, &camera, prompt.mask, &weights)?;
    if request.settings.evidence_mode == EvidenceMode::Coverage {
        depth_layers::discount_background(&mut evidence, &*projected, prompt, inside, &view.camera, &camera)
            .map_err(SegmentError::raster(&view.name))?;
        evidence.known.iter_mut().for_each(|known| *known *= PROMPTED_COVERAGE);
    }
    Ok(evidence)
}

/// The evidence of one view's mask, by the mode of the settings. `weights`: one number in [0, 1] per pixel.
pub(crate) fn view_evidence(
    request: &Request,
    projected: &dyn Projected,
    view: &PosedView,
    camera: &Camera,
    mask: &Mask,
    weights: &[f32],
) -> Result<Evidence, SegmentError> {
    let (settings, size) = (request.settings, (camera.width, camera.height));
    match settings.evidence_mode {
        EvidenceMode::Coverage => {
            let mut inside = soft(mask, size.0, size.1);
            inside.iter_mut().zip(weights).for_each(|(inside, weight)| *inside *= weight);
            let whole = |i| unoccluded_light(request.splats, camera, &view.pose, &request.options, i);
            coverage_by(projected, whole, &inside, weights, size, settings.vote)
                .map_err(SegmentError::raster(&view.name))
        }
        EvidenceMode::Centre => Ok(centre(projected, &mask.resized(size.0, size.1), request.options.near)),
    }
}
