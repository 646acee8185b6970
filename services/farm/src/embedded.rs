//! The engine for one machine: a SQLite file.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use rusqlite::types::Type;
use rusqlite::{Connection, OpenFlags, OptionalExtension, Row, Transaction, TransactionBehavior, params};

use crate::clock::{JobClock, SystemClock};
use crate::engine::{
    ChangeKind, Completed, EngineError, ErrorClass, JobChange, JobEngine, JobFate, JobLease, JobState,
    JobStatus, Published, WorkerOffer,
};
use crate::job::{Job, Needs, Retry};
use crate::jumps;
use crate::turn::turns;

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

const COLUMNS: &str = "id, payload, priority, cores, memory_bytes, accelerators, attempts, first_delay_s,
  longest_delay_s, state, attempt, failures, worker, lease_until, due, started, ended, outcome, error, error_class";

/// Jobs in a SQLite file, which several threads and processes may open. Every change waits for the disk: a batch
/// makes a few a minute.
pub struct EmbeddedEngine {
    path: PathBuf,
    connection: Mutex<Connection>,
    clock: Arc<dyn JobClock>,
    /// How far the wall clock has jumped, in seconds, as far as this handle saw it and nobody asked yet.
    jumped: Mutex<Vec<f64>>,
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
        let error = |e| store(&path, &e);
        let mut connection = Connection::open(&path).map_err(error)?;
        connection.busy_timeout(Duration::from_secs(10)).map_err(error)?;
        connection.pragma_update(None, "journal_mode", "WAL").map_err(error)?;
        connection.pragma_update(None, "synchronous", "FULL").map_err(error)?;
        let make = |connection: &mut Connection| {
            let t = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
            let tables: i64 = t.query_row("SELECT count(*) FROM sqlite_schema", [], |row| row.get(0))?;
            if tables == 0 {
                t.execute_batch(TABLES)?;
                t.pragma_update(None, "user_version", VERSION)?;
            }
            // An addition that older versions of the program ignore.
            t.execute_batch(jumps::TABLE)?;
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
        let connection = Connection::open_with_flags(&path, flags).map_err(|e| store(&path, &e))?;
        connection.busy_timeout(Duration::from_secs(10)).map_err(|e| store(&path, &e))?;
        Self::checked(path, connection, Arc::new(SystemClock))
    }

    fn checked(path: PathBuf, connection: Connection, clock: Arc<dyn JobClock>) -> Result<Self, EngineError> {
        let found: i64 = connection
            .pragma_query_value(None, "user_version", |row| row.get(0))
            .map_err(|e| store(&path, &e))?;
        if found != VERSION {
            return Err(EngineError::Version { path, found, known: VERSION });
        }
        Ok(Self { path, connection: Mutex::new(connection), clock, jumped: Mutex::default() })
    }

    /// Hands back every lease without counting an attempt. Only for who knows that none of the holders lives:
    /// the batch, which holds a lock that a dead one has lost.
    ///
    /// # Errors
    /// When the store fails.
    pub fn release_all(&self, reason: &str) -> Result<usize, EngineError> {
        self.write(|t, now| {
            let held: Vec<(String, u32)> = t
                .prepare("SELECT id, attempt FROM jobs WHERE state = 'leased' ORDER BY place")?
                .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect::<rusqlite::Result<_>>()?;
            for (id, attempt) in &held {
                end(t, id, JobState::Pending, now, now)?;
                note(t, now, id, ChangeKind::Released, *attempt, reason)?;
            }
            Ok(Ok(held.len()))
        })
    }

    /// Looks at the clocks, and says which jumps of the wall clock this handle has met since it was last asked, in
    /// seconds; back is negative. Rests and leases were moved along with the clock.
    ///
    /// # Errors
    /// When the store fails.
    pub fn jumps(&self) -> Result<Vec<f64>, EngineError> {
        self.write(|_, _| Ok(Ok(())))?;
        Ok(std::mem::take(&mut self.jumped.lock().unwrap_or_else(PoisonError::into_inner)))
    }

