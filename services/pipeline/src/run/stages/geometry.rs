//! The stage `geometry`: the trainer. It sends a snapshot at a fixed step, checkpoints, and the trained scene.

use crate::RunError;
use crate::artifacts::cache::TRANSIENTS;
use crate::artifacts::checkpoints::Keeper;
use crate::artifacts::folder::MODEL;
use crate::artifacts::history::{self, HISTORY, Moment};
use crate::artifacts::seams;
use crate::run::context::RunContext;
use crate::run::need::{Extent, Need};
use crate::run::node::{Performer, StageNode, StageWork};
use crate::run::outcome::ActorOutcome;
use crate::run::products::{Products, SnapshotSlot};
use crate::run::results::{StageResults, StageVerdict};
use crate::run::situation::{KeptResults, Situation};
use crate::run::skies::Skies;
use crate::run::stage::Stage;
use crate::run::work::{ActorStage, Actors, StageState};
use crate::transients::KnownTransients;
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorFailure, Phase, Stopper, codec};
use segwild_scene::{PhotoStore, ReaderError};
use segwild_trainer::{
    FindCheckpoint, Model, Photos, PreparationProgress, TrainOrder, TrainOutcome, TrainPhoto,
};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// The stage in the graph.
pub const NODE: StageNode = StageNode {
    stage: Stage::Geometry,
    by: Performer::Actor("trainer"),
    feed: None,
    needs: &[Need { stage: Stage::Sky, extent: Extent::PerPhoto, what: "sky*" }],
    results: StageResults::Found { key: |keys| keys.geometry, verdict },
    work: StageWork::Actors(|| Box::new(GeometryStage::Waiting)),
};

enum GeometryStage {
    Waiting,
    Training,
    /// The trained scene is there, and its snapshot has gone: the training is done again up to it.
    AgainToSnapshot,
    /// The training stands at the requested step, and is not over.
    Paused,
    Trained,
}

impl ActorStage for GeometryStage {
    fn state(&self) -> StageState {
        match self {
            GeometryStage::Waiting => StageState::Waiting,
            GeometryStage::Training | GeometryStage::AgainToSnapshot => StageState::Running,
            GeometryStage::Paused | GeometryStage::Trained => StageState::Over,
        }
    }

    /// A part: the snapshot. The trained scene may be there without it.
    fn gives(&self, extent: Extent, made: &Products) -> bool {
        match extent {
            Extent::PerPhoto => self.state() != StageState::Waiting,
            Extent::Part => !matches!(made.snapshot, SnapshotSlot::Missing),
            Extent::Whole => made.model.is_some(),
        }
    }

