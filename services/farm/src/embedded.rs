//! The engine for one machine: a SQLite file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rusqlite::types::Type;
use rusqlite::{Connection, ErrorCode, OpenFlags, Row, Transaction, TransactionBehavior, params};
use segwild_flow::database::refuse_strange_schema;
use segwild_flow::lock;

use crate::clock::{JobClock, SystemClock};
use crate::engine::{ChangeKind, EngineError, ErrorClass, JobChange, JobState, JobStatus};
use crate::job::{Job, Needs, Retry};
use crate::jumps;
use crate::log::TransitionLog;
use crate::table::{Decision, Entry, JobTable};
use crate::transition::Transition;

/// Version of the tables.
const VERSION: i64 = 1;

const TABLES: &str = "
CREATE TABLE jobs (
  place INTEGER PRIMARY KEY, id TEXT NOT NULL UNIQUE, payload TEXT NOT NULL, priority INTEGER NOT NULL,
  cores INTEGER NOT NULL, memory_bytes INTEGER NOT NULL, accelerators INTEGER NOT NULL,
  attempts INTEGER NOT NULL, first_delay_s REAL NOT NULL, longest_delay_s REAL NOT NULL,
  state TEXT NOT NULL, attempt INTEGER NOT NULL, failures INTEGER NOT NULL, worker TEXT, lease_until REAL,
  due REAL NOT NULL, started REAL, ended REAL, outcome TEXT, error TEXT, error_class TEXT
);
CREATE INDEX jobs_by_urgency ON jobs (state, priority DESC, place);
CREATE TABLE changes (
  revision INTEGER PRIMARY KEY AUTOINCREMENT, time REAL NOT NULL, job TEXT NOT NULL, kind TEXT NOT NULL,
  attempt INTEGER NOT NULL, detail TEXT NOT NULL
);
";

/// Additions that older versions of the program ignore.
const ADDITIONS: &str = "
CREATE TABLE IF NOT EXISTS additions (
  job TEXT PRIMARY KEY, checkpoint TEXT, accelerator TEXT, silences INTEGER NOT NULL, kept_by TEXT, kept_until REAL
);
";

const COLUMNS: &str = "id, payload, priority, cores, memory_bytes, accelerators, attempts, first_delay_s,
  longest_delay_s, state, attempt, failures, worker, lease_until, due, started, ended, outcome, error, error_class";

/// Jobs in a SQLite file, which several threads and processes may open. Every change waits for the disk: a batch
/// makes a few a minute.
pub struct EmbeddedEngine {
    path: PathBuf,
    store: Mutex<JobStore>,
    clock: Arc<dyn JobClock>,
}

struct JobStore {
    connection: Connection,
    /// The table as this handle last saw it, and the file's version then.
    seen: Option<(i64, JobTable)>,
    /// How far the wall clock has jumped, in seconds, as far as this handle saw it and no caller took it yet.
    jumped: Vec<f64>,
}

impl EmbeddedEngine {
    /// Opens the file, or makes it; its folder must be there.
    ///
    /// # Errors
    /// In words: another format, damaged, not writable.
    pub fn open(path: impl Into<PathBuf>) -> Result<Self, EngineError> {
        Self::with_clock(path, Arc::new(SystemClock))
    }