    /// How often something has happened, over all jobs and ever.
    ///
    /// # Errors
    /// When the store fails.
    pub fn count(&self, kind: ChangeKind) -> Result<u64, EngineError> {
        let count: i64 = self.read(|c| {
            c.query_row("SELECT count(*) FROM changes WHERE kind = ?1", [kind.word()], |row| row.get(0))
        })?;
        Ok(count.max(0) as u64)
    }

    /// Forgets jobs that are not wanted any more, but for those that somebody works on; what happened to them stays
    /// recorded.
    ///
    /// # Errors
    /// When the store fails.
    pub fn withdraw_others(&self, wanted: &[&str]) -> Result<usize, EngineError> {
        self.write(|t, _| {
            let known: Vec<String> = t
                .prepare("SELECT id FROM jobs WHERE state <> 'leased'")?
                .query_map([], |row| row.get(0))?
                .collect::<rusqlite::Result<_>>()?;
            let others = known.iter().filter(|id| !wanted.contains(&id.as_str()));
            let mut count = 0;
            for id in others {
                count += t.execute("DELETE FROM jobs WHERE id = ?1", [id])?;
            }
            Ok(Ok(count))
        })
    }

    pub(crate) fn write<T>(
        &self,
        change: impl FnOnce(&Transaction<'_>, f64) -> rusqlite::Result<Result<T, EngineError>>,
    ) -> Result<T, EngineError> {
        let mut connection = self.connection.lock().unwrap_or_else(PoisonError::into_inner);
        let run = || {
            let t = connection.transaction_with_behavior(TransactionBehavior::Immediate)?;
            // Read inside: the clocks of whoever wrote last were read before.
            let now = self.clock.now();
            let jumped = jumps::follow(&t, now, &self.clock.steady())?;
            let value = change(&t, now)?;
            // A refusal has changed nothing but expired leases and moved times, which are worth keeping.
            t.commit()?;
            Ok((value, jumped))
        };
        let (value, jumped) = run().map_err(|e| store(&self.path, &e))?;
        self.jumped.lock().unwrap_or_else(PoisonError::into_inner).extend(jumped);
        value
    }

    pub(crate) fn read<T>(
        &self,
        query: impl FnOnce(&Connection) -> rusqlite::Result<T>,
    ) -> Result<T, EngineError> {
        let connection = self.connection.lock().unwrap_or_else(PoisonError::into_inner);
        query(&connection).map_err(|e| store(&self.path, &e))
    }
}

fn store(path: &Path, error: &rusqlite::Error) -> EngineError {
    EngineError::Store { path: path.to_path_buf(), reason: error.to_string() }
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
    })
}

fn find(t: &Connection, id: &str) -> rusqlite::Result<Option<JobStatus>> {
    t.query_row(&format!("SELECT {COLUMNS} FROM jobs WHERE id = ?1"), [id], status).optional()
}

pub(crate) fn note(
    t: &Transaction<'_>,
    now: f64,
    job: &str,
    kind: ChangeKind,
    attempt: u32,
    detail: &str,
) -> rusqlite::Result<()> {
    t.execute(
        "INSERT INTO changes (time, job, kind, attempt, detail) VALUES (?1, ?2, ?3, ?4, ?5)",
        params![now, job, kind.word(), attempt, detail],
    )?;
    Ok(())
}

/// Ends an attempt.
fn end(t: &Transaction<'_>, id: &str, state: JobState, now: f64, due: f64) -> rusqlite::Result<()> {
    t.execute(
        "UPDATE jobs SET state = ?2, worker = NULL, lease_until = NULL, ended = ?3, due = ?4 WHERE id = ?1",
        params![id, state.word(), now, due],
    )?;
    Ok(())
}

