//! The actor of the trainer: one order trains one scene, and its outcomes are sent on as they come.

use crate::imported::{self, ImportedModel};
use crate::preparation_progress::PreparationProgress;
use crate::{Checkpoint, Model, Photos, SeamCheck, TrainError, TrainSettings, Trainer};
use segwild_flow::{Actor, ActorFailure, Context, Message, Quarantined, Sender, fault};
use segwild_nn::Lpips;
use segwild_objective::Engine;
use segwild_scene::{ImportedSplats, Scene, Skipped};
use std::cell::Cell;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Steps between two reports of progress.
const REPORT_EVERY: u32 = 20;
/// Steps or photos of the preparation between two reports.
const PREPARED_EVERY: usize = 10;

/// Finds the checkpoint to go on from, if there is one.
pub type FindCheckpoint = dyn Fn() -> Result<Option<Checkpoint>, ActorFailure> + Send + Sync;

/// Trains a scene.
#[derive(Clone)]
pub struct TrainOrder {
    /// The scene; views not held out are trained on.
    pub scene: Arc<Scene>,
    /// Its photos; a call may wait for the photo's sky.
    pub photos: Arc<dyn Photos>,
    /// How to train.
    pub settings: TrainSettings,
    /// The perceptual distance, for a loss that has it.
    pub lpips: Option<Arc<Lpips>>,
    /// The step to stop after: fewer than `settings.steps` leaves the training to be continued, more goes on past
    /// the end of the schedules at their last rates.
    pub until: u32,
    /// Finds the checkpoint that an interrupted training continues from. Called at each attempt, so that one after a panic
    /// continues from the last checkpoint of the attempt before.
    pub checkpoint: Arc<FindCheckpoint>,
    /// Time between checkpoints.
    pub checkpoint_every: Duration,
}

impl Message for TrainOrder {
    fn label(&self) -> String {
        format!("{} steps", self.until)
    }

    fn again(&self) -> Option<Self> {
        Some(self.clone())
    }
}

/// What the trainer sends to its consumer.
#[derive(Clone)]
pub enum TrainOutcome {
    /// At the start, and again where it starts again after a panic.
    Began {
        /// The step it goes on from; 0 without a checkpoint.
        step: u32,
        /// The photos in the order of the coming steps, each at least once.
        upcoming: Vec<usize>,
    },
    /// How far what comes before the first step is, every few of its units.
    Preparing(PreparationProgress),
    /// Means of the last steps, every few steps.
    Progress {
        /// Steps done.
        step: u32,
        /// Mean loss since the last report.
        loss: f32,
        /// Mean PSNR of the photos' counted pixels since the last report, in dB.
        psnr: f32,
        /// Splats.
        splats: usize,
        /// Mean share of the photos left out as transient.
        left_out: f32,
    },
    /// The scene at the snapshot step, for the mask stage.
    Snapshot(Arc<Model>),
    /// Where to continue from.
    Checkpoint(Arc<Checkpoint>),
    /// How well the photos are shown at the seams of the blocks, before [`TrainOutcome::Done`] of a scene that has
    /// several.
    Seams(SeamCheck),
    /// The requested step is reached, and the training is not over; its checkpoint was sent before.
    Paused(u32),
    /// The trained scene, and photos that turned out not to be usable.
    Done(Arc<Model>, Vec<Skipped>),
    /// Training cannot go on.
    Failed(String),
}

/// The actor. `O` is what its consumer calls its outcomes.
pub struct TrainActor<O: Message> {
    /// The rasteriser.
    pub engine: Arc<dyn Engine>,
    /// Where outcomes go.
    pub out: Sender<O>,
}

impl<O: Message + From<TrainOutcome>> TrainActor<O> {
    fn send(&self, outcome: TrainOutcome) -> Result<(), ActorFailure> {
        self.out.blocking_send(outcome.into())?;
        Ok(())
    }

    /// Takes imported splats in place of a training. It is short: it is done whole, or again.
    fn import(
        &self,
        order: &TrainOrder,
        imported: &ImportedSplats,
        context: &Context,
    ) -> Result<(), ActorFailure> {
        let TrainOrder { scene, photos, settings, .. } = order;
        let file = &imported.file;
        let what = format!("{}: {}", file.path.display(), file.in_words());
        context.events().info(Some("geometry"), what);
        let upcoming = (0..scene.views.len()).filter(|&view| !scene.views[view].test).collect();
        self.send(TrainOutcome::Began { step: 0, upcoming })?;
        let alive = || {
            context.progress();
            if context.stopping() { Err(TrainError::Stopped) } else { Ok(()) }
        };
        let mut failed = None;
        let mut on_photo = |step: u32, psnr: f32| {
            let (loss, left_out, splats) = (0.0, 0.0, file.splats);
            let sent = self.send(TrainOutcome::Progress { step, loss, psnr, splats, left_out });
            sent.map_err(|failure| {
                failed = Some(failure);
                TrainError::Stopped
            })
        };
        let fitted =
            imported::fit(&*self.engine, scene, imported, photos.clone(), settings, &alive, &mut on_photo);
        let ImportedModel { model, skipped, notes } = match (fitted, failed) {
            (_, Some(failure)) => return Err(failure),
            (Err(TrainError::Stopped), _) => return Err(ActorFailure::stopped()),
            (fitted, None) => fitted.map_err(ActorFailure::fatal)?,
        };
        for note in notes {
            context.events().info(Some("geometry"), note);
        }
        let model = Arc::new(model);
        self.send(TrainOutcome::Snapshot(model.clone()))?;
        self.send(TrainOutcome::Done(model, skipped))
    }

