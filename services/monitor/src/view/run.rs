//! One run.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use segwild_flow::ledger::{
    EventRow, LiveMailbox, LiveSample, LiveWorker, PastSample, StageRow, State, ViewCounts,
};
use segwild_flow::{CacheCounters, Ledger};
use segwild_pipeline::{RunFolder, Stage};
use serde::{Deserialize, Serialize};

use super::Disk;
use super::folder::{ViewError, name_of, open_run};
use super::stage::{ActorView, StageView, WorkerView};
use super::why;

/// A sample older than this, in seconds, says that a run which should be watched is not.
pub const STALE_S: f64 = 15.0;

/// Points of the past that a view carries.
const PAST: usize = 120;
/// Warnings and errors that a view carries.
const EVENTS: usize = 8;

/// How a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RunState {
    /// A process works on it.
    Running,
    /// Every requested stage is done.
    Done,
    /// A stage failed.
    Failed,
    /// No process works on it, and there is work left: the same command goes on.
    Stopped,
}

impl RunState {
    /// As a word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Stopped => "stopped",
        }
    }
}

/// A mailbox.
pub type MailboxView = LiveMailbox;

/// A run, as it is or as it was left.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunView {
    /// Its name: the folder's.
    pub name: String,
    /// Its folder.
    pub folder: PathBuf,
    /// When it was read, in seconds since 1970.
    pub time: f64,
    /// How it is.
    pub state: RunState,
    /// Whether a process works on it.
    pub running: bool,
    /// Which one.
    pub owner: Option<String>,
    /// How old the live part is, in seconds; `None` if the run was never watched.
    pub age_s: Option<f64>,
    /// Seconds since anything last moved, while it runs.
    pub still_s: Option<f64>,
    /// When the process began with it, in seconds since 1970.
    pub began: Option<f64>,
    /// Seconds that the stages that run still take, if that is known; stages to come are not counted.
    pub left_s: Option<f64>,
    /// The process that works, or worked last, on it.
    pub pid: Option<u32>,
    /// Its memory in bytes.
    pub rss_bytes: Option<u64>,
    /// The most it ever had.
    pub peak_rss_bytes: Option<u64>,
    /// Its threads.
    pub threads: Option<u64>,
    /// The cores that it may use (`--threads`); `None`: all.
    #[serde(default)]
    pub cores: Option<u32>,
    /// Its processor seconds.
    pub cpu_s: Option<f64>,
    /// The stages, in the order in which they end.
    pub stages: Vec<StageView>,
    /// The actors.
    pub actors: Vec<ActorView>,
    /// The mailboxes.
    pub mailboxes: Vec<MailboxView>,
    /// What the cache did for this process.
    pub cache: CacheCounters,
    /// Measured numbers by stage and name: `geometry.psnr_db`.
    pub numbers: BTreeMap<String, f64>,
    /// Training steps done.
    pub step: Option<u64>,
    /// When the last checkpoint was taken, in seconds since 1970.
    pub checkpoint: Option<f64>,
    /// The disk under the folder.
    pub disk: Option<Disk>,
    /// Photos that failed for good.
    pub failures: Vec<PhotoFailure>,
    /// Selections made.
    pub selections: Vec<SelectionView>,
    /// The last warnings and errors, oldest first.
    pub events: Vec<LoggedEvent>,
    /// The run's past, oldest first.
    pub past: Vec<PastSample>,
    /// Seconds that photos took, by stage.
    #[serde(skip)]
    pub seconds: Vec<(String, f64)>,
}

/// A selection that was made in the run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SelectionView {
    /// Its name.
    pub name: String,
    /// Seconds from the prompts to the splats.
    pub answered_s: Option<f64>,
}

/// A photo that a stage gave up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoFailure {
    /// The stage.
    pub stage: String,
    /// The photo.
    pub photo: String,
    /// Why.
    pub error: String,
}

/// A warning or an error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LoggedEvent {
    /// Seconds since 1970.
    pub time: f64,
    /// `warning` or `error`.
    pub level: String,
    /// The stage or actor it is about.
    pub stage: Option<String>,
    /// In words, or the event as JSON.
    pub message: String,
}