    /// Takes the trained scene and its snapshot from the cache, or orders the training.
    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError> {
        *self = GeometryStage::Training;
        run.name_training()?;
        // A whole record may still be another program's: one whose parts do not fit together counts as missing.
        let sound = |model: &Model| model.check().is_ok();
        let done = run.setup.cache.get_typed::<Model>(&run.keys().geometry, MODEL)?.filter(sound);
        let snapshot = run.setup.cache.get_typed::<Model>(&run.keys().snapshot, MODEL)?.filter(sound);
        let snapshot_kept = snapshot.is_some();
        if let Some(snapshot) = snapshot {
            run.made.snapshot.put(Arc::new(snapshot));
        }
        let snapshot_step = run.setup.settings.train.snapshot_step();
        if let Some(model) = done {
            match run.setup.cache.get_typed::<Vec<Moment>>(&run.keys().history, HISTORY)? {
                Some(moments) => history::replace(run.setup.folder, &moments)?,
                // The history in the folder is of this training.
                None if run.setup.ledger.stage_is_done(Stage::Geometry.name(), &run.keys().geometry)? => {
                    run.setup.cache.put_typed(
                        &run.keys().history,
                        HISTORY,
                        &history::read(run.setup.folder),
                    )?;
                }
                None => {}
            }
            run.take_model(Arc::new(model))?;
            if snapshot_kept {
                *self = GeometryStage::Trained;
                return run.skip_stage(Stage::Geometry, &run.keys().geometry);
            }
            *self = GeometryStage::AgainToSnapshot;
        }
        run.setup.ledger.start_stage(Stage::Geometry.name(), &run.keys().geometry)?;
        // Without the snapshot the training is done again from a checkpoint before it, or from the start.
        let before = if snapshot_kept { u32::MAX } else { snapshot_step };
        let again = matches!(self, GeometryStage::AgainToSnapshot);
        let until = if again { snapshot_step } else { run.setup.steps };
        let checkpoint = match stands_at(run, before)? {
            Some(step) if !again => {
                *self = GeometryStage::Paused;
                run.made.paused = Some(step);
                return Ok(());
            }
            _ => find_checkpoint(run, before.min(run.setup.steps.saturating_add(1))),
        };
        run.start_bar(Stage::Geometry, until.into());
        for view in run.views(false).into_iter().filter(|_| run.setup.known.network.is_some()) {
            let (name, key) = (&run.scene().views[view].name, &run.keys().known_transients[view]);
            run.setup.ledger.record_view(TRANSIENTS, name, key, &ViewOutcome::cached())?;
        }
        let order = TrainOrder {
            scene: run.setup.given.clone(),
            photos: Arc::new(RunPhotos::of(run)),
            settings: run.setup.settings.train.clone(),
            lpips: run.setup.lpips.clone(),
            until,
            checkpoint,
            checkpoint_every: Duration::from_secs(run.setup.settings.run.checkpoint_every.max(1).into()),
        };
        actors.training.blocking_send(order).map_err(|_| RunError::Interrupted) // closed: everything stops
    }

    fn handle(
        &mut self,
        outcome: ActorOutcome,
        run: &mut RunContext<'_>,
    ) -> Result<Option<ActorOutcome>, RunError> {
        match outcome {
            ActorOutcome::Train(outcome) => self.handle_trainer(outcome, run).map(|()| None),
            other => Ok(Some(other)),
        }
    }

    fn must_end(&self) -> bool {
        matches!(self, GeometryStage::AgainToSnapshot)
    }
}

