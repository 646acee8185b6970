//! Choice of appearance model and steps before a training: short fits that are scored on photos held out of them, and what a
//! given time buys (method, section 9).

mod appearance;
mod budget;
mod speed;
mod time;
mod tracks;

pub use appearance::{APPEARANCE_MODELS, AppearanceChoice, SIZE, choose_appearance};
pub use budget::{BudgetChoice, choose_budget, trial_size};
pub use speed::{StepSpeed, measure_steps};
pub use time::{TimeBounds, TimeChoice, TimeModel, TooLittleTime};
pub use tracks::Tracks;

use crate::evaluate::{render_unseen, score};
use crate::photos::Stored;
use crate::posed::{Posed, posed_view};
use crate::{AppearanceModel, Photos, TrainError, TrainSettings, Trainer};
use segwild_objective::Engine;
use segwild_scene::{Image, Scene};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Photos held out of the short fits: one in so many, and no more than this.
const HELD_OUT: (usize, usize) = (6, 10);
/// Photos used, at most: a part of a large set gives the same choice as all of it.
const MOST: usize = 80;
/// With fewer photos than this nothing can be held out.
const FEW: usize = 8;

/// Score of a short fit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ShortFit {
    /// Its appearance model.
    pub appearance: AppearanceModel,
    /// Its steps.
    pub steps: u32,
    /// The splats it came to.
    pub splats: usize,
    /// Mean PSNR on the photos held out of it, in dB: the appearance fitted on the left half, the right half scored, without
    /// the pixels that contradict all fits.
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
    /// Photos that can be read.
    usable: Vec<usize>,
    /// Photos that fits are scored on; none where there are too few.
    held_out: Vec<HeldOutPhoto>,
    /// The fits so far, in that order.
    fits: Vec<ShortFit>,
    stopping: &'a dyn Fn() -> bool,
}

/// A photo that fits are scored on.
struct HeldOutPhoto {
    view: usize,
    posed: Posed,
    photo: Stored,
    /// The render of each fit from its camera.
    renders: Vec<Image>,
    /// Per pixel, whether it contradicts every fit. A transient does so whatever is tried, and is left out of the scores.
    transient: Vec<bool>,
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
        // A photo that cannot be read is skipped here, and named where it is trained on.
        let usable: Vec<usize> =
            train.into_iter().step_by(skip).filter(|&v| photos.photo(v).is_ok()).collect();
        let mut held_out = Vec::new();
        if usable.len() >= FEW {
            let every = HELD_OUT.0.max(usable.len().div_ceil(HELD_OUT.1));
            held_out = usable
                .iter()
                .skip(every / 2)
                .step_by(every)
                .filter_map(|&view| {
                    let photo = photos.photo(view).ok()?;
                    let photo = Stored::pack(&scene.views[view].name, &photo).ok()?;
                    let transient = vec![true; photo.levels[0].pixels()];
                    Some(HeldOutPhoto {
                        view,
                        posed: posed_view(scene, view),
                        photo,
                        renders: Vec::new(),
                        transient,
                    })
                })
                .collect();
        }
        let mut apart = scene.clone();
        for (view, v) in apart.views.iter_mut().enumerate() {
            v.test = v.test || held_out.iter().any(|held| held.view == view) || !usable.contains(&view);
        }
        Trials { engine, photos, scene: apart, usable, held_out, fits: Vec::new(), stopping }
    }

    /// Trains once, and scores this fit and again all fits before it.
    fn fit(&mut self, settings: TrainSettings) -> Result<(), TrainError> {
        let (appearance, steps) = (settings.appearance_model, settings.steps);
        let share = settings.transient_share();
        // Models and steps are compared by PSNR and SSIM: the short trainings go without the dear term of the loss.
        let settings = TrainSettings { lambda_lpips: 0.0, ..settings };
        let (engine, photos) = (self.engine.clone(), self.photos.clone());
        let mut trainer = Trainer::from_points(engine, &self.scene, photos, settings, false)?;
        while !trainer.is_done() {
            if (self.stopping)() {
                return Err(TrainError::Stopped);
            }
            trainer.step()?;
        }
        let model = trainer.snapshot()?;
        self.fits.push(ShortFit { appearance, steps, splats: model.splats.len(), psnr: 0.0, ssim: 0.0 });
        let resident = self.engine.upload_splats(&model.splats)?;
        let renderer = resident.as_deref().unwrap_or(&*self.engine);
        for held in &mut self.held_out {
            let view = &self.scene.views[held.view];
            let photo = &held.photo.levels[0];
            let w = photo.width;
            let left = |i: usize| i % w < w / 2;
            let shown = render_unseen(&model, renderer, view, &held.photo, 0, Some(&left))?.shown;
            let against = held.posed.contradicted(&shown, photo, share);
            held.transient.iter_mut().zip(against).for_each(|(transient, against)| *transient &= against);
            held.renders.push(shown);
        }
        for (k, fit) in self.fits.iter_mut().enumerate() {
            let scores = self.held_out.iter().map(|held| {
                let photo = &held.photo.levels[0];
                let right = |i: usize| i % photo.width >= photo.width / 2;
                score(&held.renders[k], photo, |i| right(i) && !held.transient[i])
            });
            let (psnr, ssim) = scores.fold((0.0, 0.0), |sum, s| (sum.0 + s.0, sum.1 + s.1));
            let n = self.held_out.len() as f32;
            (fit.psnr, fit.ssim) = (psnr / n, ssim / n);
        }
        Ok(())
    }
}