    /// As [`EmbeddedEngine::open`], with another clock.
    ///
    /// # Errors
    /// As [`EmbeddedEngine::open`].
    pub fn with_clock(path: impl Into<PathBuf>, clock: Arc<dyn JobClock>) -> Result<Self, EngineError> {
        let path = path.into();
        let error = |e| store(&path, e);
        let mut connection = Connection::open(&path).map_err(error)?;
        connection.busy_timeout(Duration::from_secs(10)).map_err(error)?;
        let tables: i64 = connection
            .query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))
            .map_err(error)?;
        // A file of somebody else stays as it is.
        if tables > 0 || number(&connection, "application_id").map_err(error)? != 0 {
            check(&connection, &path)?;
        }
        connection.pragma_update(None, "journal_mode", "WAL").map_err(error)?;
        connection.pragma_update(None, "synchronous", "FULL").map_err(error)?;
        let make = |connection: &mut Connection| {
            let t = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
            let tables: i64 = t.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
            if tables == 0 {
                t.execute_batch(TABLES)?;
                t.pragma_update(None, "user_version", VERSION)?;
            }
            t.execute_batch(jumps::TABLE)?;
            t.execute_batch(ADDITIONS)?;
            t.commit()
        };
        make(&mut connection).map_err(error)?;
        Self::checked(path, connection, clock)
    }

    /// Opens the file for reading, also while others write it.
    ///
    /// # Errors
    /// In words: missing, another format, damaged.
    pub fn open_read_only(path: impl Into<PathBuf>) -> Result<Self, EngineError> {
        let path = path.into();
        if !path.is_file() {
            return Err(EngineError::Missing { path });
        }
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(&path, flags).map_err(|e| store(&path, e))?;
        connection.busy_timeout(Duration::from_secs(10)).map_err(|e| store(&path, e))?;
        Self::checked(path, connection, Arc::new(SystemClock))
    }

    fn checked(path: PathBuf, connection: Connection, clock: Arc<dyn JobClock>) -> Result<Self, EngineError> {
        check(&connection, &path)?;
        Ok(Self { path, store: Mutex::new(JobStore { connection, seen: None, jumped: Vec::new() }), clock })
    }

    fn read<T>(&self, query: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, EngineError> {
        let held = lock(&self.store);
        query(&held.connection).map_err(|e| store(&self.path, e))
    }
}

impl TransitionLog for EmbeddedEngine {
    fn transact<A, R>(
        &self,
        decide: impl Fn(&JobTable, f64) -> Decision<A>,
        then: impl FnOnce(&JobTable, A) -> R,
    ) -> Result<R, EngineError> {
        let mut held = lock(&self.store);
        let held = &mut *held;
        // Whatever fails on the way leaves no table that the file does not have.
        let seen = held.seen.take();
        let run = || {
            let t = held.connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
            // Read inside: the clocks of whoever wrote last were read before.
            let now = self.clock.now();
            let (version, mut table) = current(&t, seen)?;
            let jump = jumps::follow(&t, &table, now, &self.clock.steady())?;
            write(&t, &mut table, &jump.transitions, now)?;
            let decision = decide(&table, now);
            // A refusal has changed nothing but expired leases and moved times, which are worth keeping.
            write(&t, &mut table, &decision.transitions, now)?;
            t.commit()?;
            Ok((version, table, decision.answer, jump.seconds))
        };
        let (version, table, answer, jump) = run().map_err(|e| store(&self.path, e))?;
        held.jumped.extend(jump);
        let result = answer.map(|answer| then(&table, answer));
        held.seen = Some((version, table));
        result
    }

    fn with_table<R>(&self, read: impl FnOnce(&JobTable) -> R) -> Result<R, EngineError> {
        let mut held = lock(&self.store);
        let held = &mut *held;
        let seen = held.seen.take();
        // One view of the file for all queries.
        let view = || current(&*held.connection.unchecked_transaction()?, seen);
        let (version, table) = view().map_err(|e| store(&self.path, e))?;
        let result = read(&table);
        held.seen = Some((version, table));
        Ok(result)
    }