impl GeometryStage {
    fn handle_trainer(&mut self, outcome: TrainOutcome, run: &mut RunContext<'_>) -> Result<(), RunError> {
        let name = Stage::Geometry.name();
        let again = matches!(self, GeometryStage::AgainToSnapshot);
        match outcome {
            TrainOutcome::Began { step, upcoming } => {
                run.signals.skies.prefer(&upcoming);
                if step > 0 {
                    run.setup.options.events.info(Some(name), format!("goes on from step {step}"));
                }
                if let Some(bar) = run.bar(Stage::Geometry) {
                    if bar.part().is_some() {
                        bar.own_work();
                    }
                    bar.cached(u64::from(step).saturating_sub(bar.done()));
                }
                if again { Ok(()) } else { history::trim(run.setup.folder, step) }
            }
            TrainOutcome::Preparing(PreparationProgress { part, done, total }) => {
                if let Some(bar) = run.bar(Stage::Geometry) {
                    let (name, total) = (part.to_string(), total as u64);
                    let done = done as u64;
                    if bar.part() != Some(&name) || bar.done() > done {
                        bar.next_part(&name, Some(total));
                        // A part that goes on after another one: what it has done took none of the time since.
                        bar.cached(done);
                    }
                    bar.set_total(total);
                    bar.advance(done.saturating_sub(bar.done()));
                }
                Ok(())
            }
            TrainOutcome::Progress { step, loss, psnr, splats, left_out } => {
                // Imported splats are not trained: they have no losses.
                let trained = run.scene().imported.is_none();
                if trained && !again {
                    history::append(run.setup.folder, &Moment { step, loss, psnr, splats, left_out })?;
                }
                if let Some(bar) = run.bar(Stage::Geometry) {
                    bar.advance(u64::from(step).saturating_sub(bar.done()));
                }
                let (events, at) = (&run.setup.options.events, Some(u64::from(step)));
                let metrics = [("psnr_db", psnr), ("loss", loss), ("left_out", left_out)];
                for (metric, value) in metrics.into_iter().take(if trained { 3 } else { 1 }) {
                    events.metric(name, metric, f64::from(value), at);
                }
                events.metric(name, "splats", splats as f64, at);
                events.metric(name, "stall_s", run.signals.skies.waited_s(), None);
                Ok(())
            }
            TrainOutcome::Snapshot(snapshot) => {
                run.intact()?;
                run.setup.cache.put_typed(&run.keys().snapshot, MODEL, &*snapshot)?;
                run.made.snapshot.put(snapshot);
                Ok(())
            }
            TrainOutcome::Checkpoint(checkpoint) => {
                run.intact()?;
                let began = Instant::now();
                run.keeper().save(&checkpoint)?;
                let seconds = began.elapsed().as_secs_f64();
                run.setup.options.events.metric(name, "checkpoint_s", seconds, None);
                Ok(())
            }
            TrainOutcome::Seams(check) => {
                run.intact()?;
                seams::write(run.setup.folder, &run.keys().training, &check)
            }
            TrainOutcome::Paused(_) | TrainOutcome::Done(..) if again => {
                *self = GeometryStage::Trained;
                finish(run)
            }
            TrainOutcome::Paused(step) => {
                *self = GeometryStage::Paused;
                run.made.paused = Some(step);
                Ok(())
            }
            TrainOutcome::Done(model, skipped) => {
                run.intact()?;
                run.setup.cache.put_typed(&run.keys().history, HISTORY, &history::read(run.setup.folder))?;
                run.setup.cache.put_typed(&run.keys().geometry, MODEL, &*model)?;
                finish(run)?;
                run.mask_speed.training_ended();
                for s in skipped {
                    let words = format!("photo {} is left out: {}", s.name, s.reason);
                    if run.leave_out(s) {
                        run.setup.options.events.warn(Some(name), words);
                    }
                }
                *self = GeometryStage::Trained;
                run.take_model(model)
            }
            TrainOutcome::Failed(reason) => {
                run.fail(Stage::Geometry, reason);
                Ok(())
            }
        }
    }
}

/// Ends the stage in the ledger.
fn finish(run: &mut RunContext<'_>) -> Result<(), RunError> {
    run.setup.ledger.finish_stage(Stage::Geometry.name(), &run.keys().geometry, None)?;
    run.finish_bar(Stage::Geometry);
    Ok(())
}

/// The photos as the trainer reads them: each waits for its sky.
struct RunPhotos {
    store: Arc<PhotoStore>,
    skies: Arc<Skies>,
    stopper: Stopper,
    tainted: Arc<AtomicBool>,
    transients: KnownTransients,
    /// Per view, why its photo is not usable, if so.
    refused: Vec<Option<String>>,
}

impl RunPhotos {
    fn of(run: &RunContext<'_>) -> RunPhotos {
        RunPhotos {
            store: run.photos().clone(),
            skies: run.signals.skies.clone(),
            stopper: run.setup.options.stopper.clone(),
            tainted: run.signals.tainted.clone(),
            transients: run.setup.known.clone(),
            refused: run.keys().refused(),
        }
    }
}

impl Photos for RunPhotos {
    fn photo(&self, view: usize) -> Result<TrainPhoto, ReaderError> {
        if let Some(reason) = self.refused(view) {
            return Err(reason.into());
        }
        let loaded = self.store.read(view).inspect_err(|_| {
            let changed = self.store.scene().views[view].intact().is_err();
            self.tainted.fetch_or(changed, Ordering::AcqRel);
        })?;
        let known = self.skies.wait(view, || self.stopper.phase() == Phase::Stopping);
        let sky = self.skies.read(view);
        if known.is_none() || sky.is_err() {
            self.tainted.store(true, Ordering::Release);
        }
        let mut photo = TrainPhoto::new(Arc::unwrap_or_clone(loaded), sky.map_err(|lost| lost.to_string())?);
        self.transients.apply(view, &mut photo)?;
        Ok(photo)
    }

