//! What the stages of a run share: its inputs, its keys, what was made so far, and how results are recorded.

use super::options::RunOptions;
use super::products::Products;
use super::skies::Skies;
use super::speed::MaskSpeed;
use super::stage::Stage;
use super::tally::Tally;
use super::view_slots::ViewSlots;
use crate::artifacts::cache::{SNAPSHOT, TRAINING};
use crate::artifacts::cameras;
use crate::artifacts::checkpoints::Keeper;
use crate::artifacts::folder::MODEL;
use crate::artifacts::keys::{Keys, TrainingOrigin};
use crate::artifacts::recompute::Recompute;
use crate::output::light;
use crate::transients::KnownTransients;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::ledger::{State, ViewOutcome, ViewRow};
use segwild_flow::{ActorFailure, Cache, Event, Key, Ledger, Phase, Quarantined, StageProgress, lock};
use segwild_masks::MaskMaker;
use segwild_objective::Engine;
use segwild_scene::{PhotoStore, Scene, Skipped};
use segwild_trainer::{Lpips, Model};
use segwild_vision::{Embedder, PromptSegmenter};
use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

/// What the stages of a run share.
pub struct RunContext<'a> {
    pub folder: &'a RunFolder,
    pub settings: &'a Settings,
    pub options: &'a RunOptions,
    pub ledger: &'a Ledger,
    /// With its poses as given: what a training starts from.
    pub given: Arc<Scene>,
    /// The same with the poses of the trained scene, once it is there.
    pub scene: Arc<Scene>,
    /// Its photos, at the size of the training.
    pub photos: Arc<PhotoStore>,
    pub engine: Arc<dyn Engine>,
    /// The keys of a run that finds every sky.
    pub full_keys: Keys,
    /// The keys of this training on other engines: their checkpoints serve where it has none of its own.
    pub elsewhere: Vec<(&'static str, Key)>,
    /// Where the training starts, if not at step 0.
    pub origin: Option<TrainingOrigin>,
    /// The keys of this run, as far as they are known.
    pub keys: Keys,
    /// The same, for the warning about a damaged artefact, which names the artefact.
    pub names: Arc<Mutex<Keys>>,
    /// The ledger names the training: when its key changes, it is named again.
    pub training_named: bool,
    pub cache: Cache,
    /// The last stage to run; the stages after it are not requested.
    pub last: Stage,
    /// The step of the training to stop after.
    pub steps: u32,
    pub skies: Arc<Skies>,
    /// What is known of transients before anything is trained.
    pub known: KnownTransients,
    /// The perceptual distance, where its weights are given.
    pub lpips: Option<Arc<Lpips>>,
    pub segmenter: Arc<dyn PromptSegmenter>,
    pub embedder: Arc<dyn Embedder>,
    pub maker: Arc<MaskMaker>,
    /// Per view, whether its masks are in the cache; `false` when they were given up.
    pub masks_known: Arc<ViewSlots<bool>>,
    /// How fast masks are made.
    pub mask_speed: MaskSpeed,
    /// The trainer misses an input: a stop ended the wait for a photo's sky, or a photo file was removed. What it makes
    /// from then on is not kept.
    pub tainted: Arc<AtomicBool>,
    /// Progress of the stages that go view by view or step by step.
    pub bars: BTreeMap<Stage, StageProgress>,
    pub made: Products,
    pub tally: Tally,
}

