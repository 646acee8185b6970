//! What the actors send to the coordinator, in one mailbox.

use segwild_features::FeatureOutcome;
use segwild_flow::Message;
use segwild_masks::MaskOutcome;
use segwild_trainer::TrainOutcome;

/// The outcome of an actor's work.
pub enum ActorOutcome {
    /// The features actor.
    Feature(FeatureOutcome),
    /// The masks actor.
    Mask(MaskOutcome),
    /// The trainer.
    Train(TrainOutcome),
    /// The visibility of every photo is in the cache, except of these views: the view, and the error.
    Visibility(Vec<(usize, String)>),
}

impl Message for ActorOutcome {
    fn label(&self) -> String {
        let words = match self {
            ActorOutcome::Feature(_) => "handles features",
            ActorOutcome::Mask(_) => "handles masks",
            ActorOutcome::Train(TrainOutcome::Snapshot(_)) => "keeps the snapshot",
            ActorOutcome::Train(TrainOutcome::Checkpoint(_)) => "keeps a checkpoint",
            ActorOutcome::Train(TrainOutcome::Done(..)) => "keeps the scene",
            ActorOutcome::Train(_) => "handles the training",
            ActorOutcome::Visibility(_) => "handles visibility",
        };
        words.into()
    }
}

impl From<FeatureOutcome> for ActorOutcome {
    fn from(outcome: FeatureOutcome) -> Self {
        ActorOutcome::Feature(outcome)
    }
}

impl From<MaskOutcome> for ActorOutcome {
    fn from(outcome: MaskOutcome) -> Self {
        ActorOutcome::Mask(outcome)
    }
}

impl From<TrainOutcome> for ActorOutcome {
    fn from(outcome: TrainOutcome) -> Self {
        ActorOutcome::Train(outcome)
    }
}