    fn changes(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError> {
        let after = i64::try_from(after).unwrap_or(i64::MAX);
        let limit = i64::try_from(limit).unwrap_or(i64::MAX);
        self.read(|c| {
            c.prepare(
                "SELECT revision, time, job, kind, attempt, detail FROM changes WHERE revision > ?1
                 ORDER BY revision LIMIT ?2",
            )?
            .query_map([after, limit], |row| {
                Ok(JobChange {
                    revision: row.get::<_, i64>(0)?.max(0) as u64,
                    time: row.get(1)?,
                    job: row.get(2)?,
                    kind: word(row, 3, &ChangeKind::ALL, ChangeKind::word)?,
                    attempt: row.get(4)?,
                    detail: row.get(5)?,
                })
            })?
            .collect()
        })
    }

    fn count_of(&self, kind: ChangeKind) -> Result<u64, EngineError> {
        let count: i64 = self.read(|c| {
            c.query_row("SELECT count(*) FROM changes WHERE kind = ?1", [kind.word()], |row| row.get(0))
        })?;
        Ok(count.max(0) as u64)
    }

    fn met_jumps(&self) -> Result<Vec<f64>, EngineError> {
        self.transact(|_, _| Decision { transitions: Vec::new(), answer: Ok(()) }, |_, ()| ())?;
        Ok(std::mem::take(&mut lock(&self.store).jumped))
    }
}

fn store(path: &Path, error: rusqlite::Error) -> EngineError {
    EngineError::Store { path: path.to_path_buf(), reason: Box::new(error) }
}

fn number(connection: &Connection, pragma: &str) -> rusqlite::Result<i64> {
    connection.pragma_query_value(None, pragma, |row| row.get(0))
}

/// Refuses a file of another program or another version.
fn check(connection: &Connection, path: &Path) -> Result<(), EngineError> {
    let error = |e| store(path, e);
    let foreign = |why: String| {
        let reason = format!("it holds no jobs of segwild or is damaged ({why}): move it away and run again");
        EngineError::Store { path: path.to_path_buf(), reason: reason.into() }
    };
    refuse_strange_schema(connection).map_err(|e| match e.sqlite_error_code() {
        Some(ErrorCode::DatabaseCorrupt) => foreign(e.to_string()),
        _ => error(e),
    })?;
    // This program leaves the number of the application as it is in a new file.
    if number(connection, "application_id").map_err(error)? != 0 {
        return Err(foreign("another program's database".into()));
    }
    let found = number(connection, "user_version").map_err(error)?;
    if found != VERSION {
        return Err(EngineError::Version { path: path.to_path_buf(), found, known: VERSION });
    }
    Ok(())
}

/// The table as the file has it, with the file's version: read again where another handle has written since.
fn current(c: &Connection, seen: Option<(i64, JobTable)>) -> rusqlite::Result<(i64, JobTable)> {
    let version: i64 = c.pragma_query_value(None, "data_version", |row| row.get(0))?;
    match seen {
        Some((then, table)) if then == version => Ok((version, table)),
        _ => Ok((version, load(c)?)),
    }
}

/// Checkpoint, accelerator, silences, and who keeps capacity free for the job until when.
type Addition = (Option<String>, Option<String>, u32, Option<(String, f64)>);

fn load(c: &Connection) -> rusqlite::Result<JobTable> {
    let has_additions: bool =
        c.query_row("SELECT count(*) > 0 FROM sqlite_schema WHERE name = 'additions'", [], |row| row.get(0))?;
    let mut waits: BTreeMap<String, String> = c
        .prepare(
            "SELECT job, detail FROM changes WHERE kind = 'waits' AND revision IN
               (SELECT max(revision) FROM changes JOIN jobs ON jobs.id = changes.job
                WHERE jobs.state = 'leased' GROUP BY job)",
        )?
        .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
        .collect::<rusqlite::Result<_>>()?;
    let mut additions: BTreeMap<String, Addition> = match has_additions {
        true => c
            .prepare("SELECT job, checkpoint, accelerator, silences, kept_by, kept_until FROM additions")?
            .query_map([], |row| {
                let kept = row.get::<_, Option<String>>(4)?.zip(row.get(5)?);
                Ok((row.get(0)?, (row.get(1)?, row.get(2)?, row.get(3)?, kept)))
            })?
            .collect::<rusqlite::Result<_>>()?,
        // Opened to read a file of before.
        false => BTreeMap::new(),
    };
    let entries = c
        .prepare(&format!("SELECT {COLUMNS}, place FROM jobs ORDER BY place"))?
        .query_map([], |row| {
            let mut status = status(row)?;
            let (checkpoint, accelerator, silences, kept) =
                additions.remove(&status.job.id).unwrap_or_default();
            (status.checkpoint, status.job.accelerator, status.silences) =
                (checkpoint, accelerator, silences);
            let waits = waits.remove(&status.job.id);
            Ok((row.get::<_, i64>(20)?.max(0) as u64, Entry { status, waits, kept, timed_by: 0 }))
        })?
        .collect::<rusqlite::Result<_>>()?;
    let revision: i64 =
        c.query_row("SELECT coalesce(max(revision), 0) FROM changes", [], |row| row.get(0))?;
    Ok(JobTable::of(entries, revision.max(0) as u64))
}

/// Applies transitions to the table and the file.
fn write(
    t: &Transaction<'_>,
    table: &mut JobTable,
    transitions: &[Transition],
    now: f64,
) -> rusqlite::Result<()> {
    let mut touched = BTreeSet::new();
    for transition in transitions {
        for change in table.apply(transition, now, 0) {
            t.execute(
                "INSERT INTO changes (revision, time, job, kind, attempt, detail) VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![
                    i64::try_from(change.revision).unwrap_or(i64::MAX),
                    change.time,
                    change.job,
                    change.kind.word(),
                    change.attempt,
                    change.detail
                ],
            )?;
        }
        match transition {
            // The file keeps no workers.
            Transition::Announced { .. } | Transition::Paused { .. } => {}
            Transition::ClockSet { .. } | Transition::TimesMoved { .. } => {
                touched.extend(table.jobs().map(|status| status.job.id.clone()));
            }
            Transition::Published(_)
            | Transition::Claimed { .. }
            | Transition::Renewed { .. }
            | Transition::Expired { .. }
            | Transition::Completed { .. }
            | Transition::Failed { .. }
            | Transition::Released { .. }
            | Transition::Revived { .. }
            | Transition::Withdrawn { .. }
            | Transition::Waited { .. }
            | Transition::Stored { .. }
            | Transition::Kept { .. }
            | Transition::RestEnded { .. } => touched.extend(transition.job().map(str::to_owned)),
        }
    }
    for id in touched {
        match table.entry(&id) {
            Some(entry) => put(t, table.ranks[&id], entry)?,
            None => {
                t.execute("DELETE FROM jobs WHERE id = ?1", [&id])?;
                t.execute("DELETE FROM additions WHERE job = ?1", [&id])?;
            }
        }
    }
    Ok(())
}