impl RunContext<'_> {
    /// Whether a stage was requested.
    pub fn wants(&self, stage: Stage) -> bool {
        stage <= self.last
    }

    /// Whether the run is to stop.
    pub fn is_stopping(&self) -> bool {
        self.options.stopper.phase() != Phase::Running
    }

    /// The checkpoints of this training.
    pub fn keeper(&self) -> Keeper<'_> {
        Keeper {
            folder: self.folder,
            ledger: self.ledger,
            events: &self.options.events,
            key: &self.keys.training,
            kept: self.settings.run.keep_checkpoints as usize,
        }
    }

    /// Reads artefacts of photos, and recomputes those that are damaged.
    pub fn recompute(&self) -> Recompute {
        Recompute {
            scene: self.scene.clone(),
            cache: self.cache.clone(),
            events: self.options.events.clone(),
        }
    }

    /// The views that take part, in order: held-out ones have a sky (evaluation leaves it out of the score) but no
    /// embedding and no masks.
    pub fn views(&self, with_test: bool) -> Vec<usize> {
        let views = &self.scene.views;
        (0..views.len())
            .filter(|&i| (with_test || !views[i].test) && self.keys.unreadable(i).is_none())
            .collect()
    }

    /// Checks that every photo still has the content that this run's keys name. It is called before something is kept,
    /// since the photos may have changed in the meantime.
    ///
    /// # Errors
    /// Names the photo that has changed.
    pub fn intact(&self) -> Result<(), RunError> {
        Ok(self.views(true).into_iter().try_for_each(|view| self.scene.views[view].intact())?)
    }

    /// Leaves out the photos that cannot be read: there is no sky to wait for.
    pub fn leave_out_unreadable(&mut self) {
        for view in 0..self.scene.views.len() {
            if let Some(reason) = self.keys.unreadable(view) {
                let skipped =
                    Skipped { name: self.scene.views[view].name.clone(), reason: reason.to_string() };
                self.options
                    .events
                    .warn(Some("ingest"), format!("photo {} is left out: {reason}", skipped.name));
                self.tally.skipped.push(skipped);
                self.skies.set(view, false);
            }
        }
    }

    /// Whether an earlier run left something of the training that this one may continue, or had to do without a sky.
    /// Then the skies come first, since the key of the training depends on them. A training from step 0 does not wait
    /// for all skies: it waits for the sky of each photo when it comes to it.
    pub fn something_kept(&self) -> Result<bool, RunError> {
        let kept =
            self.cache.contains(&self.full_keys.geometry) || self.cache.contains(&self.full_keys.snapshot);
        let whole = Keeper { key: &self.full_keys.training, ..self.keeper() };
        if kept || !whole.rows()?.is_empty() {
            return Ok(true);
        }
        let given_up = |row: ViewRow| {
            row.outcome.state == State::Failed
                && self.full_keys.sky.iter().any(|key| key.to_string() == row.key)
        };
        Ok(self.ledger.views(Stage::Sky.name())?.into_iter().any(given_up))
    }

    /// Whether it is known of each photo if it has masks.
    pub fn all_masks_known(&self) -> bool {
        self.views(false).into_iter().all(|view| self.masks_known.get(view).is_some())
    }

    /// Starts a stage in the ledger under its key, with a progress bar over `total` photos or steps.
    pub fn open(&mut self, stage: Stage, key: &Key, total: usize) -> Result<(), RunError> {
        let bar = self.options.events.stage(stage.name(), Some(total as u64));
        self.bars.insert(stage, bar);
        Ok(self.ledger.start_stage(stage.name(), key)?)
    }

    /// Ends a stage that goes photo by photo, after its last one.
    pub fn close(&mut self, stage: Stage, key: &Key) -> Result<(), RunError> {
        let Some(bar) = self.bars.remove(&stage) else { return Ok(()) };
        bar.finish();
        self.weigh_failures(stage, self.views(stage == Stage::Sky).len());
        Ok(self.ledger.finish_stage(stage.name(), key, None)?)
    }

    /// Fails a stage that failed on all of its photos, and warns when it failed on more than half of them.
    pub fn weigh_failures(&mut self, stage: Stage, photos: usize) {
        if let Some(warning) = self.tally.weigh(stage, photos) {
            self.options.events.warn(Some(stage.listed().name()), warning);
        }
    }

    /// Records a stage whose result is in the cache. The ledger then names this result as the one that the run uses:
    /// results that it does not name may be removed from the cache.
    pub fn skip_stage(&self, stage: Stage, key: &Key) -> Result<(), RunError> {
        let name = stage.name();
        self.options.events.tell(Event::StageSkipped { stage: name.into(), key: key.to_string() });
        if !self.ledger.stage_is_done(name, key)? {
            self.ledger.start_stage(name, key)?;
            self.ledger.finish_stage(name, key, None)?;
        }
        Ok(())
    }

    /// Records the present training in the ledger. What belongs to another training may be removed from the cache.
    pub fn name_training(&mut self) -> Result<(), RunError> {
        self.training_named = true;
        let rows = [(SNAPSHOT, &self.keys.snapshot), (TRAINING, &self.keys.training)];
        Ok(rows
            .into_iter()
            .try_for_each(|(row, key)| self.ledger.record_view(SNAPSHOT, row, key, &ViewOutcome::cached()))?)
    }

    /// Changes the keys to those of a run without this view's sky. The trainer has not used the photo before, so that
    /// its work so far is right under either key.
    pub fn do_without_sky(&mut self, view: usize) -> Result<(), RunError> {
        self.made.without_sky.insert(view);
        let test = |view: &usize| self.scene.views[*view].test;
        let (held_out, training) = self.made.without_sky.iter().copied().partition(test);
        self.keys = self.full_keys.without_skies(&training, &held_out);
        *lock(&self.names) = self.keys.clone();
        if self.training_named {
            self.ledger.start_stage(Stage::Geometry.name(), &self.keys.geometry)?;
            self.name_training()?;
        }
        Ok(())
    }

    /// Records the work on one view: in the ledger, the progress bar and the counts. `seconds` is `None` where the result
    /// was in the cache.
    pub fn view_done(
        &mut self,
        stage: Stage,
        view: usize,
        key: &Key,
        error: Option<&Quarantined>,
        seconds: Option<f64>,
    ) -> Result<(), RunError> {
        let name = self.scene.views[view].name.clone();
        if let Some(error) = error {
            self.scene.views[view].intact()?;
            if self.cache.was_damaged(key) {
                // It was made once: without it the result would differ from that of the run before.
                let reason = format!(
                    "photo {name}: what was made of it was damaged in the cache and cannot be made again ({}); \
                     run again",
                    error.error
                );
                self.tally.fail(stage, ActorFailure::fatal(reason));
            }
            self.tally.give_up(stage, &name, error);
        }
        let outcome = match (error, seconds) {
            (Some(error), _) => ViewOutcome::failed(error.attempts, error.error.clone()),
            (None, Some(seconds)) => ViewOutcome::done(seconds),
            (None, None) => ViewOutcome::cached(),
        };
        self.ledger.record_view(stage.name(), &name, key, &outcome)?;
        let bar = self.bars.get_mut(&stage);
        match (error, seconds) {
            (Some(error), _) => {
                if let Some(bar) = bar {
                    bar.failed(1);
                }
                self.options.events.tell(Event::ViewFailed {
                    stage: stage.name().into(),
                    view: name.clone(),
                    error: error.error.clone(),
                    attempts: error.attempts,
                });
                self.tally.skip(Skipped { name, reason: format!("{stage}: {}", error.error) });
            }
            (None, Some(_)) => {
                if let Some(bar) = bar {
                    bar.advance(1);
                }
                self.tally.made += 1;
            }
            (None, None) => {
                if let Some(bar) = bar {
                    bar.cached(1);
                }
                self.tally.cached += 1;
            }
        }
        Ok(())
    }

    /// Writes the trained scene into the run folder, also for other programs.
    pub fn take_model(&mut self, model: Arc<Model>) -> Result<(), RunError> {
        let posed = model.posed(&self.given);
        cameras::write(self.folder, &posed)?;
        if !Arc::ptr_eq(&posed, &self.given) {
            self.photos = Arc::new(self.photos.posed(posed.clone()));
            self.scene = posed;
        }
        self.folder.write_record("model.bin", MODEL, &*model)?;
        let splats = light::shown(&self.scene, &model, "")?;
        light::export(&self.scene, &model).write(&self.folder.path().join("scene.ply"), &splats)?;
        self.made.model = Some(model);
        Ok(())
    }
}