    fn refused(&self, view: usize) -> Option<String> {
        self.refused.get(view).cloned().flatten()
    }

    fn is_ready(&self, view: usize) -> bool {
        self.skies.is_known(view)
    }
}

/// The step of the newest checkpoint, if the training is to stop before its end and has come that far.
fn stands_at(run: &RunContext<'_>, before: u32) -> Result<Option<u32>, RunError> {
    if run.setup.steps >= run.setup.settings.train.steps {
        return Ok(None);
    }
    let newest = run.keeper().last_before(before)?.map(|c| c.step());
    Ok(newest.filter(|&step| step >= run.setup.steps))
}

/// Returns a function that finds the last checkpoint before a step. The trainer calls it at its start and after a
/// panic.
fn find_checkpoint(run: &RunContext<'_>, before: u32) -> Arc<FindCheckpoint> {
    let (folder, ledger, events) =
        (run.setup.folder.clone(), run.setup.ledger.clone(), run.setup.options.events.clone());
    let (key, kept) = (run.keys().training, run.setup.settings.run.keep_checkpoints as usize);
    let (elsewhere, origin) = (run.setup.elsewhere.clone(), run.setup.origin.clone());
    let stage = Some(Stage::Geometry.name());
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
            events.info(stage, message);
            return Ok(Some(checkpoint));
        }
        for (engine, key) in &elsewhere {
            if let Some(checkpoint) = last(key)? {
                let step = checkpoint.step();
                let message = format!("the {engine} engine trained up to step {step}: this one takes over");
                events.info(stage, message);
                return Ok(Some(checkpoint));
            }
        }
        Ok(None)
    })
}

/// What a run would do with the training: the same decision as at the start of the stage.
fn verdict(now: &Situation, kept: &KeptResults<'_>) -> Result<StageVerdict, RunError> {
    let KeptResults { cache, folder, ledger } = *kept;
    let (trained, snapshot) = (cache.contains(&now.keys.geometry), cache.contains(&now.keys.snapshot));
    if trained && snapshot {
        return Ok(StageVerdict::Reused);
    }
    let mut steps: Vec<u32> = Vec::new();
    if let Some(ledger) = ledger {
        let rows = ledger.checkpoints(Stage::Geometry.name(), &now.keys.training)?;
        // A run passes over checkpoints that are gone or whose content has changed.
        let whole = rows.iter().filter(|row| {
            let bytes = folder.checkpoint(row).and_then(|path| codec::read_file(&path).ok());
            bytes.is_some_and(|bytes| blake3::hash(&bytes).to_hex().as_str() == row.digest)
        });
        // Without the snapshot, the training has to pass the snapshot step again.
        steps.extend(whole.map(|row| row.step as u32).filter(|&step| snapshot || step < now.snapshot_step));
    }
    // A continued training starts from the last step of another, until it has a checkpoint of its own.
    steps.extend(now.origin.as_ref().filter(|_| snapshot).map(|origin| origin.step));
    let last_before = |end: u32| steps.iter().copied().filter(|&step| step <= end).max();
    if trained {
        let from = last_before(now.snapshot_step).unwrap_or(0);
        return Ok(StageVerdict::SnapshotAgain { from, to: now.snapshot_step });
    }
    if let Some(step) = last_before(u32::MAX).filter(|&step| now.goal < now.end && step >= now.goal) {
        return Ok(StageVerdict::Stands { step });
    }
    Ok(last_before(now.goal).map_or(StageVerdict::Made, |step| StageVerdict::GoesOn { step }))
}