fn put(t: &Transaction<'_>, rank: u64, entry: &Entry) -> rusqlite::Result<()> {
    let status = &entry.status;
    let (job, needs, retry) = (&status.job, &status.job.needs, &status.job.retry);
    let mut insert = t.prepare(&format!(
        "INSERT OR REPLACE INTO jobs ({COLUMNS}, place) VALUES
           (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, ?10, ?11, ?12, ?13, ?14, ?15, ?16, ?17, ?18, ?19, ?20, ?21)"
    ))?;
    insert.execute(params![
        job.id,
        job.payload,
        job.priority,
        needs.cores,
        i64::try_from(needs.memory_bytes).unwrap_or(i64::MAX),
        needs.accelerators,
        retry.attempts,
        retry.first_delay_s,
        retry.longest_delay_s,
        status.state.word(),
        status.attempt,
        status.failures,
        status.worker,
        status.lease_until,
        status.due,
        status.started,
        status.ended,
        status.outcome,
        status.error,
        status.error_class.map(ErrorClass::word),
        i64::try_from(rank).unwrap_or(i64::MAX)
    ])?;
    t.execute(
        "INSERT OR REPLACE INTO additions (job, checkpoint, accelerator, silences, kept_by, kept_until)
           VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
        params![
            job.id,
            status.checkpoint,
            job.accelerator,
            status.silences,
            entry.kept.as_ref().map(|(worker, _)| worker),
            entry.kept.as_ref().map(|(_, until)| *until)
        ],
    )?;
    Ok(())
}

fn word<T: Copy>(
    row: &Row<'_>,
    column: usize,
    all: &[T],
    name: fn(T) -> &'static str,
) -> rusqlite::Result<T> {
    let word: String = row.get(column)?;
    all.iter().copied().find(|&v| name(v) == word).ok_or_else(|| {
        rusqlite::Error::FromSqlConversionFailure(column, Type::Text, format!("no word `{word}`").into())
    })
}

fn status(row: &Row<'_>) -> rusqlite::Result<JobStatus> {
    let class: Option<String> = row.get(19)?;
    Ok(JobStatus {
        job: Job {
            id: row.get(0)?,
            payload: row.get(1)?,
            priority: row.get(2)?,
            needs: Needs {
                cores: row.get(3)?,
                memory_bytes: row.get::<_, i64>(4)?.max(0) as u64,
                accelerators: row.get(5)?,
            },
            retry: Retry { attempts: row.get(6)?, first_delay_s: row.get(7)?, longest_delay_s: row.get(8)? },
            accelerator: None,
        },
        state: word(row, 9, &JobState::ALL, JobState::word)?,
        attempt: row.get(10)?,
        failures: row.get(11)?,
        worker: row.get(12)?,
        lease_until: row.get(13)?,
        due: row.get(14)?,
        started: row.get(15)?,
        ended: row.get(16)?,
        outcome: row.get(17)?,
        error: row.get(18)?,
        error_class: class.and_then(|c| ErrorClass::ALL.into_iter().find(|k| k.word() == c)),
        checkpoint: None,
        silences: 0,
    })
}
