//! A farm that is shown, and what only a farm has: workers, a queue, a past and a log.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::{Arc, Mutex};

use segwild_farm::{
    ANNOUNCE_EVERY, ChangeKind, EngineError, FarmLogState, JobChange, JobEngine, JobState, JobStatus,
    LEASE_S, Needs, WorkerTally,
};
use segwild_flow::lock;
use serde::{Deserialize, Serialize};

/// A worker that holds nothing and was not seen for so long is not shown, in seconds.
const SHOWN_S: f64 = 3600.0;

/// Rates are over so many seconds.
const RATE_S: f64 = 3600.0;

/// Points of the past that a view carries.
const PAST: u64 = 48;

/// Lengths of these points, in seconds: the shortest with which they cover what the log remembers.
const LENGTHS_S: [f64; 4] = [60.0, 300.0, 900.0, 3600.0];

/// Changes that views are made of at most: the newest ones.
const MOST_CHANGES: usize = 20_000;

/// A farm that is shown.
#[derive(Clone)]
pub struct FarmTarget {
    /// Its address, for people.
    pub name: String,
    /// Its jobs.
    pub engine: Arc<dyn JobEngine>,
    changes: Arc<Mutex<SeenChanges>>,
}

impl FarmTarget {
    /// A farm under its address, for people.
    pub fn new(name: impl Into<String>, engine: Arc<dyn JobEngine>) -> Self {
        Self { name: name.into(), engine, changes: Arc::default() }
    }
}

impl fmt::Debug for FarmTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FarmTarget({})", self.name)
    }
}

/// The changes that the views before were made of, oldest first: a view reads only those that came since.
#[derive(Default)]
struct SeenChanges(Vec<JobChange>);

impl SeenChanges {
    /// Reads on, and returns all.
    fn read_on(&mut self, engine: &dyn JobEngine) -> Result<&[JobChange], EngineError> {
        // The last one is read again: a log in which it is another one, or gone, is read as a whole.
        let after = self.0.last().map_or(0, |last| last.revision.saturating_sub(1));
        let mut read = engine.watch(after, usize::MAX)?;
        if self.0.last().is_some_and(|last| read.first() != Some(last)) {
            self.0.clear();
            read = engine.watch(0, usize::MAX)?;
        }
        self.0.pop();
        self.0.append(&mut read);
        let surplus = self.0.len().saturating_sub(MOST_CHANGES);
        self.0.drain(..surplus);
        Ok(&self.0)
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
    /// Scenes done per hour: over the last hour, or since the first change that the log remembers.
    #[serde(default)]
    pub done_per_hour: f64,
    /// Seconds that the open scenes take at this rate; `None` where none is open, or none was done lately.
    #[serde(default)]
    pub left_s: Option<f64>,
    /// What came of attempts over time, oldest first, as far as the log remembers it.
    #[serde(default)]
    pub past: Vec<FarmSample>,
}

/// What came of a farm's attempts in a stretch of time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FarmSample {
    /// When it starts, in seconds since 1970.
    pub time: f64,
    /// How long it is, in seconds. The last one is not over.
    pub seconds: f64,
    /// Scenes that were done.
    pub done: u64,
    /// Attempts that failed and are followed by another one.
    pub retried: u64,
    /// Scenes that were given up.
    pub dead: u64,
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
    /// Why it takes no scenes for now; absent where it takes them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused: Option<String>,
    /// Time since its last sign of life, in seconds: it renews leases every 20 s, and announces itself every 60 s while it holds
    /// nothing.
    pub seen_s: f64,
    /// What it has in all; `None` where it did not say so.
    #[serde(default)]
    pub whole: Option<Needs>,
    /// What the scenes that it holds need. It may give the last ones more, where nobody waits.
    #[serde(default)]
    pub used: Needs,
    /// What accelerator it has, by name.
    #[serde(default)]
    pub accelerator: Option<String>,
    /// Scenes that it has done per hour, as of the farm.
    #[serde(default)]
    pub done_per_hour: f64,
}

impl FarmWorkerView {
    /// Whether it holds scenes, or has lately given a sign of life.
    pub fn is_there(&self) -> bool {
        self.held > 0 || self.seen_s <= 2.0 * ANNOUNCE_EVERY.as_secs_f64()
    }
}

