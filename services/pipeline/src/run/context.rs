//! What the stages of a run share, by who may change it: what is fixed before the first stage, what passes from thread to
//! thread, what the stages have made, and what is recorded of it.

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

/// What was opened and decided before the first stage. No stage changes it.
pub struct RunSetup<'a> {
    pub folder: &'a RunFolder,
    pub settings: &'a Settings,
    pub options: &'a RunOptions,
    pub ledger: &'a Ledger,
    pub cache: Cache,
    /// The scene with its poses as given: what a training starts from.
    pub given: Arc<Scene>,
    pub engine: Arc<dyn Engine>,
    /// The keys of this training on other engines: their checkpoints serve where it has none of its own.
    pub elsewhere: Vec<(&'static str, Key)>,
    /// Where the training starts, if not at step 0.
    pub origin: Option<TrainingOrigin>,
    /// The last stage to run; the stages after it are not requested.
    pub last: Stage,
    /// The step of the training to stop after.
    pub steps: u32,
    /// What is known of transients before anything is trained.
    pub known: KnownTransients,
    /// The perceptual distance, where its weights are given.
    pub lpips: Option<Arc<Lpips>>,
    pub segmenter: Arc<dyn PromptSegmenter>,
    pub embedder: Arc<dyn Embedder>,
    pub maker: Arc<MaskMaker>,
}

/// What stages and the threads of actors leave for each other while they run.
pub struct RunSignals {
    pub skies: Arc<Skies>,
    /// Per view, whether its masks are in the cache; `false` when they were given up.
    pub masks_known: Arc<ViewSlots<bool>>,
    /// The trainer misses an input: a stop ended the wait for a photo's sky, or a photo file was removed. What it makes
    /// from then on is not kept.
    pub tainted: Arc<AtomicBool>,
}

impl RunSignals {
    /// Nothing is known yet.
    pub fn new(skies: Skies) -> RunSignals {
        RunSignals {
            skies: Arc::new(skies),
            masks_known: Arc::new(ViewSlots::new("masks")),
            tainted: Arc::default(),
        }
    }
}

/// What the stages of a run share. A stage writes its results to `made`; keys, counts and progress change through
/// methods alone.
pub struct RunContext<'a> {
    pub setup: &'a RunSetup<'a>,
    pub signals: RunSignals,
    /// What the stages have made so far.
    pub made: Products,
    /// How fast masks are made.
    pub mask_speed: MaskSpeed,
    /// The scene with the poses as given, and with those of the trained scene once it is there.
    scene: Arc<Scene>,
    /// Its photos, at the size of the training.
    photos: Arc<PhotoStore>,
    /// The keys of a run that finds every sky.
    full_keys: Keys,
    /// The keys of this run, as far as they are known.
    keys: Keys,
    /// The same, for the warning about a damaged artefact, which names the artefact.
    names: Arc<Mutex<Keys>>,
    /// The ledger names the training: when its key changes, it is named again.
    training_named: bool,
    /// Progress of the stages that go view by view or step by step.
    bars: BTreeMap<Stage, StageProgress>,
    tally: Tally,
}

impl<'a> RunContext<'a> {
    /// A run that has made nothing. `keys` are those of a run that finds every sky. From here on the cache warns of each
    /// damaged artefact.
    pub fn new(
        setup: &'a RunSetup<'a>,
        photos: Arc<PhotoStore>,
        keys: &Keys,
        signals: RunSignals,
    ) -> RunContext<'a> {
        let names = Arc::new(Mutex::new(keys.clone()));
        warn_of_damage(setup, names.clone());
        RunContext {
            setup,
            signals,
            made: Products::default(),
            mask_speed: MaskSpeed::default(),
            scene: setup.given.clone(),
            photos,
            full_keys: keys.clone(),
            keys: keys.clone(),
            names,
            training_named: false,
            bars: BTreeMap::new(),
            tally: Tally::default(),
        }
    }
}