impl RunView {
    /// Reads a run's folder as it is at a time.
    ///
    /// # Errors
    /// When its ledger cannot be read.
    pub fn read(path: &Path, now: f64) -> Result<RunView, ViewError> {
        let folder = open_run(path)?;
        let ledger = Ledger::open_read_only(folder.ledger())?;
        // The owner is checked first: a run that ends in between is then seen as ending, never as dead.
        let owner = ledger.owner().map(|o| o.to_string());
        let live = ledger.live()?;
        let rows = ledger.stages()?;
        let counts = ledger.view_counts()?;
        let recorded = ledger.last_events(200)?;
        let mut failures = Vec::new();
        for stage in counts.iter().filter(|c| c.failed > 0).map(|c| c.stage.clone()) {
            for row in ledger.views(&stage)? {
                if let (State::Failed, error) = (row.outcome.state, row.outcome.error) {
                    let error = error.unwrap_or_default();
                    failures.push(PhotoFailure { stage: stage.clone(), photo: row.view, error });
                }
            }
        }
        let running = owner.is_some();
        let sample = live.clone().unwrap_or_default();
        let clock = if running { now } else { sample.time };
        let mut stages = stages(&rows, &sample, &counts, clock, running);
        why::stages(&mut stages, running);
        let mailboxes = sample.mailboxes.clone();
        let mut actors = actors(&sample, clock);
        why::actors(&mut actors, &mailboxes, &stages, running);
        let state = match () {
            () if running => RunState::Running,
            () if rows.iter().any(|s| s.state == State::Failed) => RunState::Failed,
            () if !rows.is_empty() && rows.iter().all(|s| s.state == State::Done) => RunState::Done,
            () => RunState::Stopped,
        };
        let whole = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        Ok(RunView {
            name: name_of(&whole),
            time: now,
            state,
            running,
            owner,
            age_s: live.as_ref().map(|l| (now - l.time).max(0.0)),
            still_s: live.as_ref().filter(|_| running).map(|l| (now - l.moved).max(0.0)),
            began: live.as_ref().map(|l| l.began),
            left_s: if running { left(&stages) } else { None },
            pid: live.as_ref().map(|l| l.pid),
            rss_bytes: sample.rss_bytes.filter(|_| running),
            peak_rss_bytes: sample.peak_rss_bytes,
            threads: sample.threads.filter(|_| running),
            cores: cores(&ledger.settings()?),
            cpu_s: sample.cpu_s,
            actors,
            mailboxes,
            cache: sample.cache,
            numbers: sample.metrics.iter().map(|m| (format!("{}.{}", m.stage, m.name), m.value)).collect(),
            step: sample.metrics.iter().filter(|m| m.stage == "geometry").filter_map(|m| m.step).max(),
            checkpoint: ledger.last_checkpoint()?.map(|(time, _)| time),
            disk: Disk::of(&whole),
            failures,
            selections: selections(&folder),
            events: events(recorded),
            past: ledger.past(PAST)?,
            seconds: ledger.view_seconds()?,
            stages,
            folder: whole,
        })
    }

    /// The same view, of a run in which nothing has changed since, at a later time.
    pub(super) fn later(&self, now: f64) -> RunView {
        let age_s = self.age_s.map(|age| (age + now - self.time).max(0.0));
        RunView { time: now, age_s, ..self.clone() }
    }

    /// Whether the live part is too old for a run that is being worked on.
    pub fn is_stale(&self) -> bool {
        self.running && self.age_s.is_none_or(|age| age > STALE_S)
    }

    /// Photos per second and steps per second, over the stages that run.
    pub fn rates(&self) -> (f64, f64) {
        let rate = |steps: bool| {
            let stages =
                self.stages.iter().filter(|s| s.state == "running" && (s.name == "geometry") == steps);
            // Adding up from 0: the empty sum of floats is -0.
            stages.map(|s| s.rate).fold(0.0, |sum, rate| sum + rate)
        };
        (rate(false), rate(true))
    }

    /// The share of the work that is done, stages weighing the same, 0 to 1.
    pub fn share(&self) -> f64 {
        if self.stages.is_empty() {
            return 0.0;
        }
        let sum: f64 = self.stages.iter().map(StageView::share).sum();
        sum / self.stages.len() as f64
    }

    /// The stuck workers, as `(actor, item, seconds)`.
    pub fn stuck(&self) -> impl Iterator<Item = (&str, &str, f64)> {
        self.actors.iter().filter(|_| self.running).flat_map(|a| {
            a.workers.iter().filter(|w| w.stuck).map(|w| (a.name.as_str(), w.item.as_str(), w.for_s))
        })
    }
}

/// The selections in a run's folder: made by processes of their own, of which the ledger knows nothing.
pub(super) fn selections(folder: &RunFolder) -> Vec<SelectionView> {
    let view = |name: String| SelectionView { answered_s: folder.answered_in(&name), name };
    folder.selections().into_iter().map(view).collect()
}

/// By the settings that are in force.
fn cores(settings: &[(String, String)]) -> Option<u32> {
    let (_, text) = settings.iter().find(|(name, _)| name == "threads")?;
    text.parse().ok().filter(|&n| n > 0)
}

