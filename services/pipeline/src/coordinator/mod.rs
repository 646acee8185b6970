//! Feeds the actors of one scene and listens to them.
//!
//! `ingest -> { sky(view)*, embed(view)*, geometry }`; geometry publishes a snapshot at a fixed step
//! `-> intrinsic render(view)* -> masks(view)*` while it trains on; at its end `-> feature field`.
//! Snapshots are taken at fixed steps and views go in fixed order, so the result does not depend on who was faster.

mod hear;

use crate::artefacts::Keys;
use crate::board::Board;
use crate::checkpoints::Keeper;
use crate::folder::{FEATURES, MODEL};
use crate::graph::{RunOptions, STAGES};
use crate::outcome::Outcome;
use crate::visibility::visibility;
use crate::{RunError, RunFolder, Settings, history};
use segwild_features::{FeatureActor, FeatureField, FeatureTask, FieldView, VISIBILITY};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{
    ActorOptions, Cache, Event, Exit, Failure, Key, Ledger, Limits, Phase, Receiver, Recorder, Report,
    Sender, StageProgress, System, SystemOptions, mailbox,
};
use segwild_masks::{MaskActor, MaskSource, MaskTask, sasm};
use segwild_raster::Engine;
use segwild_scene::{Mask, Scene, Skipped};
use segwild_trainer::{Model, Photos, TrainActor, TrainOrder, TrainOutcome, TrainPhoto, render_view};
use segwild_vision::Providers;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// What is known so far.
#[derive(Default)]
pub struct State {
    pub model: Option<Arc<Model>>,
    pub field: Option<Arc<FeatureField>>,
    pub skipped: Vec<Skipped>,
    /// Views whose masks are in the cache.
    pub masked: Vec<bool>,
    pub embedded: Vec<bool>,
    pub sky_open: usize,
    pub embed_open: usize,
    pub masks_open: usize,
    pub masks_begun: bool,
    /// Which pixels can be trusted is known of every photo.
    pub visible: bool,
    pub field_asked: bool,
    /// The training stands at this step, as far as was asked for, and is not over.
    pub paused: Option<u32>,
    pub made: usize,
    pub cached: usize,
    pub failed: Option<(&'static str, String)>,
}

/// The one who conducts.
pub struct Coordinator<'a> {
    pub folder: &'a RunFolder,
    pub settings: &'a Settings,
    pub options: &'a RunOptions,
    pub ledger: &'a Ledger,
    pub recorder: &'a Recorder,
    pub scene: Arc<Scene>,
    pub engine: Arc<dyn Engine>,
    pub keys: Keys,
    pub cache: Cache,
    /// Index into [`STAGES`] of the last stage wanted.
    pub last: usize,
    /// The step of the training to stop after.
    pub steps: u32,
    /// Per view, whether its sky is in the cache; `false` when it has none.
    pub board: Arc<Board<bool>>,
    /// A stop ended the wait for a photo's sky: what the trainer makes from then on, without it, is not kept.
    pub tainted: Arc<AtomicBool>,
    pub state: State,
}

/// The mailboxes that the coordinator writes to.
pub(crate) struct Inboxes {
    masks: Sender<MaskTask>,
    features: Sender<FeatureTask>,
    training: Sender<TrainOrder>,
    /// For sources that have something to say to the coordinator itself.
    own: Sender<Outcome>,
}

/// Progress of the stages that go view by view or step by step.
pub(crate) struct Bars {
    sky: Option<StageProgress>,
    embed: Option<StageProgress>,
    masks: Option<StageProgress>,
    geometry: Option<StageProgress>,
}

