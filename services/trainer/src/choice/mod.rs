//! What a training needs, found before it: short fits that are scored on photos held out of them (method, section 9).

mod budget;
mod look;
mod tracks;

pub use budget::{BudgetChoice, choose_budget, trial_size};
pub use look::{LookChoice, RUNGS, SIZE, choose_look};
pub use tracks::Tracks;

use crate::{LookKind, Photos, Protocol, TrainError, TrainSettings, Trainer, evaluate};
use segwild_raster::Engine;
use segwild_scene::Scene;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Photos held out of the short fits: one in so many, and no more than this.
const HELD_OUT: (usize, usize) = (6, 10);
/// Photos looked at, at most: some of a large pile tell as much as all.
const MOST: usize = 80;
/// With fewer photos than this nothing can be held out.
const FEW: usize = 8;

/// Score of a short fit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShortFit {
    /// Its look.
    pub look: LookKind,
    /// Its steps.
    pub steps: u32,
    /// The splats it came to.
    pub splats: usize,
    /// Mean PSNR on the photos held out of it, in dB: the look fitted on the left half, the right half scored.
    pub psnr: f32,
    /// Mean SSIM.
    pub ssim: f32,
}

/// A scene with some photos held out, on which short trainings are tried.
struct Trials<'a> {
    engine: Arc<dyn Engine>,
    photos: Arc<dyn Photos>,
    /// The scene, with `held_out` and what cannot be read taken out of the training.
    scene: Scene,
    /// Photos looked at.
    usable: Vec<usize>,
    /// Photos that fits are scored on; none where there are too few.
    held_out: Vec<usize>,
    stopping: &'a dyn Fn() -> bool,
}

impl<'a> Trials<'a> {
    fn new(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        stopping: &'a dyn Fn() -> bool,
    ) -> Trials<'a> {
        let train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
        let skip = train.len().div_ceil(MOST).max(1);
        // One that cannot be read says nothing here, and is named where it is trained on.
        let usable: Vec<usize> =
            train.into_iter().step_by(skip).filter(|&v| photos.photo(v).is_ok()).collect();
        let mut held_out = Vec::new();
        if usable.len() >= FEW {
            let every = HELD_OUT.0.max(usable.len().div_ceil(HELD_OUT.1));
            held_out = usable.iter().copied().skip(every / 2).step_by(every).collect();
        }
        let mut apart = scene.clone();
        for (view, v) in apart.views.iter_mut().enumerate() {
            v.test = v.test || held_out.contains(&view) || !usable.contains(&view);
        }
        Trials { engine, photos, scene: apart, usable, held_out, stopping }
    }

    /// Trains once and scores what came of it.
    fn fit(&self, settings: TrainSettings) -> Result<ShortFit, TrainError> {
        let (look, steps) = (settings.look, settings.steps);
        let mut trainer = Trainer::new(self.engine.clone(), &self.scene, self.photos.clone(), settings)?;
        while !trainer.is_done() {
            if (self.stopping)() {
                return Err(TrainError::Stopped);
            }
            trainer.step()?;
        }
        let (model, photos) = (trainer.snapshot(), self.photos.clone());
        let scored = evaluate(&model, &*self.engine, &self.scene, photos, &self.held_out, Protocol::Halves)?;
        Ok(ShortFit { look, steps, splats: model.splats.len(), psnr: scored.psnr, ssim: scored.ssim })
    }
}
