//! Initial transients: found by cross-checking before the training, so that it cannot fit them as part of the scene.
//!
//! A training on a photo fits all that the photo shows, transients too: trousers become a haze before the camera, a
//! car a stain on the ground. What it has fitted no longer contradicts it. A training without the photo cannot fit its
//! transients. So the photos are divided among several short trainings: each leaves its part out, and then marks the pixels
//! of that part that contradict it.

use crate::evaluate::{Unseen, render_unseen};
use crate::photos::{Stored, TrainPhotoCache};
use crate::posed::Posed;
use crate::{AppearanceModel, Model, TrainError, TrainSettings, Trainer};
use segwild_raster::Engine;
use segwild_raster::compare::{INITIAL_TRANSIENT, mean_difference, relative};
use segwild_scene::{Mask, Scene, View, box_mean};
use std::sync::Arc;

/// Steps of each training: a share of the whole training's, within these.
const STEPS: (u32, u32, u32) = (10, 100, 400);
/// Halvings of the photos.
const FINEST: usize = 1;
/// With fewer photos than this, too few are left to train on when a part is left out.
const FEW: usize = 20;
/// Mean share of the photos from which the result is used. Without transients .00 to .06 was found on five scenes, real and
/// synthetic; with 10 % covered .13 to .14, where it neither helps nor harms; with 25 % .23, where it does help.
const LEAST: f32 = 0.16;
/// The smallest blob, as a part of the photo's long side to each side, and how much of it must contradict.
const BLOB: usize = 24;
const SOLID: f32 = 0.8;

/// Per view, the pixels without multi-view support; `None` where nothing is known.
pub(crate) fn initial_transients(
    engine: &Arc<dyn Engine>,
    scene: &Scene,
    photos: &mut TrainPhotoCache,
    settings: &TrainSettings,
    stopping: &dyn Fn() -> bool,
) -> Result<Vec<Option<Mask>>, TrainError> {
    let mut found = vec![None; scene.views.len()];
    let train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
    let parts = settings.cross_checks as usize;
    if !settings.robust || parts < 2 || train.len() < FEW {
        return Ok(found);
    }
    let short = TrainSettings {
        steps: (settings.steps / STEPS.0).clamp(STEPS.1, STEPS.2),
        sh_degree: settings.sh_degree.min(1),
        splats: 0,
        appearance_model: if settings.appearance_model == AppearanceModel::None {
            AppearanceModel::None
        } else {
            AppearanceModel::Affine
        },
        ..settings.clone()
    };
    for part in 0..parts {
        let held: Vec<usize> = train.iter().copied().skip(part).step_by(parts).collect();
        let mut apart = scene.clone();
        held.iter().for_each(|&view| apart.views[view].test = true);
        let started = Trainer::start(engine.clone(), &apart, photos.take(), short.clone(), FINEST, &[]);
        let mut trainer = match started {
            // Too few can be read to leave any out; the training itself checks whether they are enough for it.
            Err(TrainError::NoPhotos(_)) => return Ok(vec![None; scene.views.len()]),
            started => started?,
        };
        while !trainer.is_done() {
            if stopping() {
                return Err(TrainError::Stopped);
            }
            match trainer.step() {
                Err(TrainError::NoPhotos(_)) => return Ok(vec![None; scene.views.len()]),
                step => {
                    step?;
                }
            }
        }
        let model = trainer.snapshot()?;
        let posed = trainer.views;
        *photos = trainer.photos;
        let held_splats = engine.hold(&model.splats)?;
        let renderer = held_splats.as_deref().unwrap_or(&**engine);
        for view in held {
            // One that cannot be read is named where it is trained on.
            if let Ok(stored) = photos.get(view) {
                let (at, share) = (&scene.views[view], settings.robust_share);
                found[view] = unknown(renderer, &model, at, &posed[view], &stored, share)?;
            }
        }
    }
    Ok(if share(&found) < LEAST { vec![None; scene.views.len()] } else { found })
}

/// Mean share of initial transients, over the photos of which something is known; 0 of none.
pub(crate) fn share(initial_transients: &[Option<Mask>]) -> f32 {
    let shares =
        initial_transients.iter().flatten().map(|m| m.count() as f32 / (m.width() * m.height()) as f32);
    shares.clone().sum::<f32>() / shares.count().max(1) as f32
}

/// The pixels of a photo that contradict a scene trained without it.
fn unknown(
    engine: &dyn Engine,
    model: &Model,
    view: &View,
    posed: &Posed,
    stored: &Stored,
    share: f32,
) -> Result<Option<Mask>, TrainError> {
    if stored.transients_known {
        return Ok(None);
    }
    let photo = stored.level(FINEST).1;
    let (w, n) = (photo.width, photo.pixels());
    let Unseen { shown, alpha } = render_unseen(model, engine, view, stored, FINEST, Some(&|_| true))?;
    let mut residual = posed.untrusted_residual(&mean_difference(&shown, &photo.image()), photo);
    // Where the scene is empty, a residual is no evidence.
    residual.iter_mut().zip(&alpha.data).for_each(|(r, alpha)| *r *= alpha);
    let ratio = relative(&residual, w, |i| photo.counts(i), share);
    let over = |i: usize| f32::from(u8::from(photo.counts(i) && ratio[i] > INITIAL_TRANSIENT));
    let over: Vec<f32> = (0..n).map(over).collect();
    // People and cars are blobs; residuals at edges, and where too few photos were left, are thin.
    let mean = |of: &[f32]| box_mean(of, w, photo.height, (w.max(photo.height) / BLOB).max(1));
    let solid: Vec<f32> = mean(&over).iter().map(|m| f32::from(u8::from(*m > SOLID))).collect();
    let near = mean(&solid);
    Ok(Some(Mask::from_fn(w as u32, photo.height as u32, |x, y| {
        let i = y as usize * w + x as usize;
        near[i] > 0.0 && over[i] > 0.0
    })))
}
