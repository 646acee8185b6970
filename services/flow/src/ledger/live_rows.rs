//! The tables of the live view: how a sample is written and read.

use rusqlite::{OptionalExtension, Row, Transaction, params};

use super::live::{LiveActor, LiveMailbox, LiveMetric, LiveSample, LiveStage, LiveWorker};
use crate::cache::CacheCounters;
use crate::meter::WorkerState;

pub(super) const TABLES: &str = "
CREATE TABLE IF NOT EXISTS live (
  id INTEGER PRIMARY KEY CHECK (id = 1), time REAL NOT NULL, pid INTEGER NOT NULL, began REAL NOT NULL,
  moved REAL NOT NULL, rss_bytes INTEGER, peak_rss_bytes INTEGER, threads INTEGER, cpu_s REAL,
  cache_hits INTEGER NOT NULL, cache_misses INTEGER NOT NULL, cache_corrupt INTEGER NOT NULL,
  cache_bytes_read INTEGER NOT NULL, cache_bytes_written INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS actors (
  name TEXT PRIMARY KEY, place INTEGER NOT NULL, exit TEXT NOT NULL, error TEXT, messages INTEGER NOT NULL,
  retries INTEGER NOT NULL, restarts INTEGER NOT NULL, quarantined INTEGER NOT NULL, last_error TEXT,
  starting_s REAL NOT NULL, busy_s REAL NOT NULL, waiting_s REAL NOT NULL, blocked_s REAL NOT NULL,
  back_off_s REAL NOT NULL, cpu_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS workers (
  actor TEXT NOT NULL, worker INTEGER NOT NULL, state TEXT NOT NULL, item TEXT NOT NULL, since REAL NOT NULL,
  stuck INTEGER NOT NULL, PRIMARY KEY (actor, worker)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS mailboxes (
  name TEXT PRIMARY KEY, place INTEGER NOT NULL, depth INTEGER NOT NULL, bytes INTEGER NOT NULL,
  capacity INTEGER NOT NULL, capacity_bytes INTEGER NOT NULL, high_water INTEGER NOT NULL,
  high_water_bytes INTEGER NOT NULL, sent INTEGER NOT NULL, received INTEGER NOT NULL,
  held_back INTEGER NOT NULL, waiting_senders INTEGER NOT NULL, back_pressure_s REAL NOT NULL,
  closed INTEGER NOT NULL
);
CREATE TABLE IF NOT EXISTS progress (
  stage TEXT PRIMARY KEY, place INTEGER NOT NULL, done INTEGER NOT NULL, total INTEGER, rate REAL NOT NULL,
  eta_s REAL
);
CREATE TABLE IF NOT EXISTS metrics (
  stage TEXT NOT NULL, name TEXT NOT NULL, value REAL NOT NULL, step INTEGER, PRIMARY KEY (stage, name)
) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS samples (
  time REAL PRIMARY KEY, rss_bytes INTEGER, cpu_s REAL, done INTEGER NOT NULL, rate REAL NOT NULL,
  depth INTEGER NOT NULL, back_pressure_s REAL NOT NULL
) WITHOUT ROWID;
";

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

pub(super) fn number(row: &Row<'_>, column: usize) -> rusqlite::Result<u64> {
    Ok(row.get::<_, i64>(column)?.max(0) as u64)
}

pub(super) fn maybe_number(row: &Row<'_>, column: usize) -> rusqlite::Result<Option<u64>> {
    Ok(row.get::<_, Option<i64>>(column)?.map(|n| n.max(0) as u64))
}

pub(super) fn write_sample(t: &Transaction<'_>, sample: &LiveSample) -> rusqlite::Result<()> {
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

pub(super) fn read_sample(t: &Transaction<'_>) -> rusqlite::Result<Option<LiveSample>> {
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
    sample.stages = t
        .prepare("SELECT stage, done, total, rate, eta_s FROM progress ORDER BY place")?
        .query_map([], |row| {
            Ok(LiveStage {
                stage: row.get(0)?,
                done: number(row, 1)?,
                total: maybe_number(row, 2)?,
                rate: row.get(3)?,
                eta_s: row.get(4)?,
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
