//! The tables of the live view: how a sample is written and read.

use rusqlite::{Connection, OptionalExtension, Row, Transaction, params};

use super::live::{
    LiveActor, LiveMailbox, LiveMetric, LiveSample, LiveStage, LiveWorker, PastSample, ViewCounts,
};
use super::{Commit, Ledger, LedgerError};
use crate::cache::CacheCounters;
use crate::meter::WorkerState;

/// Samples of the past that are kept; beyond it every second one goes and they come half as often.
pub const KEPT_SAMPLES: usize = 2000;

fn state_word(state: WorkerState) -> &'static str {
    match state {
        WorkerState::Starting => "starting",
        WorkerState::Waiting => "waiting",
        WorkerState::Busy => "busy",
        WorkerState::Blocked => "blocked",
        WorkerState::BackOff => "back_off",
        WorkerState::Ended => "ended",
    }
}

fn state_of(word: &str) -> WorkerState {
    use WorkerState::*;
    // A word that this version does not know is not worth refusing the whole view for.
    [Starting, Waiting, Busy, Blocked, BackOff].into_iter().find(|s| state_word(*s) == word).unwrap_or(Ended)
}

fn number(row: &Row<'_>, column: usize) -> rusqlite::Result<u64> {
    Ok(row.get::<_, i64>(column)?.max(0) as u64)
}

fn maybe_number(row: &Row<'_>, column: usize) -> rusqlite::Result<Option<u64>> {
    Ok(row.get::<_, Option<i64>>(column)?.map(|n| n.max(0) as u64))
}

fn write_sample(t: &Transaction<'_>, sample: &LiveSample) -> rusqlite::Result<()> {
    let c = &sample.cache;
    t.execute(
        "INSERT INTO live VALUES (1, ?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13)",
        params![
            sample.time,
            sample.pid,
            sample.began,
            sample.moved,
            sample.rss_bytes.map(|n| n as i64),
            sample.peak_rss_bytes.map(|n| n as i64),
            sample.threads.map(|n| n as i64),
            sample.cpu_s,
            c.hits as i64,
            c.misses as i64,
            c.corrupt as i64,
            c.bytes_read as i64,
            c.bytes_written as i64
        ],
    )?;
    for (index, a) in sample.actors.iter().enumerate() {
        // Two sources of one name would be one row: the later one is what the run is doing.
        t.execute(
            "INSERT OR REPLACE INTO actors
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14, ?15)",
            params![
                a.name,
                index as i64,
                a.exit,
                a.error,
                a.messages as i64,
                a.retries as i64,
                a.restarts as i64,
                a.quarantined as i64,
                a.last_error,
                a.starting_s,
                a.busy_s,
                a.waiting_s,
                a.blocked_s,
                a.back_off_s,
                a.cpu_s
            ],
        )?;
        for (i, w) in a.workers.iter().enumerate() {
            t.execute(
                "INSERT OR REPLACE INTO workers VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![a.name, i as i64, state_word(w.state), w.item, w.since, w.stuck],
            )?;
        }
    }
    for (index, m) in sample.mailboxes.iter().enumerate() {
        t.execute(
            "INSERT OR REPLACE INTO mailboxes
             VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14)",
            params![
                m.name,
                index as i64,
                m.depth as i64,
                m.bytes as i64,
                m.capacity as i64,
                m.capacity_bytes as i64,
                m.high_water as i64,
                m.high_water_bytes as i64,
                m.sent as i64,
                m.received as i64,
                m.held_back as i64,
                m.waiting_senders as i64,
                m.back_pressure_s,
                m.closed
            ],
        )?;
    }
    for (index, s) in sample.stages.iter().enumerate() {
        t.execute(
            "INSERT OR REPLACE INTO progress VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
            params![s.stage, index as i64, s.done as i64, s.total.map(|n| n as i64), s.rate, s.eta_s],
        )?;
        if let Some(part) = &s.part {
            t.execute("INSERT OR REPLACE INTO parts VALUES (?1, ?2)", params![s.stage, part])?;
        }
    }
    for m in &sample.metrics {
        // SQLite keeps NaN as NULL: a number that is none is left out.
        if m.value.is_finite() {
            t.execute(
                "INSERT OR REPLACE INTO metrics VALUES (?1, ?2, ?3, ?4)",
                params![m.stage, m.name, m.value, m.step.map(|n| n as i64)],
            )?;
        }
    }
    Ok(())
}