impl FarmView {
    /// A farm with these jobs, at a time in seconds since 1970. Where the log has a clock of its own, its time counts: what the
    /// jobs and the workers have are times of the log.
    ///
    /// # Errors
    /// When the farm cannot be read.
    pub(super) fn of(farm: &FarmTarget, jobs: &[JobStatus], now: f64) -> Result<Self, EngineError> {
        let engine = farm.engine.as_ref();
        let now = engine.log_time().unwrap_or(now);
        let (mut queue, mut oldest_waiting_s) = (BTreeMap::from([("any".to_owned(), 0)]), 0.0_f64);
        for status in jobs.iter().filter(|s| s.state == JobState::Pending && s.due <= now) {
            let wanted = status.job.accelerator.clone().unwrap_or_else(|| "any".into());
            *queue.entry(wanted).or_default() += 1;
            oldest_waiting_s = oldest_waiting_s.max(now - status.due);
        }
        // How many scenes each worker holds, what they need, and when it last renewed one of them.
        let mut held: BTreeMap<&str, (u64, Needs, f64)> = BTreeMap::new();
        for status in jobs {
            let Some(worker) = status.worker.as_deref() else { continue };
            let (count, used, renewed) = held.entry(worker).or_default();
            *count += 1;
            *used = used.with(&status.job.needs);
            *renewed = renewed.max(status.lease_until.map_or(0.0, |until| until - LEASE_S));
        }
        let tallies = engine.tallies()?;
        let mut seen = lock(&farm.changes);
        let changes = seen.read_on(engine)?;
        let rates = FarmRates::of(changes, now);
        let names: BTreeSet<&str> = tallies.keys().map(String::as_str).chain(held.keys().copied()).collect();
        let workers = names.into_iter().map(|name| {
            let (held, used, renewed) = held.get(name).copied().unwrap_or_default();
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
                paused: tally.and_then(|tally| tally.paused.clone()),
                seen_s: (now - tally.map_or(renewed, |tally| tally.seen)).max(0.0),
                whole: tally.and_then(|tally| tally.whole),
                used,
                accelerator: tally.and_then(|tally| tally.accelerator.clone()),
                done_per_hour: rates.of_worker(name),
            }
        });
        let workers = workers.filter(|worker| worker.held > 0 || worker.seen_s <= SHOWN_S).collect();
        let open = jobs.iter().filter(|s| matches!(s.state, JobState::Pending | JobState::Leased)).count();
        let done_per_hour = rates.of_all();
        let left_s = (open > 0 && done_per_hour > 0.0).then(|| open as f64 / done_per_hour * 3600.0);
        let (log, past) = (engine.log_state(), past(changes, now));
        Ok(Self { queue, oldest_waiting_s, workers, log, done_per_hour, left_s, past })
    }

    /// What the workers that are there have together, as far as they say so.
    pub(super) fn whole(&self) -> Needs {
        let there = self.workers.iter().filter(|worker| worker.is_there());
        there.filter_map(|worker| worker.whole).fold(Needs::default(), |all, own| all.with(&own))
    }
}

/// How many scenes were done lately, by whom.
struct FarmRates<'a> {
    /// Over how many hours.
    hours: f64,
    done: BTreeMap<&'a str, u64>,
}

impl<'a> FarmRates<'a> {
    /// Of the changes that a log remembers, oldest first, at a time.
    fn of(changes: &'a [JobChange], now: f64) -> Self {
        let since = changes.first().map_or(now, |first| first.time).max(now - RATE_S);
        let (mut takers, mut done): (BTreeMap<&str, &str>, BTreeMap<&str, u64>) = Default::default();
        for change in changes {
            match change.kind {
                ChangeKind::Claimed => drop(takers.insert(change.job.as_str(), change.detail.as_str())),
                ChangeKind::Completed if change.time >= since => {
                    // The log may have forgotten who took it.
                    let taker = takers.get(change.job.as_str()).copied().unwrap_or_default();
                    *done.entry(taker).or_default() += 1;
                }
                _ => {}
            }
        }
        // The first minute makes no rate.
        Self { hours: (now - since).max(60.0) / 3600.0, done }
    }

    fn of_worker(&self, name: &str) -> f64 {
        self.done.get(name).copied().unwrap_or_default() as f64 / self.hours
    }

    fn of_all(&self) -> f64 {
        self.done.values().sum::<u64>() as f64 / self.hours
    }
}