impl Coordinator<'_> {
    fn keeper(&self) -> Keeper<'_> {
        Keeper {
            folder: self.folder,
            ledger: self.ledger,
            events: &self.options.events,
            key: &self.keys.training,
            kept: self.settings.run.keep_checkpoints as usize,
        }
    }

    fn wants(&self, stage: &str) -> bool {
        STAGES.iter().position(|s| *s == stage).is_some_and(|i| i <= self.last)
    }

    /// The views that take part, in order: held-out ones have a sky (evaluation leaves it out of the score) but no
    /// embedding and no masks.
    fn views(&self, with_test: bool) -> Vec<usize> {
        let views = &self.scene.views;
        (0..views.len())
            .filter(|&i| (with_test || !views[i].test) && self.keys.unreadable(i).is_none())
            .collect()
    }

    /// Spawns the actors, feeds them, listens to them. The report is of the actors; the result, of the work.
    pub fn flow(&mut self, providers: &Providers) -> Result<(Report, Result<(), RunError>), RunError> {
        let system = System::new(SystemOptions {
            events: self.options.events.clone(),
            stopper: self.options.stopper.clone(),
            ..SystemOptions::default()
        })?;
        let limits = Limits { count: 64, bytes: 64 << 20 };
        // Renders wait here: a few ahead keep the actor busy, more would only fill memory.
        let few = Limits { count: 4, bytes: 64 << 20 };
        let (out, inbox) = mailbox::<Outcome>("coordinator", limits);
        self.recorder.watch(system.observer());
        self.recorder.mailbox(&inbox);
        let (masks, masks_in) = mailbox::<MaskTask>("masks", few);
        let (features, features_in) = mailbox::<FeatureTask>("features", limits);
        let (training, training_in) = mailbox::<TrainOrder>("trainer", limits);

        let (scene, size, cache) = (self.scene.clone(), self.settings.scene.size, self.cache.clone());
        let (engine, settings, depths) =
            (self.engine.clone(), self.settings.clone(), sasm::SceneDepths::of(&scene));
        let own = out.clone();
        let train = TrainerParts { engine: engine.clone(), out: out.clone() };
        system.spawn(training_in, ActorOptions { attempts: 1, ..ActorOptions::default() }, move || {
            Ok(TrainActor { engine: train.engine.clone(), out: train.out.clone() })
        })?;
        let (s, c, o, p, m) =
            (scene.clone(), cache.clone(), out.clone(), providers.clone(), settings.masks.clone());
        system.spawn(masks_in, ActorOptions::default(), move || {
            Ok(MaskActor {
                scene: s.clone(),
                size,
                sky: p.sky.clone(),
                proposer: p.proposer.clone(),
                cache: c.clone(),
                settings: m.clone(),
                depths,
                out: o.clone(),
            })
        })?;
        let (embedder, f) = (providers.embedder.clone(), settings.features.clone());
        system.spawn(features_in, ActorOptions::default(), move || {
            Ok(FeatureActor {
                scene: scene.clone(),
                size,
                embedder: embedder.clone(),
                engine: engine.clone(),
                cache: cache.clone(),
                settings: f.clone(),
                out: out.clone(),
            })
        })?;

        let outcome = self.conduct(&system, Inboxes { masks, features, training, own }, &inbox);
        if outcome.is_err() {
            self.options.stopper.stop();
        }
        // An actor that is stopping may still have something to say; nothing may wait for a full mailbox.
        let drained = std::thread::scope(|scope| {
            let rest = scope.spawn(|| {
                let mut late = Vec::new();
                while let Some(outcome) = inbox.blocking_recv() {
                    if let Outcome::Train(TrainOutcome::Checkpoint(checkpoint)) = outcome {
                        late.push(checkpoint);
                    }
                }
                late
            });
            let report = system.join();
            inbox.close();
            (report, rest.join().unwrap_or_default())
        });
        for checkpoint in drained.1.iter().filter(|_| !self.tainted.load(Ordering::Acquire)) {
            self.keeper().save(checkpoint)?;
        }
        Ok((drained.0, outcome))
    }

    /// Feeds the actors and listens until everything wanted is there.
    fn conduct(&mut self, system: &System, to: Inboxes, inbox: &Receiver<Outcome>) -> Result<(), RunError> {
        let n = self.scene.views.len();
        self.state.masked = vec![false; n];
        self.state.embedded = vec![false; n];
        for i in 0..n {
            if let Some(reason) = self.keys.unreadable(i) {
                let skipped = Skipped { name: self.scene.views[i].name.clone(), reason: reason.to_owned() };
                self.options
                    .events
                    .warn(Some("ingest"), format!("photo {} is left out: {reason}", skipped.name));
                self.state.skipped.push(skipped);
                self.board.set(i, false);
            }
        }
        let mut bars = Bars { sky: None, embed: None, masks: None, geometry: None };
        let events = self.options.events.clone();

        let with_sky = self.views(true);
        self.state.sky_open = with_sky.len();
        bars.sky = Some(events.stage("sky", Some(with_sky.len() as u64)));
        let stage_key = self.keys.stage("sky");
        self.ledger.begin_stage("sky", &stage_key)?;
        let (masks, keys) = (to.masks.clone(), self.keys.sky.clone());
        system.source("ingest", ActorOptions::default(), move |context| {
            for &view in &with_sky {
                context.check()?;
                masks.blocking_send_urgent(MaskTask::Sky { view, key: keys[view] })?;
            }
            Ok(())
        })?;

        if self.wants("embed") {
            let views = self.views(false);
            self.state.embed_open = views.len();
            bars.embed = Some(events.stage("embed", Some(views.len() as u64)));
            self.ledger.begin_stage("embed", &self.keys.stage("embed"))?;
            let (features, keys) = (to.features.clone(), self.keys.embedding.clone());
            system.source("photos", ActorOptions::default(), move |context| {
                for &view in &views {
                    context.check()?;
                    features.blocking_send(FeatureTask::Embed { view, key: keys[view] })?;
                }
                Ok(())
            })?;
        }
        if self.wants("masks") {
            self.begin_geometry(system, &to, &mut bars)?;
        }
        while !self.complete() {
            if self.options.stopper.phase() != Phase::Running {
                return Ok(());
            }
            match inbox.recv_timeout(Duration::from_millis(200)) {
                Ok(_) if self.tainted.load(Ordering::Acquire) => return Ok(()),
                Ok(outcome) => self.hear(outcome, system, &to, &mut bars)?,
                Err(_)
                    if self.options.stopper.phase() == Phase::Running
                        && system.snapshot().iter().all(|actor| actor.exit != Exit::Running) =>
                {
                    return Err(RunError::Stage {
                        stage: "flow",
                        reason: "every actor has ended early".into(),
                    });
                }
                Err(_) => {}
            }
            if let Some((stage, reason)) = self.state.failed.take() {
                self.ledger.fail_stage(stage, &self.keys.stage(stage), &reason)?;
                events.tell(Event::StageFailed { stage: stage.into(), error: reason.clone() });
                return Err(RunError::Stage { stage, reason });
            }
            self.ask_for_field(&to)?;
        }
        Ok(())
    }

    fn complete(&self) -> bool {
        let s = &self.state;
        s.sky_open == 0
            && s.embed_open == 0
            && (!self.wants("masks")
                || s.masks_begun && s.masks_open == 0
                || s.paused.is_some() && !s.masks_begun)
            && (!self.wants("geometry") || s.model.is_some() || s.paused.is_some())
            && (!self.wants("features") || s.field.is_some())
    }

    /// Takes the trained scene and its snapshot from the cache, or orders the training.
    fn begin_geometry(&mut self, system: &System, to: &Inboxes, bars: &mut Bars) -> Result<(), RunError> {
        let done: Option<Model> = self.cache.get_typed(&self.keys.geometry, MODEL)?;
        let snapshot: Option<Model> = self.cache.get_typed(&self.keys.snapshot, MODEL)?;
        if let Some(snapshot) = &snapshot {
            self.begin_masks(snapshot, system, to, bars)?;
        }
        if let (Some(model), true) = (done, snapshot.is_some()) {
            let key = self.keys.geometry.to_string();
            self.options.events.tell(Event::StageSkipped { stage: "geometry".into(), key });
            self.take_model(Arc::new(model))?;
            return self.begin_visibility(system, to);
        }
        self.ledger.begin_stage("geometry", &self.keys.geometry)?;
        // Without the snapshot the training is done again from a checkpoint before it, or from the start.
        let snapshot_step = self.settings.train.snapshot_step();
        let before = if snapshot.is_some() { u32::MAX } else { snapshot_step };
        let checkpoint = match self.stands_at(before)? {
            Some(step) => {
                self.state.paused = Some(step);
                return Ok(());
            }
            None => self.keeper().last_before(before.min(self.steps.saturating_add(1)))?,
        };
        let mut bar = self.options.events.stage("geometry", Some(self.steps.into()));
        let start = checkpoint.as_ref().map_or(0, |c| c.step());
        if start > 0 {
            self.options.events.info(Some("geometry"), format!("goes on from step {start}"));
            bar.cached(start.into());
        }
        history::trim(self.folder, start)?;
        bars.geometry = Some(bar);
        let (scene, size, board) = (self.scene.clone(), self.settings.scene.size, self.board.clone());
        let (stopper, cache, keys) =
            (self.options.stopper.clone(), self.cache.clone(), self.keys.sky.clone());
        let tainted = self.tainted.clone();
        let photos = move |view: usize| -> Result<TrainPhoto, String> {
            let loaded = scene.views[view].load(size).map_err(|e| e.to_string())?;
            let found = board.wait(view, || stopper.phase() == Phase::Stopping);
            if found.is_none() {
                tainted.store(true, Ordering::Release);
            }
            let sky = if found == Some(true) { read_sky(&cache, &keys[view]) } else { None };
            Ok(TrainPhoto { image: loaded.image, valid: loaded.valid, sky })
        };
        let order = TrainOrder {
            scene: self.scene.clone(),
            photos: Arc::new(photos) as Arc<dyn Photos>,
            settings: self.settings.train.clone(),
            until: self.steps,
            checkpoint: checkpoint.map(Arc::new),
            checkpoint_every: Duration::from_secs(self.settings.run.checkpoint_every.max(1).into()),
        };
        to.training.blocking_send(order).map_err(|_| RunError::Interrupted) // closed: everything stops
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
    fn begin_masks(
        &mut self,
        snapshot: &Model,
        system: &System,
        to: &Inboxes,
        bars: &mut Bars,
    ) -> Result<(), RunError> {
        if self.state.masks_begun {
            return Ok(());
        }
        let views = self.views(false);
        self.state.masks_begun = true;
        self.state.masks_open = views.len();
        self.ledger.begin_stage("masks", &self.keys.stage("masks"))?;
        bars.masks = Some(self.options.events.stage("masks", Some(views.len() as u64)));
        let (scene, engine, cache) = (self.scene.clone(), self.engine.clone(), self.cache.clone());
        let (size, keys, board) = (self.settings.scene.size, self.keys.masks.clone(), self.board.clone());
        let sky_keys = self.keys.sky.clone();
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
                let found = board.wait(view, || context.stopping()).ok_or_else(Failure::stopped)?;
                let sky = if found { read_sky(&cache, &sky_keys[view]).map(Arc::new) } else { None };
                let task = MaskTask::Masks { view, key: keys[view], render, means: means.clone(), sky };
                out.blocking_send(task)?;
            }
            Ok(())
        })?;
        Ok(())
    }

    /// Compares every photo with the trained scene, while masks are still being made.
    pub(crate) fn begin_visibility(&self, system: &System, to: &Inboxes) -> Result<(), RunError> {
        let Some(model) = self.state.model.clone().filter(|_| self.wants("features")) else { return Ok(()) };
        let (scene, engine, cache) = (self.scene.clone(), self.engine.clone(), self.cache.clone());
        let (views, size, board) = (self.views(false), self.settings.scene.size, self.board.clone());
        let (keys, sky_keys, out) = (self.keys.visibility.clone(), self.keys.sky.clone(), to.own.clone());
        system.source("visibility", ActorOptions::default(), move |context| {
            let look = || -> Result<(), Failure> {
                for &view in &views {
                    context.check()?;
                    if cache.get_typed::<Mask>(&keys[view], VISIBILITY)?.is_some() {
                        continue;
                    }
                    let found = board.wait(view, || context.stopping()) == Some(true);
                    context.check()?;
                    let sky = if found { read_sky(&cache, &sky_keys[view]) } else { None };
                    let _step = context.span(&scene.views[view].name);
                    let seen = visibility(&model, &*engine, &scene.views[view], view, sky.as_ref(), size)?;
                    cache.put_typed(&keys[view], VISIBILITY, &seen)?;
                    context.progress();
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

    fn ask_for_field(&mut self, to: &Inboxes) -> Result<(), RunError> {
        let s = &self.state;
        let ready = s.sky_open == 0 && s.embed_open == 0 && s.masks_begun && s.masks_open == 0 && s.visible;
        let Some(model) = s.model.clone().filter(|_| ready && !s.field_asked && self.wants("features"))
        else {
            return Ok(());
        };
        self.state.field_asked = true;
        if let Some(field) = self.cache.get_typed::<FeatureField>(&self.keys.features, FEATURES)? {
            let key = self.keys.features.to_string();
            self.options.events.tell(Event::StageSkipped { stage: "features".into(), key });
            return self.take_field(field);
        }
        self.ledger.begin_stage("features", &self.keys.features)?;
        let mut views = Vec::new();
        for view in self.views(false) {
            if !self.state.embedded[view] {
                continue;
            }
            let (sky_key, key) = (self.keys.sky[view], self.keys.visibility[view]);
            let found = self.board.get(view) == Some(true);
            self.ledger.record_view(
                "visibility",
                &self.scene.views[view].name,
                &key,
                &ViewOutcome::cached(),
            )?;
            views.push(FieldView {
                view,
                embedding: self.keys.embedding[view],
                masks: self.state.masked[view].then(|| self.keys.masks[view]),
                sky: found.then_some(sky_key),
                visibility: key,
            });
        }
        let task = FeatureTask::Field {
            splats: Arc::new(model.splats.clone()),
            options: model.options(),
            views: Arc::new(views),
        };
        to.features.blocking_send(task).map_err(|_| RunError::Interrupted) // closed: everything stops
    }
}

/// A view's sky, from where the masks actor left it. What has been damaged since counts as no sky known, and is
/// made anew by the next run.
pub(crate) fn read_sky(cache: &Cache, key: &Key) -> Option<Mask> {
    cache.get_typed(key, "sky").ok().flatten()
}

/// What each life of the trainer is built from.
struct TrainerParts {
    engine: Arc<dyn Engine>,
    out: Sender<Outcome>,
}
