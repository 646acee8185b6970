//! The parts of a run: its stages, its actors and their workers.

use std::collections::BTreeMap;

use segwild_flow::WorkerState;
use serde::{Deserialize, Serialize};

/// A stage. Units of work are photos, and steps for `geometry`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageView {
    /// Its name.
    pub name: String,
    /// `waiting` (not started), `pending` (interrupted), `running`, `done`, `failed`.
    pub state: String,
    /// The part that the units are of, where the stage has parts with units of their own.
    #[serde(default)]
    pub part: Option<String>,
    /// Units done; those found in the cache and those that failed included.
    pub done: u64,
    /// Units in all, if known.
    pub total: Option<u64>,
    /// Units per second, lately.
    pub rate: f64,
    /// Seconds to go, if that is known.
    pub eta_s: Option<f64>,
    /// Photos that were worked on.
    pub made: u64,
    /// Photos found in the cache.
    pub cached: u64,
    /// Photos that failed for good.
    pub failed: u64,
    /// When it began, in seconds since 1970.
    pub started: Option<f64>,
    /// How long it has taken, in seconds.
    pub wall_s: Option<f64>,
    /// Processor seconds of the process meanwhile.
    pub cpu_s: Option<f64>,
    /// How often it was started.
    pub runs: u32,
    /// Why it failed.
    pub error: Option<String>,
    /// Why it waits, if it does.
    pub why: Option<String>,
}

/// A worker thread.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WorkerView {
    /// What it does.
    pub state: WorkerState,
    /// On what.
    pub item: String,
    /// For how long, in seconds.
    pub for_s: f64,
    /// Whether the supervisor considers it stuck.
    pub stuck: bool,
    /// Why it waits, if it does.
    pub why: Option<String>,
}

/// An actor. Times are wall-clock seconds over all its workers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ActorView {
    /// Its name.
    pub name: String,
    /// `running`, or how it ended: `finished`, `stopped`, `downstream_closed`, `failed`, `late`.
    pub exit: String,
    /// Why it failed.
    pub error: Option<String>,
    /// Its workers.
    pub workers: Vec<WorkerView>,
    /// Messages handled.
    pub messages: u64,
    /// Further attempts at a message.
    pub retries: u64,
    /// How often it was restarted.
    pub restarts: u64,
    /// Messages given up.
    pub quarantined: u64,
    /// The last message given up, and why.
    pub last_error: Option<String>,
    /// Seconds by what they went to: `starting`, `busy`, `waiting`, `blocked`, `back_off`.
    pub seconds: BTreeMap<String, f64>,
    /// Processor seconds of its own threads.
    pub cpu_s: f64,
    /// The share of its life spent working, 0 to 1.
    pub utilization: f64,
}

impl StageView {
    /// The share that is done, 0 to 1.
    pub fn share(&self) -> f64 {
        match (self.state.as_str(), self.total) {
            ("done", _) => 1.0,
            (_, Some(total)) if total > 0 => (self.done as f64 / total as f64).min(1.0),
            _ => 0.0,
        }
    }
}
