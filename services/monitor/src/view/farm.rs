//! A farm that is shown, and what only a farm has: workers, a queue and a log.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;

use segwild_farm::{EngineError, FarmLogState, JobEngine, JobState, JobStatus, LEASE_S, WorkerTally};
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
    /// A farm with these jobs, at a time in seconds since 1970. Where the log has a clock of its own, its time counts: what the
    /// jobs and the workers have are times of the log.
    ///
    /// # Errors
    /// When the farm cannot be read.
    pub(super) fn of(engine: &dyn JobEngine, jobs: &[JobStatus], now: f64) -> Result<Self, EngineError> {
        let now = engine.log_time().unwrap_or(now);
        let (mut queue, mut oldest_waiting_s) = (BTreeMap::from([("any".to_owned(), 0)]), 0.0_f64);
        for status in jobs.iter().filter(|s| s.state == JobState::Pending && s.due <= now) {
            let wanted = status.job.accelerator.clone().unwrap_or_else(|| "any".into());
            *queue.entry(wanted).or_default() += 1;
            oldest_waiting_s = oldest_waiting_s.max(now - status.due);
        }
        // How many scenes each worker holds, and when it last renewed one of them.
        let mut held: BTreeMap<&str, (u64, f64)> = BTreeMap::new();
        for status in jobs {
            let Some(worker) = status.worker.as_deref() else { continue };
            let (count, renewed) = held.entry(worker).or_default();
            *count += 1;
            *renewed = renewed.max(status.lease_until.map_or(0.0, |until| until - LEASE_S));
        }
        let tallies = engine.tallies()?;
        let names: BTreeSet<&str> = tallies.keys().map(String::as_str).chain(held.keys().copied()).collect();
        let workers = names.into_iter().map(|name| {
            let (held, renewed) = held.get(name).copied().unwrap_or_default();
            // The log may have forgotten what a worker did that still holds scenes.
            let tally = tallies.get(name);
            let count = |of: fn(&WorkerTally) -> u64| tally.map_or(0, of);
            FarmWorkerView {
                name: name.to_owned(),
                held,
                done: count(|tally| tally.done),
                failed: count(|tally| tally.failed),
                returned: count(|tally| tally.returned),
                silent: count(|tally| tally.silent),
                seen_s: (now - tally.map_or(renewed, |tally| tally.seen)).max(0.0),
            }
        });
        let workers = workers.filter(|worker| worker.held > 0 || worker.seen_s <= SHOWN_S).collect();
        Ok(Self { queue, oldest_waiting_s, workers, log: engine.log_state() })
    }
}
