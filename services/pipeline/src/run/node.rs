//! What the graph of a run is made of: the node of a stage says who computes it, what it needs, and how it is done.

use super::after::{AfterActors, EndOfRun};
use super::need::Need;
use super::results::StageResults;
use super::stage::Stage;
use super::work::ActorStage;
use crate::RunError;
use crate::artifacts::keys::Keys;
use segwild_flow::Key;

/// Who computes a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Performer {
    /// The actor of this name.
    Actor(&'static str),
    /// A source of the stage's name, on a thread of its own.
    Source,
    /// Programs of others, before the actors start.
    Programs,
    /// The thread of the run, after the actors have ended.
    Run,
}

/// A source: it only sends, to the actor of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Feed {
    /// Its name among the actors.
    pub source: &'static str,
    /// What it sends; `*` stands for one message per photo.
    pub sends: &'static str,
}

/// How a stage is done.
#[derive(Clone, Copy)]
pub enum StageWork {
    /// While the run is prepared.
    Before,
    /// By actors: the coordinator starts it and handles their outcomes.
    Actors(fn() -> Box<dyn ActorStage>),
    /// On the thread of the run, after the actors have ended.
    Run(fn(&mut AfterActors<'_, '_>) -> Result<(), RunError>),
    /// From the run folder alone, after the run's own data is freed.
    End(fn(&mut EndOfRun<'_>) -> Result<(), RunError>),
}

/// A stage in the graph of a run.
#[derive(Clone, Copy)]
pub struct StageNode {
    /// The stage.
    pub stage: Stage,
    /// Who computes it.
    pub by: Performer,
    /// The source that sends to its actor, if one does.
    pub feed: Option<Feed>,
    /// What it needs before it may start.
    pub needs: &'static [Need],
    /// Where its results are kept.
    pub results: StageResults,
    /// How it is done.
    pub work: StageWork,
}

impl StageNode {
    /// The key of the stage in the ledger.
    pub fn key(&self, keys: &Keys) -> Key {
        self.results.key(keys)
    }

    /// Whether the actor or source of this name works on it.
    pub fn is_work_of(&self, name: &str) -> bool {
        match self.by {
            Performer::Actor(actor) => actor == name || self.feed.is_some_and(|feed| feed.source == name),
            Performer::Source => self.stage.name() == name,
            Performer::Programs | Performer::Run => false,
        }
    }
}
