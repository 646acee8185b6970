//! Starts the stages: the edges of the graph, and the data that each of them carries.

use super::{Bars, Coordinator, HISTORY, Inboxes};
use crate::RunError;
use crate::artifacts::cache::{SNAPSHOT, TRAINING, TRANSIENTS};
use crate::artifacts::checkpoints::Keeper;
use crate::artifacts::folder::{FEATURES, MODEL};
use crate::artifacts::history::{self, Moment};
use crate::output::objects::{OBJECTS, TreeSource};
use crate::run::inputs::{Inputs, SnapshotRenders, VISIBILITY};
use crate::run::memory;
use crate::run::outcome::ActorOutcome;
use segwild_features::{FeatureField, FeatureTask};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorFailure, ActorOptions, Context, Event, Key, Phase, System, fault};
use segwild_masks::{MaskSource, MaskTask, Snapshot};
use segwild_scene::Mask;
use segwild_trainer::{FindCheckpoint, Model, Photos, Sifted, TrainOrder, TrainPhoto};
use segwild_vision::PromptSegmenter;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

impl Coordinator<'_> {
    /// Takes the trained scene and its snapshot from the cache, or orders the training.
    pub(super) fn start_geometry(&mut self, to: &Inboxes, bars: &mut Bars) -> Result<(), RunError> {
        self.name_training()?;
        // A whole record may still be another program's: one whose parts do not fit together counts as missing.
        let sound = |model: &Model| model.check().is_ok();
        let done = self.cache.get_typed::<Model>(&self.keys.geometry, MODEL)?.filter(sound);
        let snapshot = self.cache.get_typed::<Model>(&self.keys.snapshot, MODEL)?.filter(sound);
        let snapshot_kept = snapshot.is_some();
        self.state.snapshot = snapshot.map(Arc::new);
        let snapshot_step = self.settings.train.snapshot_step();
        if let Some(model) = done {
            match self.cache.get_typed::<Vec<Moment>>(&self.keys.history, HISTORY)? {
                Some(moments) => history::replace(self.folder, &moments)?,
                // The history in the folder is of this training.
                None if self.ledger.stage_is_done("geometry", &self.keys.geometry)? => {
                    self.cache.put_typed(&self.keys.history, HISTORY, &history::read(self.folder))?;
                }
                None => {}
            }
            self.take_model(Arc::new(model))?;
            if snapshot_kept {
                return self.skip_stage("geometry", &self.keys.geometry);
            }
            self.state.only_to_snapshot = true;
        }
        self.ledger.start_stage("geometry", &self.keys.geometry)?;
        // Without the snapshot the training is done again from a checkpoint before it, or from the start.
        let before = if snapshot_kept { u32::MAX } else { snapshot_step };
        let until = if self.state.only_to_snapshot { snapshot_step } else { self.steps };
        let checkpoint = match self.stands_at(before)? {
            Some(step) if !self.state.only_to_snapshot => {
                self.state.paused = Some(step);
                return Ok(());
            }
            _ => self.find_checkpoint(before.min(self.steps.saturating_add(1))),
        };
        bars.geometry = Some(self.options.events.stage("geometry", Some(until.into())));
        let (scene, size, skies) = (self.scene.clone(), self.settings.scene.size, self.skies.clone());
        let (stopper, tainted) = (self.options.stopper.clone(), self.tainted.clone());
        let transients = self.known.clone();
        for view in self.views(false).into_iter().filter(|_| transients.network.is_some()) {
            let (name, key) = (&self.scene.views[view].name, &self.keys.known_transients[view]);
            self.ledger.record_view(TRANSIENTS, name, key, &ViewOutcome::cached())?;
        }
        let photos = move |view: usize| -> Result<TrainPhoto, String> {
            let posed = &scene.views[view];
            let loaded = posed.load(size).map_err(|e| {
                tainted.fetch_or(posed.intact().is_err(), Ordering::AcqRel);
                e.to_string()
            })?;
            let known = skies.wait(view, || stopper.phase() == Phase::Stopping);
            let sky = skies.read(view);
            if known.is_none() || sky.is_err() {
                tainted.store(true, Ordering::Release);
            }
            let mut photo = TrainPhoto::new(loaded, sky.map_err(|e| e.to_string())?);
            transients.apply(view, &mut photo)?;
            Ok(photo)
        };
        let order = TrainOrder {
            scene: self.scene.clone(),
            photos: Arc::new(Sifted { photos, refused: self.keys.refused() }) as Arc<dyn Photos>,
            settings: self.settings.train.clone(),
            until,
            checkpoint,
            checkpoint_every: Duration::from_secs(self.settings.run.checkpoint_every.max(1).into()),
        };
        to.training.blocking_send(order).map_err(|_| RunError::Interrupted) // closed: everything stops
    }

    /// Returns a function that finds the last checkpoint before a step. The trainer calls it at its start and after a
    /// panic.
    fn find_checkpoint(&self, before: u32) -> Arc<FindCheckpoint> {
        let (folder, ledger, events) =
            (self.folder.clone(), self.ledger.clone(), self.options.events.clone());
        let (key, kept) = (self.keys.training, self.settings.run.keep_checkpoints as usize);
        let (elsewhere, origin) = (self.elsewhere.clone(), self.origin.clone());
        Arc::new(move || {
            let last = |key| {
                let keeper = Keeper { folder: &folder, ledger: &ledger, events: &events, key, kept };
                // A damaged checkpoint is passed over; only the ledger can fail.
                keeper.last_before(before).map_err(ActorFailure::storage)
            };
            if let Some(own) = last(&key)? {
                return Ok(Some(own));
            }
            if let Some(origin) = &origin {
                let (step, steps) = (origin.step, origin.end - origin.step);
                let Some(checkpoint) = last(&origin.training)?.filter(|c| c.step() == step) else {
                    let lost = format!(
                        "the training to go on from has lost its checkpoint of step {step}: --continue-share 0 trains from the start"
                    );
                    return Err(ActorFailure::fatal(lost));
                };
                let message = format!(
                    "transient masks were corrected: the training goes on from step {step} for {steps} more (--continue-share)"
                );
                events.info(Some("geometry"), message);
                return Ok(Some(checkpoint));
            }
            for (engine, key) in &elsewhere {
                if let Some(checkpoint) = last(key)? {
                    let step = checkpoint.step();
                    let message =
                        format!("the {engine} engine trained up to step {step}: this one takes over");
                    events.info(Some("geometry"), message);
                    return Ok(Some(checkpoint));
                }
            }
            Ok(None)
        })
    }

    /// Records a stage whose result is in the cache. The ledger then names this result as the one that the run uses:
    /// results that it does not name may be removed from the cache.
    pub(super) fn skip_stage(&self, stage: &str, key: &Key) -> Result<(), RunError> {
        self.options.events.tell(Event::StageSkipped { stage: stage.into(), key: key.to_string() });
        if !self.ledger.stage_is_done(stage, key)? {
            self.ledger.start_stage(stage, key)?;
            self.ledger.finish_stage(stage, key, None)?;
        }
        Ok(())
    }

    /// Records the present training in the ledger. What belongs to another training may be removed from the cache.
    pub(super) fn name_training(&self) -> Result<(), RunError> {
        let rows = [(SNAPSHOT, &self.keys.snapshot), (TRAINING, &self.keys.training)];
        Ok(rows
            .into_iter()
            .try_for_each(|(row, key)| self.ledger.record_view(SNAPSHOT, row, key, &ViewOutcome::cached()))?)
    }

    /// The step of the newest checkpoint, if the training is to stop before its end and has come that far.
    fn stands_at(&self, before: u32) -> Result<Option<u32>, RunError> {
        if self.steps >= self.settings.train.steps {
            return Ok(None);
        }
        let newest = self.keeper().last_before(before)?.map(|c| c.step());
        Ok(newest.filter(|&step| step >= self.steps))
    }

    /// Renders the snapshot from every camera, in order, into the masks actor's mailbox.
    pub(super) fn start_masks(
        &mut self,
        snapshot: Arc<Model>,
        system: &System,
        to: &Inboxes,
        bars: &mut Bars,
    ) -> Result<(), RunError> {
        let views = self.views(false);
        self.state.masks_started = true;
        self.state.masks_open = views.len();
        self.ledger.start_stage("masks", &self.keys.stage("masks"))?;
        bars.masks = Some(self.options.events.stage("masks", Some(views.len() as u64)));
        let (size, keys, skies) = (self.settings.scene.size, self.keys.masks.clone(), self.skies.clone());
        let (cache, mask_source, out) =
            (self.cache.clone(), self.settings.masks.mask_source, to.masks.clone());
        let (engine, scene) = (self.engine.clone(), self.scene.clone());
        let renders = Arc::new(SnapshotRenders { model: snapshot, engine, scene, size });
        system.source("intrinsic renders", ActorOptions::default(), move |context| {
            for &view in &views {
                context.check()?;
                // Rendered ahead of the actor. Where masks in the cache are damaged, the actor renders for itself.
                let render = if mask_source == MaskSource::Photo || cache.contains(&keys[view]) {
                    None
                } else {
                    Some(Arc::new(renders.render(view).map_err(ActorFailure::retry)?))
                };
                let (key, sky) = (keys[view], skies.read(view)?.map(Arc::new));
                out.blocking_send(MaskTask::Masks { view, key, render, snapshot: renders.clone(), sky })?;
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Compares every photo with the trained scene, while masks are still being made.
    pub(super) fn start_visibility(&mut self, system: &System, to: &Inboxes) -> Result<(), RunError> {
        let Some(model) = self.state.model.clone().filter(|_| self.wants("features")) else { return Ok(()) };
        let inputs = Arc::new(Inputs {
            recompute: self.recompute(),
            keys: self.keys.clone(),
            size: self.settings.scene.size,
            model,
            engine: self.engine.clone(),
            skies: self.skies.clone(),
            masks_known: self.masks_known.clone(),
            embedder: self.embedder.clone(),
            maker: self.maker.clone(),
            known: self.known.clone(),
            photos_at_once: memory::photos_at_once(self.settings, &self.scene),
        });
        self.state.inputs = Some(inputs.clone());
        let (views, out) = (self.views(false), to.own.clone());
        let geometry = self.keys.geometry.to_string();
        let tree = tree_source(&inputs, &geometry, &*self.segmenter).key();
        // The ledger names it, so that the cache keeps it.
        self.ledger.record_view(SNAPSHOT, OBJECTS, &tree, &ViewOutcome::cached())?;
        let (folder, segmenter, events) =
            (self.folder.clone(), self.segmenter.clone(), self.options.events.clone());
        system.source("visibility", ActorOptions::default(), move |context| {
            let mut failed = Vec::new();
            for &view in &views {
                match compute_visibility(&inputs, view, context) {
                    Err(failure) if failure.is_local() => failed.push((view, failure.to_string())),
                    seen => seen?,
                }
            }
            let seen: Vec<usize> =
                views.iter().copied().filter(|view| failed.iter().all(|(f, _)| f != view)).collect();
            out.blocking_send(ActorOutcome::Visibility(failed))?;
            // The field does not need the mask images and does not wait for them.
            for note in inputs.write_transient_masks(&folder, &seen, &*segmenter, context)? {
                events.warn(Some("geometry"), note);
            }
            context.check()?;
            let _step = context.span("scene tree");
            let source = tree_source(&inputs, &geometry, &*segmenter);
            let stopping = || {
                context.progress();
                context.check().is_err()
            };
            match source.tree(&inputs.recompute.cache, &stopping) {
                Ok(_) | Err(RunError::Interrupted) => {}
                // Clicks try again, and say so where they cannot do without it.
                Err(error) => events.warn(Some("geometry"), format!("no scene tree was grown: {error}")),
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Orders the feature field. It starts before all masks are there: photos are lifted without them, and the
    /// compactness loss waits for the masks of each photo that it comes to.
    pub(super) fn order_field(&mut self, to: &Inboxes) -> Result<(), RunError> {
        let s = &self.state;
        let ready = s.training_sky_open == 0 && s.embed_open == 0 && s.masks_started && s.visible;
        let Some(inputs) = s.inputs.clone().filter(|_| ready && !s.field_ordered) else { return Ok(()) };
        let key = self.field_key();
        if self.state.masks_open > 0 && self.cache.contains(&key) {
            return Ok(()); // most likely this field; the key is certain when the masks are known
        }
        self.state.field_ordered = true;
        let views = self.views(false);
        for &view in views.iter().filter(|view| !self.state.unseen.contains(view)) {
            let (name, key) = (&self.scene.views[view].name, &self.keys.visibility[view]);
            self.ledger.record_view("visibility", name, key, &ViewOutcome::cached())?;
        }
        if self.state.masks_open == 0
            && let Some(field) = self.cache.get_typed::<FeatureField>(&key, FEATURES)?
            && field.check().is_ok()
        {
            self.keys.features = key;
            self.skip_stage("features", &key)?;
            return self.take_field(field);
        }
        self.ledger.start_stage("features", &key)?;
        let given = |view: &usize| self.state.embedded[*view] && !self.state.unseen.contains(view);
        let task = FeatureTask::Field {
            splats: Arc::new(inputs.model.splats.clone()),
            options: inputs.model.options(),
            views: Arc::new(views.into_iter().filter(given).collect()),
            inputs,
        };
        to.features.blocking_send(task).map_err(|_| RunError::Interrupted) // closed: everything stops
    }

    /// The key of the field, as far as is known. A field without the embedding, the masks or the visibility of photos
    /// that were given up has another key than the field with them.
    fn field_key(&self) -> Key {
        let views = self.views(false);
        let no_embedding = views.iter().copied().filter(|&view| !self.state.embedded[view]).collect();
        let no_masks = views.iter().copied().filter(|&v| self.masks_known.get(v) == Some(false)).collect();
        self.keys.features_without(&no_embedding, &no_masks, &self.state.unseen)
    }

    /// Keeps the field once it is made and everything that its key depends on is known.
    pub(super) fn keep_field(&mut self) -> Result<(), RunError> {
        if self.state.masks_open > 0 {
            return Ok(());
        }
        let Some(field) = self.state.made_field.take() else { return Ok(()) };
        self.intact()?;
        let key = self.field_key();
        self.keys.features = key;
        self.cache.put_typed(&key, FEATURES, &*field)?;
        self.ledger.finish_stage("features", &key, None)?;
        self.take_field(*field)
    }
}

/// The scene tree of the trained scene.
fn tree_source<'a>(
    inputs: &'a Inputs,
    geometry: &'a str,
    segmenter: &'a dyn PromptSegmenter,
) -> TreeSource<'a> {
    TreeSource {
        scene: &inputs.recompute.scene,
        model: &inputs.model,
        geometry,
        size: inputs.size,
        segmenter,
    }
}

/// How often a photo is compared with the trained scene before it is left out.
pub(super) const ATTEMPTS: u32 = 3;

/// Computes the visibility of a photo into the cache, if it is not there.
fn compute_visibility(inputs: &Inputs, view: usize, context: &Context) -> Result<(), ActorFailure> {
    let (key, cache) = (&inputs.keys.visibility[view], &inputs.recompute.cache);
    let mut attempt = 1;
    loop {
        context.check()?;
        if cache.get_typed::<Mask>(key, VISIBILITY)?.is_some() {
            return Ok(());
        }
        let compare = || -> Result<(), ActorFailure> {
            let _step = context.span(&inputs.recompute.scene.views[view].name);
            let seen = inputs.compare(view)?;
            fault::point("visibility.photo")?;
            Ok(cache.put_typed(key, VISIBILITY, &seen)?)
        };
        match compare() {
            Err(failure) if failure.is_local() && attempt < ATTEMPTS => {
                context.sleep(Duration::from_millis(100 * u64::from(attempt)));
                attempt += 1;
            }
            done => {
                context.progress();
                return done;
            }
        }
    }
}
