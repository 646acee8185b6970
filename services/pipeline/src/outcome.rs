//! What the actors send to the coordinator, in one mailbox.

use segwild_features::FeatureOutcome;
use segwild_flow::Message;
use segwild_masks::MaskOutcome;
use segwild_trainer::TrainOutcome;

/// Whatever an actor has to say.
pub enum Outcome {
    /// The features actor.
    Feature(FeatureOutcome),
    /// The masks actor.
    Mask(MaskOutcome),
    /// The trainer.
    Train(TrainOutcome),
    /// Which pixels of every photo can be trusted is in the cache, but for these photos: which, and why not.
    Visibility(Vec<(usize, String)>),
}

impl Message for Outcome {
    fn label(&self) -> String {
        let words = match self {
            Outcome::Feature(_) => "hears of features",
            Outcome::Mask(_) => "hears of masks",
            Outcome::Train(TrainOutcome::Snapshot(_)) => "keeps the snapshot",
            Outcome::Train(TrainOutcome::Checkpoint(_)) => "keeps a checkpoint",
            Outcome::Train(TrainOutcome::Done(..)) => "keeps the scene",
            Outcome::Train(_) => "hears of the training",
            Outcome::Visibility(_) => "hears of visibility",
        };
        words.into()
    }
}

impl From<FeatureOutcome> for Outcome {
    fn from(outcome: FeatureOutcome) -> Self {
        Outcome::Feature(outcome)
    }
}

impl From<MaskOutcome> for Outcome {
    fn from(outcome: MaskOutcome) -> Self {
        Outcome::Mask(outcome)
    }
}

impl From<TrainOutcome> for Outcome {
    fn from(outcome: TrainOutcome) -> Self {
        Outcome::Train(outcome)
    }
}
