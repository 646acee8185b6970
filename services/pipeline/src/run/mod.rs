//! A run: `prepare` opens its inputs, `plan` decides what is to be done, `execute` does it, `finish` reports.
//!
//! The stages stand in `stages/`, a file each; `graph` reads their needs, and the `coordinator` starts what can start.

mod after;
pub(crate) mod choice;
mod context;
pub(crate) mod continued;
mod coordinator;
mod diagnostics;
mod diagram;
mod examine;
mod execute;
mod explain;
mod finish;
mod graph;
mod inputs;
pub(crate) mod memory;
mod need;
mod node;
mod options;
mod outcome;
mod plan;
mod poses;
mod prepare;
mod products;
mod results;
mod situation;
pub(crate) mod skies;
mod speed;
mod stage;
mod stages;
mod tally;
mod time;
mod tree;
mod until;
mod view_slots;
mod wiring;
mod work;

pub use diagram::{DiagramFormat, diagram};
pub use explain::{StagePlan, explain, explain_time};
pub use graph::{needs, stages_of};
pub use memory::MemoryNeed;
pub use need::{Extent, Need};
pub use options::{RunOptions, Summary};
pub use outcome::ActorOutcome;
pub use results::StageVerdict;
pub use stage::Stage;
pub use until::{Until, UntilError};
pub use wiring::{ActorInboxes, ActorParts, ComputingActors, Wiring};

use crate::{RunError, RunFolder, Settings};
use std::path::Path;

/// Runs a scene's stages, or those that are not done yet.
///
/// # Errors
/// When an input cannot be used, a stage fails, the disk fails, or the run is stopped ([`RunError`]).
pub fn run(
    scene: &Path,
    folder: &RunFolder,
    settings: &Settings,
    options: &RunOptions,
) -> Result<Summary, RunError> {
    run_with_actors(scene, folder, settings, options, &ComputingActors)
}

/// As [`run`], with other actors behind the mailboxes: simulated ones, or ones that are watched.
///
/// # Errors
/// As [`run`].
pub fn run_with_actors(
    scene: &Path,
    folder: &RunFolder,
    settings: &Settings,
    options: &RunOptions,
    wiring: &dyn Wiring,
) -> Result<Summary, RunError> {
    let prepared = prepare::prepare(scene, folder, settings, options)?;
    let plan = plan::plan(&prepared, folder, options)?;
    let executed = execute::execute(&prepared, &plan, folder, options, wiring)?;
    finish::finish(prepared, plan, executed, folder, options)
}
