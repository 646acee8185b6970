//! How likely each pixel of a photo is a transient, once the scene is trained.

use crate::TrainError;
use crate::model::{Model, render_view};
use crate::photos::{Stored, TrainPhoto};
use crate::posed::posed_view;
use segwild_objective::compare::weighted_psnr;
use segwild_objective::transients::{limit, smoothed};
use segwild_raster::Rasterizer;
use segwild_scene::{Image, Scene};

/// Where the certainty is one half, as a share of the residual that training leaves out: by then the scene has learnt a
/// part of every transient. Three synthetic scenes (10, 25 and 25 % covered): mean IoU .68, .56, .65 at 1; .68, .59, .68 at
/// 0.8; .68, .61, .70 at 0.65.
const AT: f32 = 0.65;
/// How sharply the certainty rises there, and how small and large it gets.
const STEEP: f32 = 1.5;
const LEAST: f32 = 0.02;

/// Evidence of transients in a photo.
#[derive(Clone, Debug)]
pub struct TransientEvidence {
    /// Per pixel, how certainly it shows something that the scene does not, in [0, 1]; `None` where nothing in the photo
    /// stands out.
    pub certainty: Option<Image>,
    /// How well the photo fits over all pixels that count, in dB.
    pub psnr: f32,
}

/// Compares a photo with the trained scene in its own light. `share` is the most of the photo that may be transients;
/// 0 where it shows none.
pub fn transient_evidence(
    model: &Model,
    engine: &dyn Rasterizer,
    scene: &Scene,
    view: usize,
    photo: &TrainPhoto,
    share: f32,
) -> Result<TransientEvidence, TrainError> {
    let posed = posed_view(scene, view);
    let stored = Stored::pack(&posed.name, photo)?;
    let level = &stored.levels[0];
    let (w, h) = (level.width, level.height);
    let camera = stored.camera(&posed.camera, 0);
    let shown = render_view(model, engine, &camera, &posed.pose, Some(view))?;
    let weights: Vec<f32> = (0..w * h).map(|i| f32::from(u8::from(level.counts(i)))).collect();
    let psnr = weighted_psnr(&shown, &level.image(), &weights);
    let residual = posed.residual(&shown, level);
    let smooth = smoothed(&residual, w);
    let limit = if share > 0.0 { limit(&smooth, |i| level.counts(i), share) } else { None };
    let Some(limit) = limit else {
        return Ok(TransientEvidence { certainty: None, psnr });
    };
    let certainty = |i: usize| {
        if !level.counts(i) {
            return LEAST; // sky and invalid pixels are no transient
        }
        let odds = (smooth[i] / (AT * limit)).max(1e-3).powf(STEEP);
        (odds / (1.0 + odds)).clamp(LEAST, 1.0 - LEAST)
    };
    let data: Vec<f32> = (0..w * h).map(certainty).collect();
    let stands_out = data.iter().any(|&c| c > 0.5);
    let certainty = stands_out.then_some(Image { width: w, height: h, channels: 1, data });
    Ok(TransientEvidence { certainty, psnr })
}
