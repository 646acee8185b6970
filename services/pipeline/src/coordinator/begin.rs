//! What the coordinator begins: the arrows of the graph, and what each of them takes along.

use super::{Bars, Coordinator, HISTORY, Inboxes};
use crate::RunError;
use crate::folder::{FEATURES, MODEL};
use crate::history::{self, Moment};
use crate::keep::{SNAPSHOT, TRAINING};
use crate::outcome::Outcome;
use crate::visibility::visibility;
use segwild_features::{FeatureField, FeatureTask, FieldView, VISIBILITY};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorOptions, Event, Failure, Key, Phase, System, fault};
use segwild_masks::{MaskSource, MaskTask};
use segwild_scene::Mask;
use segwild_trainer::{Model, Photos, TrainOrder, TrainPhoto, render_view};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

impl Coordinator<'_> {
    /// Takes the trained scene and its snapshot from the cache, or orders the training.
    pub(super) fn begin_geometry(&mut self, to: &Inboxes, bars: &mut Bars) -> Result<(), RunError> {
        self.name_training()?;
        let done: Option<Model> = self.cache.get_typed(&self.keys.geometry, MODEL)?;
        let snapshot: Option<Model> = self.cache.get_typed(&self.keys.snapshot, MODEL)?;
        let snapshot_kept = snapshot.is_some();
        self.state.snapshot = snapshot.map(Arc::new);
        let snapshot_step = self.settings.train.snapshot_step();
        if let Some(model) = done {
            if let Some(moments) = self.cache.get_typed::<Vec<Moment>>(&self.keys.history, HISTORY)? {
                history::replace(self.folder, &moments)?;
            }
            self.take_model(Arc::new(model))?;
            if snapshot_kept {
                return self.skip_stage("geometry", &self.keys.geometry);
            }
            self.state.only_to_snapshot = true;
        }
        self.ledger.begin_stage("geometry", &self.keys.geometry)?;
        // Without the snapshot the training is done again from a checkpoint before it, or from the start.
        let before = if snapshot_kept { u32::MAX } else { snapshot_step };
        let until = if self.state.only_to_snapshot { snapshot_step } else { self.steps };
        let checkpoint = match self.stands_at(before)? {
            Some(step) if !self.state.only_to_snapshot => {
                self.state.paused = Some(step);
                return Ok(());
            }
            _ => self.keeper().last_before(before.min(self.steps.saturating_add(1)))?,
        };
        let mut bar = self.options.events.stage("geometry", Some(until.into()));
        let start = checkpoint.as_ref().map_or(0, |c| c.step());
        if start > 0 {
            self.options.events.info(Some("geometry"), format!("goes on from step {start}"));
            bar.cached(start.into());
        }
        if !self.state.only_to_snapshot {
            history::trim(self.folder, start)?;
        }
        bars.geometry = Some(bar);
        let (scene, size, skies) = (self.scene.clone(), self.settings.scene.size, self.skies.clone());
        let (stopper, tainted) = (self.options.stopper.clone(), self.tainted.clone());
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
            Ok(TrainPhoto { image: loaded.image, valid: loaded.valid, sky: sky.map_err(|e| e.to_string())? })
        };
        let order = TrainOrder {
            scene: self.scene.clone(),
            photos: Arc::new(photos) as Arc<dyn Photos>,
            settings: self.settings.train.clone(),
            until,
            checkpoint: checkpoint.map(Arc::new),
            checkpoint_every: Duration::from_secs(self.settings.run.checkpoint_every.max(1).into()),
        };
        to.training.blocking_send(order).map_err(|_| RunError::Interrupted) // closed: everything stops
    }

    /// A stage whose result was there. The ledger then says that the run uses it as it stands, and no other that may
    /// have been made since: what it does not say may leave the cache.
    pub(super) fn skip_stage(&self, stage: &str, key: &Key) -> Result<(), RunError> {
        self.options.events.tell(Event::StageSkipped { stage: stage.into(), key: key.to_string() });
        if !self.ledger.stage_is_done(stage, key)? {
            self.ledger.begin_stage(stage, key)?;
            self.ledger.finish_stage(stage, key, None)?;
        }
        Ok(())
    }

    /// Writes down which training is the present one: what belongs to another may leave the cache.
    pub(super) fn name_training(&self) -> Result<(), RunError> {
        let rows = [(SNAPSHOT, &self.keys.snapshot), (TRAINING, &self.keys.training)];
        Ok(rows
            .into_iter()
            .try_for_each(|(row, key)| self.ledger.record_view(SNAPSHOT, row, key, &ViewOutcome::cached()))?)
    }

    /// The step the training stands at, when that is as far as was asked for and not its end.
    fn stands_at(&self, before: u32) -> Result<Option<u32>, RunError> {
        if self.steps >= self.settings.train.steps {
            return Ok(None);
        }
        let newest = self.keeper().last_before(before)?.map(|c| c.step());
        Ok(newest.filter(|&step| step >= self.steps))
    }

    /// Renders the snapshot from every camera, in order, into the masks actor's mailbox.
    pub(super) fn begin_masks(
        &mut self,
        snapshot: &Model,
        system: &System,
        to: &Inboxes,
        bars: &mut Bars,
    ) -> Result<(), RunError> {
        let views = self.views(false);
        self.state.masks_begun = true;
        self.state.masks_open = views.len();
        self.ledger.begin_stage("masks", &self.keys.stage("masks"))?;
        bars.masks = Some(self.options.events.stage("masks", Some(views.len() as u64)));
        let (scene, engine, cache) = (self.scene.clone(), self.engine.clone(), self.cache.clone());
        let (size, keys, skies) = (self.settings.scene.size, self.keys.masks.clone(), self.skies.clone());
        let drawn_on = self.settings.masks.mask_source;
        let (snapshot, out) = (snapshot.clone(), to.masks.clone());
        let means = Arc::new(snapshot.splats.means.clone());
        system.source("intrinsic renders", ActorOptions::default(), move |context| {
            for &view in &views {
                context.check()?;
                let posed = &scene.views[view];
                let render = if drawn_on == MaskSource::Photo || cache.contains(&keys[view]) {
                    None
                } else {
                    let camera = posed.camera.scaled_to(size);
                    Some(Arc::new(render_view(&snapshot, &*engine, &camera, &posed.pose, None)?))
                };
                let sky = skies.read(view).map_err(Failure::fatal)?.map(Arc::new);
                let task = MaskTask::Masks { view, key: keys[view], render, means: means.clone(), sky };
                out.blocking_send(task)?;
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Compares every photo with the trained scene, while masks are still being made.
    pub(super) fn begin_visibility(&self, system: &System, to: &Inboxes) -> Result<(), RunError> {
        let Some(model) = self.state.model.clone().filter(|_| self.wants("features")) else { return Ok(()) };
        let (scene, engine, cache) = (self.scene.clone(), self.engine.clone(), self.cache.clone());
        let (views, size, skies) = (self.views(false), self.settings.scene.size, self.skies.clone());
        let (keys, out) = (self.keys.visibility.clone(), to.own.clone());
        system.source("visibility", ActorOptions::default(), move |context| {
            let look = || -> Result<(), Failure> {
                for &view in &views {
                    context.check()?;
                    if cache.get_typed::<Mask>(&keys[view], VISIBILITY)?.is_some() {
                        continue;
                    }
                    let sky = skies.read(view)?;
                    let _step = context.span(&scene.views[view].name);
                    let seen = visibility(&model, &*engine, &scene.views[view], view, sky.as_ref(), size)?;
                    cache.put_typed(&keys[view], VISIBILITY, &seen)?;
                    context.progress();
                    fault::point("visibility.photo")?;
                }
                Ok(())
            };
            let looked = look();
            context.check()?;
            out.blocking_send(Outcome::Visibility(looked.map_err(|failure| failure.to_string())))?;
            Ok(())
        })?;
        Ok(())
    }

    /// Orders the feature field. It begins before the masks are all there: photos are lifted without them, and it waits
    /// for those of a photo when it comes to its compactness.
    pub(super) fn ask_for_field(&mut self, to: &Inboxes) -> Result<(), RunError> {
        let s = &self.state;
        let ready = s.training_sky_open == 0 && s.embed_open == 0 && s.masks_begun && s.visible;
        let Some(model) = s.model.clone().filter(|_| ready && !s.field_asked && self.wants("features"))
        else {
            return Ok(());
        };
        let key = self.field_key();
        if self.state.masks_open > 0 && self.cache.contains(&key) {
            return Ok(()); // most likely it is this one: seen when the masks are known
        }
        self.state.field_asked = true;
        let views = self.views(false);
        for &view in &views {
            let (name, key) = (&self.scene.views[view].name, &self.keys.visibility[view]);
            self.ledger.record_view("visibility", name, key, &ViewOutcome::cached())?;
        }
        if self.state.masks_open == 0
            && let Some(field) = self.cache.get_typed::<FeatureField>(&key, FEATURES)?
        {
            self.keys.features = key;
            self.skip_stage("features", &key)?;
            return self.take_field(field);
        }
        self.ledger.begin_stage("features", &key)?;
        let given = views.into_iter().filter(|&view| self.state.embedded[view]).map(|view| FieldView {
            view,
            embedding: self.keys.embedding[view],
            masks: self.keys.masks[view],
            sky: self.skies.found(view).then_some(self.keys.sky[view]),
            visibility: self.keys.visibility[view],
        });
        let task = FeatureTask::Field {
            splats: Arc::new(model.splats.clone()),
            options: model.options(),
            views: Arc::new(given.collect()),
            masks: self.masks_known.clone(),
        };
        to.features.blocking_send(task).map_err(|_| RunError::Interrupted) // closed: everything stops
    }

    /// The name of the field, as far as is known: one without the embedding or the masks of photos that were given up on
    /// the way is another than the one with them.
    fn field_key(&self) -> Key {
        let views = self.views(false);
        let no_embedding = views.iter().copied().filter(|&view| !self.state.embedded[view]).collect();
        let no_masks = views.iter().copied().filter(|&v| self.masks_known.get(v) == Some(false)).collect();
        self.keys.features_without(&no_embedding, &no_masks)
    }

    /// Keeps the field once it is made and all that its name depends on is known.
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
