//! Feeds the actors of one scene and handles their outcomes.
//!
//! Three of the four actors work here: `masks`, `trainer` and `features` (a click starts the fourth, `segmenter`, in a
//! process of its own: `segment.rs`). Sources are threads that only send: `ingest` requests skies, `photos` embeddings,
//! `intrinsic renders` masks; `visibility` compares photos with the trained scene.
//!
//! ```text
//! ingest            -> masks:    sky(view)*      -> trainer, which waits for the sky of each photo it comes to
//! photos            -> features: embed(view)*
//!                      trainer:  geometry        -> snapshot at a fixed step, the trained scene at the end
//! intrinsic renders -> masks:    masks(view)*       from the snapshot, while geometry trains on
//! visibility        -> coordinator                  from the trained scene, while masks are made
//!                      features: field              from embeddings, visibility and masks
//! ```
//!
//! A training without a sky that was given up has another key than a training with that sky. So everything whose key
//! depends on the training's, except the training itself, waits until each sky is known ([`Coordinator::go_on`]).
//! Snapshots are taken at fixed steps and views go in fixed order, so the result does not depend on which actor is
//! faster.

mod handle;
mod speed;
mod start;

use crate::artifacts::checkpoints::Keeper;
use crate::artifacts::keys::Keys;
use crate::artifacts::recompute::Recompute;
use crate::output::objects::{ListRequest, ObjectList, TreeSource};
use crate::run::continued::TrainingOrigin;
use crate::run::graph::{RunOptions, position_of};
use crate::run::inputs::Inputs;
use crate::run::memory;
use crate::run::outcome::ActorOutcome;
use crate::run::skies::Skies;
use crate::run::view_slots::ViewSlots;
use crate::transients::KnownTransients;
use crate::{RunError, RunFolder, Settings};
use segwild_features::{FeatureActor, FeatureField, FeatureTask};
use segwild_flow::ledger::{State as Progress, ViewRow};
use segwild_flow::{
    ActorFailure, ActorOptions, Cache, Event, Exit, Guest, Key, Ledger, Limits, Message, Phase, Receiver,
    Recorder, Report, Sender, StageProgress, System, SystemOptions, fault, mailbox,
};
use segwild_masks::{MaskActor, MaskMaker, MaskTask};
use segwild_objective::Engine;
use segwild_scene::{Scene, Skipped};
use segwild_trainer::{Model, TrainActor, TrainOrder, TrainOutcome};
use segwild_vision::{Embedder, PromptSegmenter, Providers};
use speed::MaskSpeed;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Kind of the cache's records of how a training went.
const HISTORY: &str = "history";

/// The state of a run, as far as its actors have reported.
#[derive(Default)]
pub struct CoordinatorState {
    pub model: Option<Arc<Model>>,
    pub field: Option<Arc<FeatureField>>,
    pub skipped: Vec<Skipped>,
    /// The field, until everything that its key depends on is known.
    pub made_field: Option<Box<FeatureField>>,
    pub embedded: Vec<bool>,
    /// Views whose sky was given up.
    pub without_sky: BTreeSet<usize>,
    pub sky_open: usize,
    /// Those of the open skies whose photos are trained on.
    pub training_sky_open: usize,
    pub embed_open: usize,
    pub masks_open: usize,
    /// The training was ordered, or found done.
    pub geometry_started: bool,
    /// The scene at the snapshot step, until the masks are started.
    pub snapshot: Option<Arc<Model>>,
    pub masks_started: bool,
    pub visibility_started: bool,
    /// The visibility of every photo is known.
    pub visible: bool,
    pub field_ordered: bool,
    /// The trained scene is there, and the training is done again up to the snapshot alone.
    pub only_to_snapshot: bool,
    /// The training has reached the requested step, this one, and is not over.
    pub paused: Option<u32>,
    pub made: usize,
    pub cached: usize,
    /// A stage that failed, and why.
    pub failed: Option<(&'static str, ActorFailure)>,
    /// Per kind of work, how many photos were given up, and the first one with its error.
    pub failures: BTreeMap<&'static str, (usize, String)>,
    /// The inputs of the field, from the end of the training on.
    pub inputs: Option<Arc<Inputs>>,
    /// Views whose visibility could not be computed.
    pub unseen: BTreeSet<usize>,
    /// How fast masks are made.
    pub mask_speed: MaskSpeed,
}

/// Its name among the actors.
const NAME: &str = "coordinator";

/// Starts the stages of one run and handles what its actors report.
pub struct Coordinator<'a> {
    pub folder: &'a RunFolder,
    pub settings: &'a Settings,
    pub options: &'a RunOptions,
    pub ledger: &'a Ledger,
    pub recorder: &'a Recorder,
    pub scene: Arc<Scene>,
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
    pub cache: Cache,
    /// Index into [`STAGES`] of the last stage to run.
    pub last: usize,
    /// The step of the training to stop after.
    pub steps: u32,
    pub skies: Arc<Skies>,
    /// What is known of transients before anything is trained.
    pub known: KnownTransients,
    pub segmenter: Arc<dyn PromptSegmenter>,
    pub embedder: Arc<dyn Embedder>,
    pub maker: Arc<MaskMaker>,
    /// Per view, whether its masks are in the cache; `false` when they were given up.
    pub masks_known: Arc<ViewSlots<bool>>,
    /// The trainer misses an input: a stop ended the wait for a photo's sky, or a photo file was removed. What it makes
    /// from then on is not kept.
    pub tainted: Arc<AtomicBool>,
    pub state: CoordinatorState,
}

