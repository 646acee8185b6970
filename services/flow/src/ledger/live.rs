//! What a run is doing now, for other processes to see: written about once a second, the last one stays.
//!
//! The tables are additions to the format: a ledger from before them has none, and reads as a run nobody watched.

use serde::{Deserialize, Serialize};

use crate::cache::CacheCounters;
use crate::meter::WorkerState;

/// A worker, as it was at the sample's time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveWorker {
    /// What it does.
    pub state: WorkerState,
    /// On what: the photo, the mailbox it waits for, or what it waits for.
    pub item: String,
    /// Since when, in seconds since 1970.
    pub since: f64,
    /// Whether the supervisor considers it stuck.
    pub stuck: bool,
}

/// An actor: its workers, times (wall-clock seconds over all workers) and counts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveActor {
    /// Its name.
    pub name: String,
    /// How it ended: `running`, `finished`, `stopped`, `downstream_closed`, `failed`, `late`.
    pub exit: String,
    /// Why it failed.
    pub error: Option<String>,
    /// Its workers.
    pub workers: Vec<LiveWorker>,
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
    /// Building it.
    pub starting_s: f64,
    /// Working.
    pub busy_s: f64,
    /// Waiting for input.
    pub waiting_s: f64,
    /// Waiting for space in other mailboxes, or for what another actor makes.
    pub blocked_s: f64,
    /// Waiting before a restart or another attempt.
    pub back_off_s: f64,
    /// Processor seconds of its own threads.
    pub cpu_s: f64,
}

/// A mailbox; see [`MailboxStats`](crate::MailboxStats).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveMailbox {
    /// Whose it is.
    pub name: String,
    /// Messages queued.
    pub depth: u64,
    /// Bytes queued.
    pub bytes: u64,
    /// Messages it may hold.
    pub capacity: u64,
    /// Bytes it may hold.
    pub capacity_bytes: u64,
    /// Most messages ever queued.
    pub high_water: u64,
    /// Most bytes ever queued.
    pub high_water_bytes: u64,
    /// Messages sent.
    pub sent: u64,
    /// Messages taken out.
    pub received: u64,
    /// Sends that found it full.
    pub held_back: u64,
    /// Senders waiting for space now.
    pub waiting_senders: u64,
    /// Time senders have waited for space, in seconds.
    pub back_pressure_s: f64,
    /// Whether it takes no more.
    pub closed: bool,
}

/// How far a stage has come.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LiveStage {
    /// The stage.
    pub stage: String,
    /// The part that the units are of, where the stage has parts with units of their own.
    #[serde(default)]
    pub part: Option<String>,
    /// Units of work done, failed and found ones included.
    pub done: u64,
    /// Units in all, if known.
    pub total: Option<u64>,
    /// Units per second, lately.
    pub rate: f64,
    /// Seconds to go, if that is known.
    pub eta_s: Option<f64>,
}

impl LiveStage {
    /// A stage that starts.
    pub(crate) fn new(stage: &str, total: Option<u64>) -> LiveStage {
        LiveStage { stage: stage.into(), total, ..LiveStage::default() }
    }
}

/// A measured number's last value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveMetric {
    /// The stage it is about.
    pub stage: String,
    /// Its name, with the unit.
    pub name: String,
    /// The number.
    pub value: f64,
    /// Where on the stage's own scale.
    pub step: Option<u64>,
}

/// The whole state of a run at one time. Times are seconds since 1970.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LiveSample {
    /// When it was taken.
    pub time: f64,
    /// The process that works, or worked, on the run.
    pub pid: u32,
    /// When that process began with it.
    pub began: f64,
    /// When anything last moved: a message handled, a unit of work done.
    pub moved: f64,
    /// Memory of the process in bytes, if the system reports it.
    pub rss_bytes: Option<u64>,
    /// The most it ever had.
    pub peak_rss_bytes: Option<u64>,
    /// Its threads.
    pub threads: Option<u64>,
    /// Its processor seconds.
    pub cpu_s: Option<f64>,
    /// What the content cache has done for it.
    pub cache: CacheCounters,
    /// The actors, in the order in which they were spawned.
    pub actors: Vec<LiveActor>,
    /// The mailboxes.
    pub mailboxes: Vec<LiveMailbox>,
    /// The stages that have started, in that order.
    pub stages: Vec<LiveStage>,
    /// Measured numbers.
    pub metrics: Vec<LiveMetric>,
}

impl LiveSample {
    /// Units of work done over all stages.
    pub(super) fn done(&self) -> u64 {
        self.stages.iter().map(|s| s.done).sum()
    }

    /// What changes when, and only when, work moves: messages handled, units of work and steps done. Who waits for
    /// progress compares two of these, and counts the time between by its own clock.
    ///
    /// ```
    /// use segwild_flow::ledger::{LiveSample, LiveStage};
    /// let stage = |done| LiveStage { stage: "sky".into(), done, ..LiveStage::default() };
    /// let sample = |time, done| LiveSample { time, stages: vec![stage(done)], ..LiveSample::default() };
    /// assert_eq!(sample(1.0, 4).movement(), sample(9.0, 4).movement());
    /// assert_ne!(sample(1.0, 4).movement(), sample(1.0, 5).movement());
    /// ```
    pub fn movement(&self) -> (u64, u64) {
        let steps = self.metrics.iter().filter_map(|m| m.step).sum::<u64>();
        (self.actors.iter().map(|a| a.messages).sum(), self.done() + steps)
    }
}

/// One point of a run's past.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PastSample {
    /// Seconds since 1970.
    pub time: f64,
    /// Memory in bytes.
    pub rss_bytes: Option<u64>,
    /// Processor seconds of the process.
    pub cpu_s: Option<f64>,
    /// Units of work done over all stages.
    pub done: u64,
    /// Units per second over all stages.
    pub rate: f64,
    /// Messages queued over all mailboxes.
    pub depth: u64,
    /// Back-pressure over all mailboxes, in seconds.
    pub back_pressure_s: f64,
}

/// What came of the views of one stage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ViewCounts {
    /// The stage.
    pub stage: String,
    /// Made by work.
    pub made: u64,
    /// Found in the cache.
    pub cached: u64,
    /// Failed for good.
    pub failed: u64,
}