/// What came of attempts over time, by the changes that a log remembers.
fn past(changes: &[JobChange], now: f64) -> Vec<FarmSample> {
    let Some(first) = changes.first().map(|first| first.time).filter(|first| *first <= now) else {
        return Vec::new();
    };
    let covers = |length: &f64| now - first <= length * (PAST - 1) as f64;
    let seconds = LENGTHS_S.into_iter().find(covers).unwrap_or(LENGTHS_S[LENGTHS_S.len() - 1]);
    let number = |time: f64| (time / seconds).floor().max(0.0) as u64;
    let last = number(now);
    let start = number(first).max(last.saturating_sub(PAST - 1));
    let sample = |k: u64| FarmSample { time: k as f64 * seconds, seconds, ..FarmSample::default() };
    let mut samples: Vec<FarmSample> = (start..=last).map(sample).collect();
    for change in changes {
        let at = number(change.time).checked_sub(start).and_then(|k| samples.get_mut(k as usize));
        let Some(sample) = at else { continue };
        match change.kind {
            ChangeKind::Completed => sample.done += 1,
            ChangeKind::Retried => sample.retried += 1,
            ChangeKind::Died => sample.dead += 1,
            _ => {}
        }
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;

    fn change(time: f64, job: &str, kind: ChangeKind, detail: &str) -> JobChange {
        JobChange { revision: 0, time, job: job.into(), kind, attempt: 1, detail: detail.into() }
    }

    #[test]
    fn a_view_reads_what_came_since_the_last_one_and_another_log_as_a_whole() {
        use segwild_farm::{EmbeddedEngine, Job};
        let dir = tempfile::tempdir().expect("a temporary folder");
        let engine = |name: &str| EmbeddedEngine::open(dir.path().join(name)).expect("an engine");
        let publish = |engine: &EmbeddedEngine, names: &[&str]| {
            for name in names {
                engine.publish(&Job::new(*name, "{}", Needs::default())).expect("it is published");
            }
        };
        let (first, mut seen) = (engine("first.sqlite"), SeenChanges::default());
        let named = |changes: &[JobChange]| changes.iter().map(|c| c.job.clone()).collect::<Vec<_>>();
        assert!(seen.read_on(&first).expect("it answers").is_empty());
        for names in [&["a", "b"][..], &[], &["c"]] {
            publish(&first, names);
            let all = first.watch(0, usize::MAX).expect("it answers");
            assert_eq!(seen.read_on(&first).expect("it answers"), all);
        }
        assert_eq!(named(&seen.0), ["a", "b", "c"]);
        let other = engine("other.sqlite");
        publish(&other, &["d"]);
        assert_eq!(named(seen.read_on(&other).expect("it answers")), ["d"], "a shorter log");
        publish(&other, &["e", "f", "g"]);
        assert_eq!(named(seen.read_on(&other).expect("it answers")), ["d", "e", "f", "g"]);
        assert_eq!(named(seen.read_on(&first).expect("it answers")), ["a", "b", "c"]);
    }

    #[test]
    fn rates_are_of_the_last_hour_and_the_past_covers_what_the_log_remembers() {
        use ChangeKind::{Claimed, Completed, Died, Retried};
        let changes = [
            change(1000.0, "old", Claimed, "first"),
            change(1100.0, "old", Completed, ""),
            change(5000.0, "a", Claimed, "first"),
            change(5100.0, "a", Retried, "again"),
            change(5200.0, "a", Claimed, "second"),
            change(5300.0, "a", Completed, ""),
            change(5400.0, "b", Claimed, "second"),
            change(5500.0, "b", Died, "bad input"),
            change(5600.0, "c", Completed, ""),
        ];
        let rates = FarmRates::of(&changes, 6000.0);
        assert_eq!((rates.of_worker("first"), rates.of_worker("second"), rates.of_all()), (0.0, 1.0, 2.0));
        let samples = past(&changes, 6000.0);
        assert_eq!((samples[0].time, samples[0].seconds, samples.len()), (900.0, 300.0, 18));
        let all = samples.iter().fold((0, 0, 0), |(d, r, g), s| (d + s.done, r + s.retried, g + s.dead));
        assert_eq!((all, samples[0].done), ((3, 1, 1), 1));
        // What is older than the longest past is left out, and a log without a change has none.
        let late = past(&changes, 500_000.0);
        assert_eq!((late.len(), late[0].seconds, late[0].done), (48, 3600.0, 0));
        assert!(past(&[], 6000.0).is_empty() && past(&changes, 10.0).is_empty());
        // In its first minutes a farm has no rate of thousands.
        assert_eq!(FarmRates::of(&changes[5..6], 5301.0).of_all(), 60.0);
    }
}