/// Stages overlap: the longest of those that run.
fn left(stages: &[StageView]) -> Option<f64> {
    let mut longest = None;
    for stage in stages.iter().filter(|s| s.state == "running") {
        longest = longest.max(stage.eta_s.filter(|s| s.is_finite()).map(|s| (s * 1e3) as u64));
    }
    longest.map(|ms| ms as f64 * 1e-3)
}

fn stages(
    rows: &[StageRow],
    sample: &LiveSample,
    counts: &[ViewCounts],
    now: f64,
    running: bool,
) -> Vec<StageView> {
    // Most scenes come with poses and have no such stage.
    let poses = rows.iter().any(|row| row.name == Stage::Poses.name());
    let listed = Stage::all_listed().filter(|stage| poses || *stage != Stage::Poses);
    let mut names: Vec<&str> = listed.map(Stage::name).collect();
    names.extend(rows.iter().map(|r| r.name.as_str()).filter(|name| Stage::named(name).is_none()));
    let view = |name: &str| {
        let row = rows.iter().find(|r| r.name == name);
        let live = sample.stages.iter().find(|s| s.stage == name);
        let count = counts.iter().find(|c| c.stage == name);
        let state = match row.map(|r| r.state) {
            None => "waiting",
            // A process that died left it so; the next one says that it was interrupted.
            Some(State::Running) if !running => "pending",
            Some(State::Running) => "running",
            Some(State::Pending) => "pending",
            Some(State::Done) => "done",
            Some(State::Failed) => "failed",
        };
        let (made, cached, failed) = count.map_or((0, 0, 0), |c| (c.made, c.cached, c.failed));
        let booked = made + cached + failed;
        let going = state == "running";
        // A stage that was stopped in a part of it has the counts of that part, which are not its own.
        let counted = live.filter(|l| going || l.part.is_none());
        StageView {
            name: name.into(),
            state: state.into(),
            part: live.filter(|_| going).and_then(|l| l.part.clone()),
            done: counted.map_or(booked, |l| l.done.max(if going { 0 } else { booked })),
            total: counted.and_then(|l| l.total).or((booked > 0).then_some(booked)),
            rate: live.filter(|_| going).map_or(0.0, |l| l.rate),
            eta_s: live.filter(|_| going).and_then(|l| l.eta_s),
            made,
            cached,
            failed,
            started: row.and_then(|r| r.started),
            wall_s: row.and_then(|r| {
                let end = r.ended.or(going.then_some(now))?;
                // A stage that goes on began in this process, whose age does not depend on the wall clock.
                let most = if going { (now - sample.began).max(0.0) } else { f64::MAX };
                Some((end - r.started?).clamp(0.0, most))
            }),
            cpu_s: row.and_then(|r| r.cpu_s),
            runs: row.map_or(0, |r| r.runs),
            error: row.and_then(|r| r.error.clone()),
            why: None,
        }
    };
    names.into_iter().map(view).collect()
}

fn actors(sample: &LiveSample, now: f64) -> Vec<ActorView> {
    let worker = |w: &LiveWorker| WorkerView {
        state: w.state,
        item: w.item.clone(),
        for_s: (now - w.since).max(0.0),
        stuck: w.stuck,
        why: None,
    };
    let view = |a: &segwild_flow::ledger::LiveActor| {
        let seconds = [
            ("starting", a.starting_s),
            ("busy", a.busy_s),
            ("waiting", a.waiting_s),
            ("blocked", a.blocked_s),
            ("back_off", a.back_off_s),
        ];
        let life: f64 = seconds.iter().map(|(_, s)| s).sum();
        ActorView {
            name: a.name.clone(),
            exit: a.exit.clone(),
            error: a.error.clone(),
            workers: a.workers.iter().map(worker).collect(),
            messages: a.messages,
            retries: a.retries,
            restarts: a.restarts,
            quarantined: a.quarantined,
            last_error: a.last_error.clone(),
            seconds: seconds.into_iter().map(|(name, s)| (name.to_owned(), s)).collect(),
            cpu_s: a.cpu_s,
            utilization: if life > 0.0 { a.busy_s / life } else { 0.0 },
        }
    };
    sample.actors.iter().map(view).collect()
}

fn events(recorded: Vec<EventRow>) -> Vec<LoggedEvent> {
    let mut logged: Vec<LoggedEvent> = recorded
        .into_iter()
        .filter(|e| e.level != "info" && e.level != "detail")
        .map(|e| LoggedEvent {
            time: e.time,
            level: e.level,
            stage: e.stage,
            message: crate::words::event(&e.message),
        })
        .collect();
    logged.drain(..logged.len().saturating_sub(EVENTS));
    logged
}
