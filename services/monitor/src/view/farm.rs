//! A farm that is shown, and what only a farm has: workers, a queue and a log.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use segwild_farm::{EngineError, FarmLogState, JobEngine, JobState, JobStatus};
use serde::{Deserialize, Serialize};

/// A worker that holds nothing and was not seen for so long is not shown, in seconds.
const SHOWN_S: f64 = 3600.0;

/// A farm that is shown.
#[derive(Clone)]
pub struct FarmTarget {
    /// Its address, for people.
    pub name: String,
    /// Its jobs.
    pub engine: Arc<dyn JobEngine>,
}

impl fmt::Debug for FarmTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FarmTarget({})", self.name)
    }
}

/// What only a farm has.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FarmView {
    /// How many scenes could start now, by the accelerator that they want; `any` is for those that want none by name.
    pub queue: BTreeMap<String, u64>,
    /// For how long the one that has waited longest could have started, in seconds.
    pub oldest_waiting_s: f64,
    /// The workers that hold scenes, or did something in the last hour, by name.
    pub workers: Vec<FarmWorkerView>,
    /// The log, where the engine keeps one.
    pub log: Option<FarmLogState>,
}

/// A worker of a farm, by what the log says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FarmWorkerView {
    /// Its name.
    pub name: String,
    /// Scenes that it holds.
    pub held: u64,
    /// Attempts that ended in a result.
    pub done: u64,
    /// Attempts that failed.
    pub failed: u64,
    /// Scenes that were handed back as they were.
    pub returned: u64,
    /// Scenes that it fell silent with.
    pub silent: u64,
    /// Time since its last sign of life, in seconds. One that holds nothing gives none.
    pub seen_s: f64,
}

impl FarmView {
    /// A farm with these jobs, at a time in seconds since 1970.
    ///
    /// # Errors
    /// When the farm cannot be read.
    pub(super) fn of(engine: &dyn JobEngine, jobs: &[JobStatus], now: f64) -> Result<Self, EngineError> {
        let (mut queue, mut oldest_waiting_s) = (BTreeMap::from([("any".to_owned(), 0)]), 0.0_f64);
        for status in jobs.iter().filter(|s| s.state == JobState::Pending && s.due <= now) {
            let wanted = status.job.accelerator.clone().unwrap_or_else(|| "any".into());
            *queue.entry(wanted).or_default() += 1;
            oldest_waiting_s = oldest_waiting_s.max(now - status.due);
        }
        let mut held: BTreeMap<&str, u64> = BTreeMap::new();
        for worker in jobs.iter().filter_map(|status| status.worker.as_deref()) {
            *held.entry(worker).or_default() += 1;
        }
        let workers = engine.tallies()?.into_iter().map(|(name, tally)| FarmWorkerView {
            held: held.get(name.as_str()).copied().unwrap_or_default(),
            name,
            done: tally.done,
            failed: tally.failed,
            returned: tally.returned,
            silent: tally.silent,
            seen_s: (now - tally.seen).max(0.0),
        });
        let workers = workers.filter(|worker| worker.held > 0 || worker.seen_s <= SHOWN_S).collect();
        Ok(Self { queue, oldest_waiting_s, workers, log: engine.log_state() })
    }
}