impl RunContext<'_> {
    /// The keys of this run, as far as they are known.
    pub fn keys(&self) -> &Keys {
        &self.keys
    }

    /// The scene with the poses as given, and with those of the trained scene once it is there.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// The photos of [`RunContext::scene`], at the size of the training.
    pub fn photos(&self) -> &Arc<PhotoStore> {
        &self.photos
    }

    /// Whether a stage was requested.
    pub fn wants(&self, stage: Stage) -> bool {
        stage <= self.setup.last
    }

    /// Whether the run is to stop.
    pub fn is_stopping(&self) -> bool {
        self.setup.options.stopper.phase() != Phase::Running
    }

    /// The checkpoints of this training.
    pub fn keeper(&self) -> Keeper<'_> {
        Keeper {
            folder: self.setup.folder,
            ledger: self.setup.ledger,
            events: &self.setup.options.events,
            key: &self.keys.training,
            kept: self.setup.settings.run.keep_checkpoints as usize,
        }
    }

    /// Reads artefacts of photos, and recomputes those that are damaged.
    pub fn recompute(&self) -> Recompute {
        Recompute {
            scene: self.scene.clone(),
            cache: self.setup.cache.clone(),
            events: self.setup.options.events.clone(),
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

    /// The views that masks and descriptors are made of, in order.
    pub fn described_views(&self) -> Vec<usize> {
        self.views(false).into_iter().filter(|view| self.keys.is_described(*view)).collect()
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
        let events = &self.setup.options.events;
        for view in 0..self.scene.views.len() {
            if let Some(reason) = self.keys.unreadable(view) {
                let skipped =
                    Skipped { name: self.scene.views[view].name.clone(), reason: reason.to_string() };
                events.warn(Some("ingest"), format!("photo {} is left out: {reason}", skipped.name));
                self.tally.skipped.push(skipped);
                self.signals.skies.set(view, false);
            }
        }
    }

    /// Whether an earlier run left something of the training that this one may continue, or had to do without a sky.
    /// Then the skies come first, since the key of the training depends on them. A training from step 0 does not wait
    /// for all skies: it waits for the sky of each photo when it comes to it.
    pub fn something_kept(&self) -> Result<bool, RunError> {
        let kept = self.setup.cache.contains(&self.full_keys.geometry)
            || self.setup.cache.contains(&self.full_keys.snapshot);
        let whole = Keeper { key: &self.full_keys.training, ..self.keeper() };
        if kept || !whole.rows()?.is_empty() {
            return Ok(true);
        }
        let given_up = |row: ViewRow| {
            row.outcome.state == State::Failed
                && self.full_keys.sky.iter().any(|key| key.to_string() == row.key)
        };
        Ok(self.setup.ledger.views(Stage::Sky.name())?.into_iter().any(given_up))
    }

    /// Sets the key of the field, which depends on the photos that were given up.
    pub fn name_features(&mut self, key: Key) {
        self.keys.features = key;
    }

    /// Whether it is known of each photo if it has masks.
    pub fn all_masks_known(&self) -> bool {
        self.described_views().into_iter().all(|view| self.signals.masks_known.get(view).is_some())
    }

    /// Starts a stage in the ledger under its key, with a progress bar over `total` photos.
    pub fn open(&mut self, stage: Stage, key: &Key, total: usize) -> Result<(), RunError> {
        self.start_bar(stage, total as u64);
        Ok(self.setup.ledger.start_stage(stage.name(), key)?)
    }

    /// As [`RunContext::open`] of a stage that goes over the described `views`. Those that an earlier run described and this one
    /// does not are forgotten: what the run folder says of the stage is then what this run makes of it.
    pub fn open_described(&mut self, stage: Stage, key: &Key, views: &[usize]) -> Result<(), RunError> {
        self.open(stage, key, views.len())?;
        let names = views.iter().map(|&view| self.scene.views[view].name.as_str()).collect();
        Ok(self.setup.ledger.forget_other_views(stage.name(), &names)?)
    }

    /// Shows progress of a stage over `total` photos or steps.
    pub fn start_bar(&mut self, stage: Stage, total: u64) {
        let bar = self.setup.options.events.stage(stage.name(), Some(total));
        self.bars.insert(stage, bar);
    }

    /// The progress of a stage, while it is shown.
    pub fn bar(&mut self, stage: Stage) -> Option<&mut StageProgress> {
        self.bars.get_mut(&stage)
    }

    /// Whether the progress of a stage is shown.
    pub fn has_bar(&self, stage: Stage) -> bool {
        self.bars.contains_key(&stage)
    }

    /// Ends the progress of a stage as complete.
    pub fn finish_bar(&mut self, stage: Stage) {
        if let Some(bar) = self.bars.remove(&stage) {
            bar.finish();
        }
    }

    /// Ends all progress as it stands.
    pub fn drop_bars(&mut self) {
        self.bars.clear();
    }

    /// Fails a stage, and the run with it, unless one has failed before.
    pub fn fail(&mut self, stage: Stage, reason: String) {
        self.tally.fail(stage, ActorFailure::fatal(reason));
    }

    /// The stage that failed and why, once.
    pub fn take_failure(&mut self) -> Option<(Stage, ActorFailure)> {
        self.tally.failed.take()
    }

    /// Counts a photo as left out, unless it is known. Returns whether it was counted.
    pub fn leave_out(&mut self, skipped: Skipped) -> bool {
        self.tally.skip(skipped)
    }

    /// The photos that were left out, once.
    pub fn take_skipped(&mut self) -> Vec<Skipped> {
        std::mem::take(&mut self.tally.skipped)
    }

    /// Per-photo artefacts that were made, and that were in the cache.
    pub fn counts(&self) -> [usize; 2] {
        [self.tally.made, self.tally.cached]
    }

    /// Ends a stage that goes photo by photo, after its last one.
    pub fn close(&mut self, stage: Stage, key: &Key) -> Result<(), RunError> {
        let Some(bar) = self.bars.remove(&stage) else { return Ok(()) };
        bar.finish();
        let photos = match stage {
            Stage::Masks | Stage::Embed => self.described_views(),
            _ => self.views(stage == Stage::Sky),
        };
        self.weigh_failures(stage, photos.len());
        Ok(self.setup.ledger.finish_stage(stage.name(), key, None)?)
    }

    /// Fails a stage that failed on all of its photos, and warns when it failed on more than half of them.
    pub fn weigh_failures(&mut self, stage: Stage, photos: usize) {
        if let Some(warning) = self.tally.weigh(stage, photos) {
            self.setup.options.events.warn(Some(stage.listed().name()), warning);
        }
    }

    /// Records a stage whose result is in the cache. The ledger then names this result as the one that the run uses:
    /// results that it does not name may be removed from the cache.
    pub fn skip_stage(&self, stage: Stage, key: &Key) -> Result<(), RunError> {
        let name = stage.name();
        self.setup.options.events.tell(Event::StageSkipped { stage: name.into(), key: key.to_string() });
        if !self.setup.ledger.stage_is_done(name, key)? {
            self.setup.ledger.start_stage(name, key)?;
            self.setup.ledger.finish_stage(name, key, None)?;
        }
        Ok(())
    }

    /// Records the present training in the ledger. What belongs to another training may be removed from the cache.
    pub fn name_training(&mut self) -> Result<(), RunError> {
        self.training_named = true;
        let rows = [(SNAPSHOT, &self.keys.snapshot), (TRAINING, &self.keys.training)];
        Ok(rows.into_iter().try_for_each(|(row, key)| {
            self.setup.ledger.record_view(SNAPSHOT, row, key, &ViewOutcome::cached())
        })?)
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
            self.setup.ledger.start_stage(Stage::Geometry.name(), &self.keys.geometry)?;
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
            if self.setup.cache.was_damaged(key) {
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
        self.setup.ledger.record_view(stage.name(), &name, key, &outcome)?;
        let bar = self.bars.get_mut(&stage);
        match (error, seconds) {
            (Some(error), _) => {
                if let Some(bar) = bar {
                    bar.failed(1);
                }
                self.setup.options.events.tell(Event::ViewFailed {
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
        let posed = model.posed(&self.setup.given);
        cameras::write(self.setup.folder, &posed)?;
        if !Arc::ptr_eq(&posed, &self.setup.given) {
            self.photos = Arc::new(self.photos.posed(posed.clone()));
            self.scene = posed;
        }
        self.setup.folder.write_record("model.bin", MODEL, &*model)?;
        let splats = light::shown(&self.scene, &model, "")?;
        light::export(&self.scene, &model).write(&self.setup.folder.path().join("scene.ply"), &splats)?;
        self.made.model = Some(model);
        Ok(())
    }
}

/// Makes the cache warn of each damaged artefact, with its kind and photo.
fn warn_of_damage(setup: &RunSetup<'_>, names: Arc<Mutex<Keys>>) {
    let (scene, events) = (setup.given.clone(), setup.options.events.clone());
    setup.cache.on_damage(move |key, reason| {
        let kind = key.split(':').next().unwrap_or(key);
        let stage = match kind {
            "embedding" => Stage::Embed.name(),
            "visibility" => Stage::Features.name(),
            "history" | "snapshot" => Stage::Geometry.name(),
            other => other,
        };
        let photo = lock(&names)
            .view_of(key)
            .map_or(String::new(), |view| format!(" of photo {}", scene.views[view].name));
        let message = format!("the cache's {kind} record{photo} was damaged ({reason}): it is made again");
        events.warn(Some(stage), message);
    });
}