/// Ends a failed attempt, counts it unless the machine is at fault, and says what becomes of the job.
fn count_failure(
    t: &Transaction<'_>,
    now: f64,
    job: &JobStatus,
    class: ErrorClass,
    error: &str,
) -> rusqlite::Result<JobFate> {
    let (id, retry) = (&job.job.id, &job.job.retry);
    let failures = job.failures + u32::from(class != ErrorClass::Shortage);
    t.execute(
        "UPDATE jobs SET failures = ?2, error = ?3, error_class = ?4 WHERE id = ?1",
        params![id, failures, error, class.word()],
    )?;
    let over = class == ErrorClass::Retryable && failures >= retry.attempts;
    if class == ErrorClass::Fatal || over {
        end(t, id, JobState::Dead, now, now)?;
        note(t, now, id, ChangeKind::Died, job.attempt, error)?;
        return Ok(JobFate::Dead);
    }
    let due = now + retry.delay_s(failures);
    end(t, id, JobState::Pending, now, due)?;
    note(t, now, id, ChangeKind::Retried, job.attempt, error)?;
    Ok(JobFate::Retry { due })
}

/// Takes back the leases that have run out.
fn expire(t: &Transaction<'_>, now: f64) -> rusqlite::Result<()> {
    let silent: Vec<JobStatus> = t
        .prepare(&format!(
            "SELECT {COLUMNS} FROM jobs WHERE state = 'leased' AND lease_until < ?1 ORDER BY place"
        ))?
        .query_map([now], status)?
        .collect::<rusqlite::Result<_>>()?;
    for job in silent {
        let who = job.worker.as_deref().unwrap_or("its worker");
        let error = format!("{who} fell silent");
        note(t, now, &job.job.id, ChangeKind::Expired, job.attempt, &error)?;
        count_failure(t, now, &job, ErrorClass::Retryable, &error)?;
    }
    Ok(())
}

/// The job as this lease holds it, or why the lease is lost.
pub(crate) fn held(
    t: &Transaction<'_>,
    lease: &JobLease,
) -> rusqlite::Result<Result<JobStatus, EngineError>> {
    let lost = EngineError::Lost { job: lease.job.id.clone(), attempt: lease.attempt };
    Ok(find(t, &lease.job.id)?
        .filter(|job| job.state == JobState::Leased && job.attempt == lease.attempt)
        .ok_or(lost))
}

