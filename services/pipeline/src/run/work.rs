//! How the coordinator sees a stage that actors compute.

use super::context::RunContext;
use super::need::Extent;
use super::outcome::ActorOutcome;
use super::products::Products;
use crate::RunError;
use segwild_features::FeatureTask;
use segwild_flow::{Sender, System};
use segwild_masks::MaskTask;
use segwild_trainer::TrainOrder;

/// How far a stage is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StageState {
    /// It has not started.
    Waiting,
    /// Its actor works on it.
    Running,
    /// Nothing more comes of it.
    Over,
}

/// The system of a run, and the mailboxes that stages send to.
pub struct Actors<'a> {
    /// Runs the sources.
    pub system: &'a System,
    /// The masks actor.
    pub masks: Sender<MaskTask>,
    /// The features actor.
    pub features: Sender<FeatureTask>,
    /// The trainer.
    pub training: Sender<TrainOrder>,
    /// The coordinator's own mailbox, for sources that report to it.
    pub own: Sender<ActorOutcome>,
}

/// A stage that actors compute: how it starts, and what follows from each outcome.
pub trait ActorStage {
    /// How far it is.
    fn state(&self) -> StageState;

    /// Whether this much of its result is there.
    fn gives(&self, extent: Extent, _made: &Products) -> bool {
        match extent {
            Extent::PerPhoto => self.state() != StageState::Waiting,
            Extent::Part | Extent::Whole => self.state() == StageState::Over,
        }
    }

    /// Starts it: everything that it needs is there. A stage whose result is in the cache is over after this.
    ///
    /// # Errors
    /// When the ledger, the cache or the run folder fails, or the actors are stopping.
    fn start(&mut self, run: &mut RunContext<'_>, actors: &Actors<'_>) -> Result<(), RunError>;

    /// Handles an outcome, or returns it where it belongs to another stage.
    ///
    /// # Errors
    /// When the ledger, the cache or the run folder fails, or a photo has changed.
    fn handle(
        &mut self,
        outcome: ActorOutcome,
        run: &mut RunContext<'_>,
    ) -> Result<Option<ActorOutcome>, RunError>;

    /// Goes on with what depends on outcomes of other stages. It is called after each of them while the stage runs.
    ///
    /// # Errors
    /// As [`ActorStage::start`].
    fn go_on(&mut self, _run: &mut RunContext<'_>, _actors: &Actors<'_>) -> Result<(), RunError> {
        Ok(())
    }

    /// Whether the run waits for its end though it was not requested.
    fn must_end(&self) -> bool {
        false
    }
}