    fn train(&self, order: &TrainOrder, context: &Context) -> Result<(), ActorFailure> {
        if let Some(imported) = &order.scene.imported {
            return self.import(order, imported, context);
        }
        let (engine, scene, photos) = (self.engine.clone(), &*order.scene, order.photos.clone());
        let stopping = || {
            context.progress();
            context.stopping()
        };
        let reported = Cell::new(None);
        let follow = |now: PreparationProgress| {
            let due = (now.part, now.done / PREPARED_EVERY);
            // A consumer that is gone ends the work by itself.
            let sent =
                reported.replace(Some(due)) == Some(due) || self.send(TrainOutcome::Preparing(now)).is_ok();
            stopping() || !sent
        };
        // What comes before the first step counts: it may take longer than all that is lost between two checkpoints.
        let mut saved = Instant::now();
        let started = match (order.checkpoint)()? {
            Some(checkpoint) => Trainer::resume_unless(engine, scene, photos, checkpoint, &stopping),
            None => Trainer::prepared(engine, scene, photos, order.settings.clone(), &follow),
        };
        let mut trainer = started.map_err(|e| match e {
            TrainError::Stopped => ActorFailure::stopped(),
            e => ActorFailure::fatal(e),
        })?;
        trainer.hold_photos(order.settings.photo_cache_mib);
        trainer.set_lpips(order.lpips.clone());
        for warning in trainer.warnings().iter().cloned().chain(trainer.unreached_in_words(order.until)) {
            context.events().warn(Some("geometry"), warning);
        }
        if let Some(share) = trainer.initial_transient_share() {
            let photos = trainer.robust_shares().iter().filter(|&&share| share > 0.0).count();
            let then = match photos {
                0 => "they show no transients, and nothing is left out".to_owned(),
                n if n < trainer.robust_shares().len() => format!("{n} photos may show transients"),
                _ => "they may show transients, which are left out".to_owned(),
            };
            let share = 100.0 * share;
            let message =
                format!("{share:.1} % of the photos' pixels contradict trainings made without them: {then}");
            context.events().info(Some("geometry"), message);
        }
        for words in trainer.poses_by_points_in_words() {
            context.events().info(Some("geometry"), words);
        }
        let stereo_points = trainer.stereo_count();
        if stereo_points > 0 {
            let message = format!(
                "{stereo_points} points that photos agree on start splats between those of the reconstruction"
            );
            context.events().info(Some("geometry"), message);
        }
        self.send(TrainOutcome::Began { step: trainer.steps_done(), upcoming: trainer.upcoming() })?;
        while trainer.steps_done() < order.until {
            if context.stopping() {
                self.send(TrainOutcome::Checkpoint(Arc::new(
                    trainer.checkpoint().map_err(ActorFailure::fatal)?,
                )))?;
                return Err(ActorFailure::stopped());
            }
            let step = trainer.step().map_err(ActorFailure::fatal)?;
            context.progress();
            fault::point("trainer.step")?;
            let last = step.step >= order.until;
            if step.step % REPORT_EVERY == 0 || last {
                let [loss, psnr, left_out] = trainer.means();
                let (step, splats) = (step.step, step.splats);
                self.send(TrainOutcome::Progress { step, loss, psnr, splats, left_out })?;
            }
            if step.step == order.settings.snapshot_step() {
                self.send(TrainOutcome::Snapshot(Arc::new(
                    trainer.snapshot().map_err(ActorFailure::fatal)?,
                )))?;
            }
            // With a report, so that a continued training reports over the same steps as one that never stopped. The
            // last checkpoint allows continued training later, with more steps.
            if last || step.step % REPORT_EVERY == 0 && saved.elapsed() >= order.checkpoint_every {
                self.send(TrainOutcome::Checkpoint(Arc::new(
                    trainer.checkpoint().map_err(ActorFailure::fatal)?,
                )))?;
                saved = Instant::now();
            }
        }
        if !trainer.is_done() {
            return self.send(TrainOutcome::Paused(trainer.steps_done()));
        }
        for words in trainer.aligned_poses_in_words() {
            context.events().info(Some("geometry"), words);
        }
        match trainer.seam_check(&stopping) {
            Ok(None) => {}
            Ok(Some(seams)) => {
                match seams.stands_out() {
                    true => context.events().warn(Some("geometry"), seams.in_words()),
                    false => context.events().info(Some("geometry"), seams.in_words()),
                }
                self.send(TrainOutcome::Seams(seams))?;
            }
            Err(TrainError::Stopped) => return Err(ActorFailure::stopped()),
            // The scene is trained, and is worth more than the check.
            Err(error) => {
                let words = format!("the seams of the blocks are not checked: {error}");
                context.events().warn(Some("geometry"), words);
            }
        }
        let skipped = trainer.skipped();
        let model = trainer.finish().map_err(ActorFailure::fatal)?;
        self.send(TrainOutcome::Done(Arc::new(model), skipped))
    }
}

impl<O: Message + From<TrainOutcome>> Actor for TrainActor<O> {
    type Message = TrainOrder;

    fn handle(&mut self, order: TrainOrder, context: &Context) -> Result<(), ActorFailure> {
        let done = self.train(&order, context);
        if let Err(failure) = &done
            && !(failure.is_local() || failure.is_storage() || context.stopping())
        {
            self.send(TrainOutcome::Failed(failure.to_string()))?;
        }
        done
    }

    /// Called when no further attempt follows.
    fn on_quarantine(
        &mut self,
        _: Option<TrainOrder>,
        given_up: &Quarantined,
        context: &Context,
    ) -> Result<(), ActorFailure> {
        if context.stopping() {
            return Ok(());
        }
        self.send(TrainOutcome::Failed(given_up.error.clone()))
    }
}
