//! What the stages work with that the thread of the run computes after the actors have ended.

use super::context::RunContext;
use crate::artifacts::traces::Traces;
use crate::output::evaluate::HeldOut;
use crate::{RunFolder, RunOptions};
use segwild_flow::{Key, Ledger, Report};

/// A run whose actors have ended.
pub struct AfterActors<'a, 'f> {
    /// What the stages share.
    pub run: RunContext<'a>,
    /// What the actors did when; the stages add themselves.
    pub report: Report,
    /// Writes it.
    pub traces: Traces<'f>,
    /// Whether photos are held out.
    pub holds_out: bool,
    /// Their scores, from the stage `evaluate` on.
    pub scores: Option<HeldOut>,
}

/// A run whose own data is freed.
pub struct EndOfRun<'a> {
    /// The run folder.
    pub folder: &'a RunFolder,
    /// Its ledger.
    pub ledger: &'a Ledger,
    /// Progress and warnings.
    pub options: &'a RunOptions,
    /// Key of the stage.
    pub key: Key,
    /// What the actors and the stages did when.
    pub report: Report,
    /// Writes it.
    pub traces: Traces<'a>,
}
