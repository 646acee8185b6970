//! The coordinator of a run: it starts the stages that can start, and gives each outcome to its stage.
//!
//! Three of the four actors work here: `masks`, `trainer` and `features` (a click starts the fourth, `segmenter`, in a
//! [`Session`](crate::Session)). Which stage needs what stands in the nodes of the stages
//! ([`NODES`](super::stages::NODES)); `segwild run --explain --graph` prints it.
//!
//! A training without a sky that was given up has another key than a training with that sky. So everything whose key
//! depends on the training's, except the training itself, needs the sky of each photo that is trained on. Snapshots are
//! taken at fixed steps and views go in fixed order, so the result does not depend on which actor is faster.

use super::context::RunContext;
use super::graph::{StageGraph, node_of};
use super::memory;
use super::need::Extent;
use super::node::StageWork;
use super::outcome::ActorOutcome;
use super::speed::MaskSpeed;
use super::stage::Stage;
use super::stages::NODES;
use super::wiring::{ActorInboxes, ActorParts, Wiring};
use super::work::{ActorStage, Actors, StageState};
use crate::RunError;
use segwild_features::FeatureTask;
use segwild_flow::{
    Event, Exit, Guest, Limits, Message, Receiver, Recorder, Report, System, SystemOptions, fault, mailbox,
};
use segwild_masks::MaskTask;
use segwild_trainer::{TrainOrder, TrainOutcome};
use segwild_vision::Providers;
use std::collections::BTreeSet;
use std::sync::atomic::Ordering;
use std::time::Duration;

/// Its name among the actors.
const NAME: &str = "coordinator";

/// The reason of a failure that belongs to no stage.
fn failed(reason: impl Into<String>) -> RunError {
    RunError::Stage { stage: "flow", reason: reason.into() }
}

/// Starts the stages of one run and handles what its actors report.
pub struct Coordinator<'a> {
    /// What the stages share.
    pub run: RunContext<'a>,
    graph: StageGraph,
    /// The stages that the run works on.
    wanted: BTreeSet<Stage>,
    stages: Vec<(Stage, Box<dyn ActorStage>)>,
}

