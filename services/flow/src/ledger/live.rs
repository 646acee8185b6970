//! What a run is doing now, for other processes to see: written about once a second, the last one stays.
//!
//! The tables are additions to the format: a ledger from before them has none, and reads as a run nobody watched.

use rusqlite::{Connection, OptionalExtension, params};
use serde::{Deserialize, Serialize};

use super::live_rows::{maybe_number, number, read_sample, write_sample};
use super::{Commit, Ledger, LedgerError};
use crate::cache::CacheCounters;
use crate::meter::WorkerState;

/// Samples of the past that are kept; beyond it every second one goes and they come half as often.
pub const KEPT_SAMPLES: usize = 2000;

/// A worker, as it was at the sample's time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveWorker {
    /// What it does.
    pub state: WorkerState,
    /// On what: the photo, the mailbox it waits for, or what it waits for.
    pub item: String,
    /// Since when, in seconds since 1970.
    pub since: f64,
    /// Whether the supervisor holds it for stuck.
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
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LiveStage {
    /// The stage.
    pub stage: String,
    /// Units of work done, failed and found ones included.
    pub done: u64,
    /// Units in all, if known.
    pub total: Option<u64>,
    /// Units per second, lately.
    pub rate: f64,
    /// Seconds to go, if that is known.
    pub eta_s: Option<f64>,
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
    fn done(&self) -> u64 {
        self.stages.iter().map(|s| s.done).sum()
    }

    /// What changes when, and only when, work moves: messages handled, units of work and steps done. Who waits for
    /// progress compares two of these, and counts the time between by its own clock.
    ///
    /// ```
    /// use segwild_flow::ledger::{LiveSample, LiveStage};
    /// let stage = |done| LiveStage { stage: "sky".into(), done, total: None, rate: 0.0, eta_s: None };
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

fn has_tables(c: &Connection) -> rusqlite::Result<bool> {
    c.query_row("SELECT EXISTS (SELECT 1 FROM sqlite_schema WHERE name = 'live')", [], |row| row.get(0))
}

impl Ledger {
    /// Replaces what the run is doing now; with `past`, also adds a point to its past.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn record_live(&self, sample: &LiveSample, past: bool) -> Result<(), LedgerError> {
        self.write(Commit::Quick, |t| {
            for table in ["live", "actors", "workers", "mailboxes", "progress", "metrics"] {
                t.execute(&format!("DELETE FROM {table}"), [])?;
            }
            write_sample(t, sample)?;
            if past {
                let rate: f64 = sample.stages.iter().map(|s| s.rate).sum();
                let depth: u64 = sample.mailboxes.iter().map(|m| m.depth).sum();
                let pressure: f64 = sample.mailboxes.iter().map(|m| m.back_pressure_s).sum();
                t.execute(
                    "INSERT OR REPLACE INTO samples VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7)",
                    params![
                        sample.time,
                        sample.rss_bytes.map(|n| n as i64),
                        sample.cpu_s,
                        sample.done() as i64,
                        rate,
                        depth as i64,
                        pressure
                    ],
                )?;
            }
            Ok(())
        })
    }

    /// What the run is doing, or was doing when it was last watched; `None` if it never was.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn live(&self) -> Result<Option<LiveSample>, LedgerError> {
        self.read(|c| {
            // One transaction: the tables are of one moment.
            let t = c.unchecked_transaction()?;
            if has_tables(&t)? { read_sample(&t) } else { Ok(None) }
        })
    }

    /// The run's past, oldest first: the last `count` points.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn past(&self, count: usize) -> Result<Vec<PastSample>, LedgerError> {
        self.read(|c| {
            if !has_tables(c)? {
                return Ok(Vec::new());
            }
            c.prepare(
                "SELECT time, rss_bytes, cpu_s, done, rate, depth, back_pressure_s FROM
                   (SELECT * FROM samples ORDER BY time DESC LIMIT ?1) ORDER BY time",
            )?
            .query_map([i64::try_from(count).unwrap_or(i64::MAX)], |row| {
                Ok(PastSample {
                    time: row.get(0)?,
                    rss_bytes: maybe_number(row, 1)?,
                    cpu_s: row.get(2)?,
                    done: number(row, 3)?,
                    rate: row.get(4)?,
                    depth: number(row, 5)?,
                    back_pressure_s: row.get(6)?,
                })
            })?
            .collect()
        })
    }

    /// Keeps every second point of the past once there are more than [`KEPT_SAMPLES`]; returns whether it did.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn thin_past(&self) -> Result<bool, LedgerError> {
        let count: i64 = self.read(|c| c.query_row("SELECT count(*) FROM samples", [], |row| row.get(0)))?;
        if count <= KEPT_SAMPLES as i64 {
            return Ok(false);
        }
        self.write(Commit::Quick, |t| {
            t.execute(
                "DELETE FROM samples WHERE time IN (SELECT time FROM
                   (SELECT time, row_number() OVER (ORDER BY time) AS place FROM samples) WHERE place % 2 = 0)",
                [],
            )?;
            Ok(true)
        })
    }

    /// What came of the views, stage by stage, by the stages' names.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn view_counts(&self) -> Result<Vec<ViewCounts>, LedgerError> {
        self.read(|c| {
            c.prepare(
                "SELECT stage, sum(state = 'done' AND seconds IS NOT NULL),
                   sum(state = 'done' AND seconds IS NULL), sum(state = 'failed')
                 FROM views GROUP BY stage ORDER BY stage",
            )?
            .query_map([], |row| {
                Ok(ViewCounts {
                    stage: row.get(0)?,
                    made: number(row, 1)?,
                    cached: number(row, 2)?,
                    failed: number(row, 3)?,
                })
            })?
            .collect()
        })
    }

    /// How long the views of each stage took, as `(stage, seconds)`; those found in the cache are left out.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn view_seconds(&self) -> Result<Vec<(String, f64)>, LedgerError> {
        self.read(|c| {
            c.prepare("SELECT stage, seconds FROM views WHERE seconds IS NOT NULL ORDER BY stage, view")?
                .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect()
        })
    }

    /// When the last checkpoint was taken (seconds since 1970) and after which step.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn last_checkpoint(&self) -> Result<Option<(f64, u64)>, LedgerError> {
        self.read(|c| {
            c.query_row("SELECT time, step FROM checkpoints ORDER BY time DESC LIMIT 1", [], |row| {
                Ok((row.get(0)?, number(row, 1)?))
            })
            .optional()
        })
    }
}