/// The mailboxes that the coordinator sends to.
pub(crate) struct Inboxes {
    masks: Sender<MaskTask>,
    features: Sender<FeatureTask>,
    training: Sender<TrainOrder>,
    /// The coordinator's own mailbox, for sources that report to it.
    own: Sender<ActorOutcome>,
}

/// Progress of the stages that go view by view or step by step.
#[derive(Default)]
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

    /// Reads artefacts of photos, and recomputes those that are damaged.
    fn recompute(&self) -> Recompute {
        Recompute {
            scene: self.scene.clone(),
            cache: self.cache.clone(),
            events: self.options.events.clone(),
        }
    }

    /// Whether a stage is to run.
    pub fn wants(&self, stage: &str) -> bool {
        position_of(stage) <= self.last
    }

    /// The stage `objects`: the list of the trained scene's objects, from its tree.
    pub fn list_objects(&self, model: &Model) -> Result<(), RunError> {
        let (folder, key) = (self.folder, self.keys.stage("objects"));
        let events = &self.options.events;
        let before = ObjectList::read(folder);
        if self.ledger.stage_is_done("objects", &key)? && before.is_some() {
            events.tell(Event::StageSkipped { stage: "objects".into(), key: key.to_string() });
            return Ok(());
        }
        self.ledger.start_stage("objects", &key)?;
        let progress = events.stage("objects", None);
        let (size, geometry) = (self.settings.scene.size, self.keys.geometry.to_string());
        let source =
            TreeSource { scene: &self.scene, model, geometry: &geometry, size, segmenter: &*self.segmenter };
        let stopping = || self.options.stopper.phase() != Phase::Running;
        match source.tree(&self.cache, &stopping)? {
            Some(tree) => {
                let (scene, key) = (&*self.scene, source.key().to_string());
                let request = ListRequest { scene, model, size, tree: &tree, key };
                request.list(before.as_ref(), &self.options.stopper)?.write(folder)?;
            }
            None if stopping() => return Err(RunError::Interrupted),
            // The provider finds objects by itself: a list of another provider's tree is of no use.
            None => ObjectList::remove(folder)?,
        }
        progress.finish();
        Ok(self.ledger.finish_stage("objects", &key, None)?)
    }

    /// The views that take part, in order: held-out ones have a sky (evaluation leaves it out of the score) but no
    /// embedding and no masks.
    fn views(&self, with_test: bool) -> Vec<usize> {
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
    pub(crate) fn intact(&self) -> Result<(), RunError> {
        Ok(self.views(true).into_iter().try_for_each(|view| self.scene.views[view].intact())?)
    }

    /// Spawns the actors, feeds them and handles their outcomes. Returns the actors' report and the result of the work.
    pub fn flow(&mut self, providers: &Providers) -> Result<(Report, Result<(), RunError>), RunError> {
        let system = System::new(SystemOptions {
            events: self.options.events.clone(),
            stopper: self.options.stopper.clone(),
            stuck_after: Duration::from_secs(self.settings.run.stuck_after.max(1).into()),
            threads: self.settings.run.threads as usize,
            ..SystemOptions::default()
        })?;
        let limits = Limits { count: 64, bytes: 64 << 20 };
        // Photos do not depend on each other: on many cores several are worked on at once.
        let parallel = ActorOptions {
            workers: memory::photos_at_once(self.settings, &self.scene),
            ..ActorOptions::default()
        };
        // Renders wait here: a few ahead keep the actor busy, more would only fill memory.
        let few = Limits { count: 4 * parallel.workers, bytes: 64 << 20 };
        let (out, inbox) = mailbox::<ActorOutcome>(NAME, limits);
        self.recorder.watch(system.observer());
        self.recorder.mailbox(&inbox);
        let (masks, masks_in) = mailbox::<MaskTask>("masks", few);
        let (features, features_in) = mailbox::<FeatureTask>("features", limits);
        let (training, training_in) = mailbox::<TrainOrder>("trainer", limits);

        let (scene, size, cache) = (self.scene.clone(), self.settings.scene.size, self.cache.clone());
        let (engine, settings) = (self.engine.clone(), self.settings.clone());
        let own = out.clone();
        let train = TrainerParts { engine: engine.clone(), out: out.clone() };
        system.spawn(training_in, ActorOptions { attempts: 2, ..ActorOptions::default() }, move || {
            Ok(TrainActor { engine: train.engine.clone(), out: train.out.clone() })
        })?;
        let (c, o, sky, maker) = (cache.clone(), out.clone(), providers.sky.clone(), self.maker.clone());
        system.spawn(masks_in, parallel, move || {
            Ok(MaskActor { sky: sky.clone(), maker: maker.clone(), cache: c.clone(), out: o.clone() })
        })?;
        let (embedder, f) = (self.embedder.clone(), settings.features.clone());
        system.spawn(features_in, parallel, move || {
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

        self.state.mask_speed = MaskSpeed::of(providers.proposer.clone());
        let guest = system.guest(NAME)?;
        let outcome = self.conduct(&system, &guest, Inboxes { masks, features, training, own }, &inbox);
        drop(guest);
        if outcome.is_err() {
            self.options.stopper.stop();
        }
        // An actor that is stopping may still send an outcome, and must not wait for a full mailbox.
        let drained = std::thread::scope(|scope| {
            let rest = scope.spawn(|| {
                let mut late = Vec::new();
                while let Some(outcome) = inbox.blocking_recv() {
                    if let ActorOutcome::Train(
                        outcome @ (TrainOutcome::Checkpoint(_) | TrainOutcome::Progress { .. }),
                    ) = outcome
                    {
                        late.push(outcome);
                    }
                }
                late
            });
            let report = system.join();
            inbox.close();
            (report, rest.join().unwrap_or_default())
        });
        let sound = !self.tainted.load(Ordering::Acquire) && self.intact().is_ok();
        // The progress up to a checkpoint is kept with it: a run that continues from there does not report it again.
        for outcome in drained.1.into_iter().filter(|_| sound) {
            self.handle_trainer(outcome, &mut Bars::default())?;
        }
        Ok((drained.0, outcome))
    }

    /// Feeds the actors and handles their outcomes until everything that is wanted is there.
    fn conduct(
        &mut self,
        system: &System,
        guest: &Guest,
        to: Inboxes,
        inbox: &Receiver<ActorOutcome>,
    ) -> Result<(), RunError> {
        guest.busy("starts");
        let n = self.scene.views.len();
        self.state.embedded = vec![false; n];
        for i in 0..n {
            if let Some(reason) = self.keys.unreadable(i) {
                let skipped = Skipped { name: self.scene.views[i].name.clone(), reason: reason.to_owned() };
                self.options
                    .events
                    .warn(Some("ingest"), format!("photo {} is left out: {reason}", skipped.name));
                self.state.skipped.push(skipped);
                self.skies.set(i, false);
            }
        }
        let mut bars = Bars { sky: None, embed: None, masks: None, geometry: None };
        let events = self.options.events.clone();

        // A source only sends and needs no threads to compute on.
        let feeder = ActorOptions { threads: Some(1), ..ActorOptions::default() };
        let with_sky = self.views(true);
        self.state.sky_open = with_sky.len();
        let (held_out, training): (Vec<usize>, Vec<usize>) =
            with_sky.iter().partition(|&&view| self.scene.views[view].test);
        self.state.training_sky_open = training.len();
        // Held-out photos come last: only the scores need their skies.
        self.skies.plan(training.into_iter().chain(held_out));
        bars.sky = Some(events.stage("sky", Some(with_sky.len() as u64)));
        let stage_key = self.keys.stage("sky");
        self.ledger.start_stage("sky", &stage_key)?;
        let (masks, keys, skies) = (to.masks.clone(), self.keys.sky.clone(), self.skies.clone());
        system.source("ingest", feeder, move |context| {
            while let Some(view) = skies.next_open() {
                context.check()?;
                masks.blocking_send_urgent(MaskTask::Sky { view, key: keys[view] })?;
            }
            Ok(())
        })?;

        if self.wants("embed") {
            let views = self.views(false);
            self.state.embed_open = views.len();
            bars.embed = Some(events.stage("embed", Some(views.len() as u64)));
            self.ledger.start_stage("embed", &self.keys.stage("embed"))?;
            let (features, keys) = (to.features.clone(), self.keys.embedding.clone());
            system.source("photos", feeder, move |context| {
                for &view in &views {
                    context.check()?;
                    features.blocking_send(FeatureTask::Embed { view, key: keys[view] })?;
                }
                Ok(())
            })?;
        }
        loop {
            self.go_on(system, &to, &mut bars)?;
            if self.complete() {
                return Ok(());
            }
            if self.options.stopper.phase() != Phase::Running {
                return Ok(());
            }
            guest.waits();
            let received = inbox.recv_timeout(Duration::from_millis(200));
            guest.busy(&received.as_ref().map_or_else(|_| String::new(), Message::label));
            if received.is_ok() {
                fault::point("coordinator.hear")
                    .map_err(|e| RunError::Stage { stage: "flow", reason: e.to_string() })?;
            }
            match received {
                Ok(_) if self.tainted.load(Ordering::Acquire) => {
                    return match self.skies.lost() {
                        Some(lost) => Err(RunError::of_stage("sky", &lost)),
                        None => self.intact(),
                    };
                }
                Ok(outcome) => self.handle(outcome, &mut bars)?,
                Err(_)
                    if self.options.stopper.phase() == Phase::Running
                        && system.snapshot().iter().all(|a| a.name == NAME || a.exit != Exit::Running) =>
                {
                    return Err(RunError::Stage {
                        stage: "flow",
                        reason: "every actor has ended early".into(),
                    });
                }
                Err(_) => {}
            }
            if let Some((stage, failure)) = self.state.failed.take() {
                let reason = failure.to_string();
                self.ledger.fail_stage(stage, &self.keys.stage(stage), &reason)?;
                events.tell(Event::StageFailed { stage: stage.into(), error: reason.clone() });
                return Err(RunError::of_stage(stage, &failure));
            }
        }
    }

    /// Starts what can start by now.
    fn go_on(&mut self, system: &System, to: &Inboxes, bars: &mut Bars) -> Result<(), RunError> {
        if !self.wants("masks") {
            return Ok(());
        }
        let skies_known = self.state.training_sky_open == 0;
        if !self.state.geometry_started && (skies_known || !self.something_kept()?) {
            self.state.geometry_started = true;
            self.start_geometry(to, bars)?;
        }
        if !skies_known {
            return Ok(());
        }
        if let Some(snapshot) = self.state.snapshot.take().filter(|_| !self.state.masks_started) {
            self.start_masks(snapshot, system, to, bars)?;
        }
        if !self.state.visibility_started && self.state.model.is_some() {
            self.state.visibility_started = true;
            self.start_visibility(system, to)?;
        }
        self.order_field(to)?;
        self.keep_field()
    }

    /// Whether an earlier run left something of the training that this one may continue, or had to do without a sky.
    /// Then the skies come first, since the key of the training depends on them. A training from step 0 does not wait
    /// for all skies: it waits for the sky of each photo when it comes to it.
    fn something_kept(&self) -> Result<bool, RunError> {
        let kept =
            self.cache.contains(&self.full_keys.geometry) || self.cache.contains(&self.full_keys.snapshot);
        let whole = Keeper { key: &self.full_keys.training, ..self.keeper() };
        if kept || !whole.rows()?.is_empty() {
            return Ok(true);
        }
        let given_up = |row: ViewRow| {
            row.outcome.state == Progress::Failed
                && self.full_keys.sky.iter().any(|key| key.to_string() == row.key)
        };
        Ok(self.ledger.views("sky")?.into_iter().any(given_up))
    }

    fn complete(&self) -> bool {
        let s = &self.state;
        s.sky_open == 0
            && s.embed_open == 0
            && (!self.wants("masks")
                || s.masks_started && s.masks_open == 0
                || s.paused.is_some() && !s.masks_started && s.snapshot.is_none())
            && !s.only_to_snapshot
            && (!self.wants("geometry") || s.model.is_some() || s.paused.is_some())
            && (!self.wants("features") || s.field.is_some())
    }
}

/// What the trainer is built from, at first and again after a panic.
struct TrainerParts {
    engine: Arc<dyn Engine>,
    out: Sender<ActorOutcome>,
}