impl<'a> Coordinator<'a> {
    /// A coordinator that has started nothing.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn new(run: RunContext<'a>) -> Result<Coordinator<'a>, RunError> {
        let mut graph = StageGraph::of_a_run();
        let wanted = graph.wanted(run.setup.last);
        if wanted.contains(&Stage::Geometry) && run.something_kept()? {
            graph.require(Stage::Geometry, Stage::Sky, Extent::Part);
        }
        let stages = NODES.iter().filter_map(|node| match node.work {
            StageWork::Actors(stage) => Some((node.stage, stage())),
            StageWork::Before | StageWork::Run(_) | StageWork::End(_) => None,
        });
        Ok(Coordinator { run, graph, wanted, stages: stages.collect() })
    }

    /// Spawns the actors, feeds them and handles their outcomes. Returns the actors' report and the result of the work.
    ///
    /// # Errors
    /// When the actors cannot be started, or a late outcome cannot be kept.
    pub fn flow(
        &mut self,
        providers: &Providers,
        recorder: &Recorder,
        wiring: &dyn Wiring,
    ) -> Result<(Report, Result<(), RunError>), RunError> {
        let run = &self.run;
        let system = System::new(SystemOptions {
            events: run.setup.options.events.clone(),
            stopper: run.setup.options.stopper.clone(),
            stuck_after: Duration::from_secs(run.setup.settings.run.stuck_after.max(1).into()),
            threads: run.setup.settings.run.threads as usize,
            ..SystemOptions::default()
        })?;
        let limits = Limits { count: 64, bytes: 64 << 20 };
        let photos_at_once = memory::photos_at_once(run.setup.settings, run.scene());
        // Renders wait here: a few ahead keep the actor busy, more would only fill memory.
        let few = Limits { count: 4 * photos_at_once, bytes: 64 << 20 };
        let (out, inbox) = mailbox::<ActorOutcome>(NAME, limits);
        recorder.watch(system.observer());
        recorder.mailbox(&inbox);
        let (masks, masks_in) = mailbox::<MaskTask>("masks", few);
        let (features, features_in) = mailbox::<FeatureTask>("features", limits);
        let (training, training_in) = mailbox::<TrainOrder>("trainer", limits);
        let own = out.clone();
        let parts = ActorParts {
            photos: run.photos().clone(),
            engine: run.setup.engine.clone(),
            cache: run.setup.cache.clone(),
            sky: providers.sky.clone(),
            maker: run.setup.maker.clone(),
            embedder: run.setup.embedder.clone(),
            features: run.setup.settings.features.clone(),
            photos_at_once,
        };
        let inboxes = ActorInboxes { masks: masks_in, features: features_in, training: training_in, out };
        wiring.spawn(&system, inboxes, parts)?;

        self.run.mask_speed = MaskSpeed::of(providers.proposer.clone());
        let guest = system.guest(NAME)?;
        let actors = Actors { system: &system, masks, features, training, own };
        let outcome = self.conduct(&actors, &guest, &inbox);
        drop((actors, guest));
        self.run.drop_bars();
        if outcome.is_err() {
            self.run.setup.options.stopper.stop();
        }
        // An actor that is stopping may still send an outcome, and must not wait for a full mailbox.
        let (report, late) = std::thread::scope(|scope| {
            let rest = scope.spawn(|| {
                let mut late = Vec::new();
                while let Some(outcome) = inbox.blocking_recv() {
                    if let ActorOutcome::Train(TrainOutcome::Checkpoint(_) | TrainOutcome::Progress { .. }) =
                        outcome
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
        let sound = !self.run.signals.tainted.load(Ordering::Acquire) && self.run.intact().is_ok();
        // The progress up to a checkpoint is kept with it: a run that continues from there does not report it again.
        for outcome in late.into_iter().filter(|_| sound) {
            self.handle(outcome)?;
        }
        Ok((report, outcome))
    }

    /// Feeds the actors and handles their outcomes until everything that is wanted is there.
    fn conduct(
        &mut self,
        actors: &Actors<'_>,
        guest: &Guest,
        inbox: &Receiver<ActorOutcome>,
    ) -> Result<(), RunError> {
        guest.busy("starts");
        self.run.made.embedded = vec![false; self.run.scene().views.len()];
        self.run.leave_out_unreadable();
        loop {
            self.start_stages(actors)?;
            if self.is_complete() || self.run.is_stopping() {
                return Ok(());
            }
            guest.waits();
            let received = inbox.recv_timeout(Duration::from_millis(200));
            guest.busy(&received.as_ref().map_or_else(|_| String::new(), Message::label));
            if received.is_ok() {
                fault::point("coordinator.handle").map_err(|e| failed(e.to_string()))?;
            }
            match received {
                Ok(_) if self.run.signals.tainted.load(Ordering::Acquire) => {
                    return match self.run.signals.skies.lost() {
                        Some(lost) => Err(RunError::of_stage(Stage::Sky.name(), &lost)),
                        None => self.run.intact(),
                    };
                }
                Ok(outcome) => self.handle(outcome)?,
                Err(_)
                    if !self.run.is_stopping()
                        && actors
                            .system
                            .snapshot()
                            .iter()
                            .all(|a| a.name == NAME || a.exit != Exit::Running) =>
                {
                    return Err(failed("every actor has ended early"));
                }
                Err(_) => {}
            }
            if let Some((stage, failure)) = self.run.take_failure() {
                let (name, reason) = (stage.name(), failure.to_string());
                self.run.setup.ledger.fail_stage(name, &node_of(stage).key(self.run.keys()), &reason)?;
                self.run.setup.options.events.tell(Event::StageFailed { stage: name.into(), error: reason });
                return Err(RunError::of_stage(name, &failure));
            }
        }
    }

    /// Starts the stages that can start by now, and goes on with those that run.
    fn start_stages(&mut self, actors: &Actors<'_>) -> Result<(), RunError> {
        while let Some(next) = self.next_ready() {
            self.stages[next].1.start(&mut self.run, actors)?;
        }
        let running = |stage: &&mut (Stage, Box<dyn ActorStage>)| stage.1.state() == StageState::Running;
        for (_, stage) in self.stages.iter_mut().filter(running) {
            stage.go_on(&mut self.run, actors)?;
        }
        Ok(())
    }

    /// The first wanted stage that waits and needs nothing more.
    fn next_ready(&self) -> Option<usize> {
        let gives = |stage: Stage, extent: Extent| self.gives(stage, extent);
        self.stages.iter().position(|(stage, work)| {
            work.state() == StageState::Waiting
                && self.wanted.contains(stage)
                && self.graph.is_ready(*stage, gives)
        })
    }

    fn stage(&self, stage: Stage) -> Option<&dyn ActorStage> {
        self.stages.iter().find(|(s, _)| *s == stage).map(|(_, work)| &**work)
    }

    fn gives(&self, stage: Stage, extent: Extent) -> bool {
        // The scene could not have been opened without them.
        if stage == Stage::Poses {
            return true;
        }
        self.stage(stage).is_some_and(|work| work.gives(extent, &self.run.made))
    }

    /// Gives an outcome to its stage.
    fn handle(&mut self, outcome: ActorOutcome) -> Result<(), RunError> {
        let mut left = outcome;
        for (_, stage) in &mut self.stages {
            match stage.handle(left, &mut self.run)? {
                Some(other) => left = other,
                None => return Ok(()),
            }
        }
        Err(failed(format!("no stage {}", left.label())))
    }

    /// Whether every stage that was requested is over, or cannot start since the training is paused before what it
    /// needs.
    fn is_complete(&self) -> bool {
        let over = |stage: Stage| self.stage(stage).is_some_and(|work| work.state() == StageState::Over);
        let out_of_reach = |stage: Stage, work: &dyn ActorStage| {
            let never = |stage: Stage, extent: Extent| !self.gives(stage, extent) && over(stage);
            self.run.made.paused.is_some()
                && work.state() == StageState::Waiting
                && self.graph.needs(stage).iter().any(|need| never(need.stage, need.extent))
        };
        self.stages
            .iter()
            .filter(|(stage, work)| self.run.wants(*stage) || work.must_end())
            .all(|(stage, work)| work.state() == StageState::Over || out_of_reach(*stage, &**work))
    }
}