impl JobEngine for EmbeddedEngine {
    fn publish(&self, job: &Job) -> Result<Published, EngineError> {
        self.write(|t, now| {
            let known = find(t, &job.id)?;
            let same = known.as_ref().is_some_and(|k| k.job.payload == job.payload);
            if !same && known.as_ref().is_some_and(|k| k.state == JobState::Leased) {
                return Ok(Err(EngineError::InProgress(job.id.clone())));
            }
            let (n, r) = (&job.needs, &job.retry);
            let memory = i64::try_from(n.memory_bytes).unwrap_or(i64::MAX);
            t.execute(
                "INSERT INTO jobs (id, payload, priority, cores, memory_bytes, accelerators, attempts,
                   first_delay_s, longest_delay_s, state, attempt, failures, due)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8, ?9, 'pending', 0, 0, ?10)
                 ON CONFLICT (id) DO UPDATE SET payload = excluded.payload, priority = excluded.priority,
                   cores = excluded.cores, memory_bytes = excluded.memory_bytes,
                   accelerators = excluded.accelerators, attempts = excluded.attempts,
                   first_delay_s = excluded.first_delay_s, longest_delay_s = excluded.longest_delay_s",
                params![
                    job.id,
                    job.payload,
                    job.priority,
                    n.cores,
                    memory,
                    n.accelerators,
                    r.attempts.max(1),
                    r.first_delay_s,
                    r.longest_delay_s,
                    now
                ],
            )?;
            if same {
                return Ok(Ok(Published::Known));
            }
            let attempt = known.as_ref().map_or(0, |k| k.attempt);
            note(t, now, &job.id, ChangeKind::Published, attempt, "")?;
            if known.is_none() {
                return Ok(Ok(Published::New));
            }
            t.execute(
                "UPDATE jobs SET state = 'pending', failures = 0, due = ?2, outcome = NULL, error = NULL,
                   error_class = NULL WHERE id = ?1",
                params![job.id, now],
            )?;
            Ok(Ok(Published::Changed))
        })
    }

    fn claim(&self, offer: &WorkerOffer) -> Result<Option<JobLease>, EngineError> {
        self.write(|t, now| {
            expire(t, now)?;
            let waiting: Vec<JobStatus> = t
                .prepare(&format!(
                    "SELECT {COLUMNS} FROM jobs WHERE state = 'pending' AND due <= ?1 ORDER BY priority DESC, place"
                ))?
                .query_map([now], status)?
                .collect::<rusqlite::Result<_>>()?;
            let jobs: Vec<&Job> = waiting.iter().map(|status| &status.job).collect();
            let first = turns(&jobs, &offer.free, &offer.whole).iter().position(|turn| turn.fits);
            let Some(found) = first.and_then(|i| waiting.into_iter().nth(i)) else { return Ok(Ok(None)) };
            let (attempt, until) = (found.attempt + 1, now + offer.lease_s);
            t.execute(
                "UPDATE jobs SET state = 'leased', attempt = ?2, worker = ?3, lease_until = ?4, started = ?5,
                   ended = NULL WHERE id = ?1",
                params![found.job.id, attempt, offer.worker, until, now],
            )?;
            note(t, now, &found.job.id, ChangeKind::Claimed, attempt, &offer.worker)?;
            let (worker, lease_s, failures) = (offer.worker.clone(), offer.lease_s, found.failures);
            Ok(Ok(Some(JobLease { job: found.job, attempt, worker, failures, until, lease_s })))
        })
    }

    fn heartbeat(&self, lease: &JobLease) -> Result<f64, EngineError> {
        self.write(|t, now| {
            if let Err(lost) = held(t, lease)? {
                return Ok(Err(lost));
            }
            let until = now + lease.lease_s;
            t.execute("UPDATE jobs SET lease_until = ?2 WHERE id = ?1", params![lease.job.id, until])?;
            Ok(Ok(until))
        })
    }

    fn complete(&self, lease: &JobLease, outcome: &str) -> Result<Completed, EngineError> {
        self.write(|t, now| {
            let id = &lease.job.id;
            let before = find(t, id)?.is_some_and(|job| {
                job.state == JobState::Done
                    && job.attempt == lease.attempt
                    && job.outcome.as_deref() == Some(outcome)
            });
            if before {
                return Ok(Ok(Completed::Before));
            }
            if let Err(lost) = held(t, lease)? {
                return Ok(Err(lost));
            }
            end(t, id, JobState::Done, now, now)?;
            t.execute(
                "UPDATE jobs SET outcome = ?2, error = NULL, error_class = NULL WHERE id = ?1",
                params![id, outcome],
            )?;
            note(t, now, id, ChangeKind::Completed, lease.attempt, outcome)?;
            Ok(Ok(Completed::Now))
        })
    }

    fn fail(&self, lease: &JobLease, class: ErrorClass, error: &str) -> Result<JobFate, EngineError> {
        self.write(|t, now| {
            let job = match held(t, lease)? {
                Ok(job) => job,
                Err(lost) => return Ok(Err(lost)),
            };
            if class == ErrorClass::Stopped {
                end(t, &lease.job.id, JobState::Pending, now, now)?;
                note(t, now, &lease.job.id, ChangeKind::Released, lease.attempt, error)?;
                return Ok(Ok(JobFate::Released));
            }
            count_failure(t, now, &job, class, error).map(Ok)
        })
    }

    fn revive(&self, id: &str) -> Result<(), EngineError> {
        self.write(|t, now| {
            let Some(job) = find(t, id)?.filter(|job| job.state == JobState::Dead) else {
                return Ok(Err(EngineError::Unknown(id.into())));
            };
            t.execute(
                "UPDATE jobs SET state = 'pending', failures = 0, due = ?2 WHERE id = ?1",
                params![id, now],
            )?;
            note(t, now, id, ChangeKind::Revived, job.attempt, "")?;
            Ok(Ok(()))
        })
    }

    fn watch(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError> {
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

    fn jobs(&self) -> Result<Vec<JobStatus>, EngineError> {
        self.read(|c| {
            c.prepare(&format!("SELECT {COLUMNS} FROM jobs ORDER BY place"))?.query_map([], status)?.collect()
        })
    }
}