fn read_sample(t: &Transaction<'_>) -> rusqlite::Result<Option<LiveSample>> {
    let sample = t
        .query_row("SELECT * FROM live WHERE id = 1", [], |row| {
            Ok(LiveSample {
                time: row.get(1)?,
                pid: row.get(2)?,
                began: row.get(3)?,
                moved: row.get(4)?,
                rss_bytes: maybe_number(row, 5)?,
                peak_rss_bytes: maybe_number(row, 6)?,
                threads: maybe_number(row, 7)?,
                cpu_s: row.get(8)?,
                cache: CacheCounters {
                    hits: number(row, 9)?,
                    misses: number(row, 10)?,
                    corrupt: number(row, 11)?,
                    bytes_read: number(row, 12)?,
                    bytes_written: number(row, 13)?,
                },
                ..LiveSample::default()
            })
        })
        .optional()?;
    let Some(mut sample) = sample else { return Ok(None) };
    sample.actors = t
        .prepare(
            "SELECT name, exit, error, messages, retries, restarts, quarantined, last_error, starting_s, busy_s,
               waiting_s, blocked_s, back_off_s, cpu_s FROM actors ORDER BY place",
        )?
        .query_map([], |row| {
            Ok(LiveActor {
                name: row.get(0)?,
                exit: row.get(1)?,
                error: row.get(2)?,
                workers: Vec::new(),
                messages: number(row, 3)?,
                retries: number(row, 4)?,
                restarts: number(row, 5)?,
                quarantined: number(row, 6)?,
                last_error: row.get(7)?,
                starting_s: row.get(8)?,
                busy_s: row.get(9)?,
                waiting_s: row.get(10)?,
                blocked_s: row.get(11)?,
                back_off_s: row.get(12)?,
                cpu_s: row.get(13)?,
            })
        })?
        .collect::<rusqlite::Result<_>>()?;
    let mut workers =
        t.prepare("SELECT state, item, since, stuck FROM workers WHERE actor = ?1 ORDER BY worker")?;
    for actor in &mut sample.actors {
        actor.workers = workers
            .query_map([&actor.name], |row| {
                Ok(LiveWorker {
                    state: state_of(&row.get::<_, String>(0)?),
                    item: row.get(1)?,
                    since: row.get(2)?,
                    stuck: row.get(3)?,
                })
            })?
            .collect::<rusqlite::Result<_>>()?;
    }
    sample.mailboxes = t
        .prepare(
            "SELECT name, depth, bytes, capacity, capacity_bytes, high_water, high_water_bytes, sent, received,
               held_back, waiting_senders, back_pressure_s, closed FROM mailboxes ORDER BY place",
        )?
        .query_map([], |row| {
            Ok(LiveMailbox {
                name: row.get(0)?,
                depth: number(row, 1)?,
                bytes: number(row, 2)?,
                capacity: number(row, 3)?,
                capacity_bytes: number(row, 4)?,
                high_water: number(row, 5)?,
                high_water_bytes: number(row, 6)?,
                sent: number(row, 7)?,
                received: number(row, 8)?,
                held_back: number(row, 9)?,
                waiting_senders: number(row, 10)?,
                back_pressure_s: row.get(11)?,
                closed: row.get(12)?,
            })
        })?
        .collect::<rusqlite::Result<_>>()?;
    // Ledgers of older versions have no parts.
    let (part, parts) = match has_table(t, "parts")? {
        true => ("part", "LEFT JOIN parts USING (stage)"),
        false => ("NULL", ""),
    };
    sample.stages = t
        .prepare(&format!(
            "SELECT stage, done, total, rate, eta_s, {part} FROM progress {parts} ORDER BY place"
        ))?
        .query_map([], |row| {
            Ok(LiveStage {
                stage: row.get(0)?,
                done: number(row, 1)?,
                total: maybe_number(row, 2)?,
                rate: row.get(3)?,
                eta_s: row.get(4)?,
                part: row.get(5)?,
            })
        })?
        .collect::<rusqlite::Result<_>>()?;
    sample.metrics = t
        .prepare("SELECT stage, name, value, step FROM metrics ORDER BY stage, name")?
        .query_map([], |row| {
            Ok(LiveMetric {
                stage: row.get(0)?,
                name: row.get(1)?,
                value: row.get(2)?,
                step: maybe_number(row, 3)?,
            })
        })?
        .collect::<rusqlite::Result<_>>()?;
    Ok(Some(sample))
}

fn has_table(c: &Connection, name: &str) -> rusqlite::Result<bool> {
    c.query_row("SELECT EXISTS (SELECT 1 FROM sqlite_schema WHERE name = ?1)", [name], |row| row.get(0))
}

impl Ledger {
    /// Replaces what the run is doing now; with `past`, also adds a point to its past.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn record_live(&self, sample: &LiveSample, past: bool) -> Result<(), LedgerError> {
        self.write(Commit::Quick, |t| {
            for table in ["live", "actors", "workers", "mailboxes", "progress", "parts", "metrics"] {
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
            if has_table(&t, "live")? { read_sample(&t) } else { Ok(None) }
        })
    }

    /// The run's past, oldest first: the last `count` points.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn past(&self, count: usize) -> Result<Vec<PastSample>, LedgerError> {
        self.read(|c| {
            if !has_table(c, "live")? {
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
