//! What a run has done: `run.sqlite`, written by one process, readable by any number of others meanwhile.
//!
//! SQLite in WAL mode. A row about a view is committed without waiting for the disk (after a power cut it may be
//! missing, and the view is looked up in the cache again); a row that says that a stage or a checkpoint is
//! complete waits for the disk, after the files it speaks of were synced. After a kill nothing committed is
//! lost. The writer holds a lock on `run.lock`, which the system releases when the process ends, however it
//! ends.
//!
//! ```
//! use segwild_flow::{Key, Ledger};
//! use segwild_flow::ledger::{State, ViewOutcome};
//! let folder = tempfile::tempdir().unwrap();
//! let path = folder.path().join("run.sqlite");
//! let key = Key::of("geometry").value("steps", 3000).finish();
//! {
//!     let ledger = Ledger::open(&path).unwrap();
//!     assert!(!ledger.stage_is_done("geometry", &key).unwrap());
//!     ledger.start_stage("geometry", &key).unwrap();
//!     ledger.record_view("geometry", "a.jpg", &key, &ViewOutcome::done(0.25)).unwrap();
//!     ledger.finish_stage("geometry", &key, Some(11.5)).unwrap();
//!     assert!(Ledger::open(&path).unwrap_err().to_string().contains("in use"));
//! }
//! let status = Ledger::open_read_only(&path).unwrap();
//! assert!(status.stage_is_done("geometry", &key).unwrap());
//! let other = Key::of("geometry").value("steps", 500).finish();
//! assert!(!status.stage_is_done("geometry", &other).unwrap(), "done, but under another key");
//! assert_eq!(status.stages().unwrap()[0].state, State::Done);
//! ```

mod copy;
mod error;
mod live;
mod live_rows;
mod lock;
mod open;
mod rows;
mod schema;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rusqlite::{Connection, Transaction, params};

pub use error::LedgerError;
pub use live::{
    LiveActor, LiveMailbox, LiveMetric, LiveSample, LiveStage, LiveWorker, PastSample, ViewCounts,
};
pub use lock::Owner;
pub use rows::{CheckpointRow, EventRow, StageRow, State, ViewOutcome, ViewRow};
pub use schema::SCHEMA_VERSION;

use crate::clock::now;
use crate::events::{EventLevel, EventRecord};
use crate::fault;
use crate::files::FileError;
use crate::key::Key;
use crate::lock as hold;

struct Inner {
    path: PathBuf,
    connection: Mutex<Connection>,
    /// Held as long as the ledger is open for writing.
    _lock: Option<lock::RunLock>,
}

/// A run's ledger; clones share the connection and may be used from any thread.
#[derive(Clone)]
pub struct Ledger {
    inner: Arc<Inner>,
}

impl std::fmt::Debug for Ledger {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Ledger({})", self.inner.path.display())
    }
}

/// How durable a commit is.
#[derive(Clone, Copy)]
enum Commit {
    /// Survives a kill.
    Quick,
    /// Survives a power cut.
    Full,
}

impl Ledger {
    /// Opens the ledger for writing, or makes it and its folder. Stages that a killed process left running
    /// become pending, and an event says so.
    ///
    /// # Errors
    /// In words: in use by another process, another format, damaged, disk full, read-only.
    pub fn open(path: impl Into<PathBuf>) -> Result<Self, LedgerError> {
        let path = path.into();
        let lock = lock::RunLock::take(&path)?;
        let error = |e| LedgerError::sqlite(&path, e);
        let mut connection = Connection::open(&path).map_err(error)?;
        connection.busy_timeout(Duration::from_secs(10)).map_err(error)?;
        open::prepare(&mut connection, &path)?;
        let ledger =
            Self { inner: Arc::new(Inner { path, connection: Mutex::new(connection), _lock: Some(lock) }) };
        ledger.recover()?;
        Ok(ledger)
    }

    /// Opens a ledger for reading, also while another process writes it.
    ///
    /// # Errors
    /// In words: missing, another format, damaged.
    pub fn open_read_only(path: impl Into<PathBuf>) -> Result<Self, LedgerError> {
        let path = path.into();
        if !path.is_file() {
            return Err(LedgerError::Missing { path });
        }
        let connection = open::open_for_reading(&path)?;
        open::check(&connection, &path)?;
        Ok(Self { inner: Arc::new(Inner { path, connection: Mutex::new(connection), _lock: None }) })
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.inner.path
    }

    /// The process that writes this run now, if any; a stage that is running without one was interrupted.
    pub fn owner(&self) -> Option<Owner> {
        lock::owner(&self.inner.path)
    }

    fn read<T>(&self, query: impl FnOnce(&Connection) -> rusqlite::Result<T>) -> Result<T, LedgerError> {
        query(&hold(&self.inner.connection)).map_err(|e| LedgerError::sqlite(&self.inner.path, e))
    }

    fn write<T>(
        &self,
        commit: Commit,
        change: impl FnOnce(&Transaction<'_>) -> rusqlite::Result<T>,
    ) -> Result<T, LedgerError> {
        fault::point("ledger.commit").map_err(|e| FileError::new("write", &self.inner.path, e))?;
        let mut connection = hold(&self.inner.connection);
        let run = || {
            connection.pragma_update(
                None,
                "synchronous",
                match commit {
                    Commit::Quick => "NORMAL",
                    Commit::Full => "FULL",
                },
            )?;
            let transaction =
                connection.transaction_with_behavior(rusqlite::TransactionBehavior::Immediate)?;
            let value = change(&transaction)?;
            transaction.commit()?;
            Ok(value)
        };
        run().map_err(|e| LedgerError::sqlite(&self.inner.path, e))
    }

    fn recover(&self) -> Result<(), LedgerError> {
        let interrupted: Vec<String> = self
            .stages()?
            .into_iter()
            .filter(|stage| stage.state == State::Running)
            .map(|stage| stage.name)
            .collect();
        if interrupted.is_empty() {
            return Ok(());
        }
        self.write(Commit::Full, |t| {
            for stage in &interrupted {
                t.execute("UPDATE stages SET state = 'pending' WHERE name = ?1", [stage])?;
                t.execute(
                    "INSERT INTO events (time, level, stage, message) VALUES (?1, 'warning', ?2, ?3)",
                    params![now(), stage, "was interrupted; continues"],
                )?;
            }
            Ok(())
        })
    }

    /// A stage starts under a key. What was recorded of it under another key is forgotten.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn start_stage(&self, stage: &str, key: &Key) -> Result<(), LedgerError> {
        let key = key.to_string();
        self.write(Commit::Quick, |t| {
            t.execute(
                "INSERT INTO stages (name, key, state, started, runs) VALUES (?1, ?2, 'running', ?3, 1)
                 ON CONFLICT (name) DO UPDATE SET
                   runs = CASE WHEN key = excluded.key THEN runs + 1 ELSE 1 END,
                   key = excluded.key, state = 'running', started = excluded.started,
                   ended = NULL, cpu_s = NULL, error = NULL",
                params![stage, key, now()],
            )?;
            Ok(())
        })
    }

    /// A stage is done; waits for the disk. `cpu_s`: processor seconds it took, if known.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn finish_stage(&self, stage: &str, key: &Key, cpu_s: Option<f64>) -> Result<(), LedgerError> {
        self.end_stage(stage, key, State::Done, cpu_s, None)
    }

    /// A stage failed; waits for the disk.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn fail_stage(&self, stage: &str, key: &Key, error: &str) -> Result<(), LedgerError> {
        self.end_stage(stage, key, State::Failed, None, Some(error))
    }

    /// Stages that are under way are left where they are, to be continued.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn leave_stages(&self) -> Result<(), LedgerError> {
        self.write(Commit::Full, |t| {
            t.execute("UPDATE stages SET state = 'pending' WHERE state = 'running'", [])?;
            Ok(())
        })
    }

    fn end_stage(
        &self,
        stage: &str,
        key: &Key,
        state: State,
        cpu_s: Option<f64>,
        error: Option<&str>,
    ) -> Result<(), LedgerError> {
        let key = key.to_string();
        self.write(Commit::Full, |t| {
            t.execute(
                "INSERT INTO stages (name, key, state, started, ended, cpu_s, error, runs)
                 VALUES (?1, ?2, ?3, ?4, ?4, ?5, ?6, 1)
                 ON CONFLICT (name) DO UPDATE SET key = excluded.key, state = excluded.state,
                   ended = excluded.ended, cpu_s = excluded.cpu_s, error = excluded.error",
                params![stage, key, state.word(), now(), cpu_s, error],
            )?;
            Ok(())
        })
    }

    /// Whether a stage is done under this very key.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn stage_is_done(&self, stage: &str, key: &Key) -> Result<bool, LedgerError> {
        self.read(|c| {
            c.query_row(
                "SELECT EXISTS (SELECT 1 FROM stages WHERE name = ?1 AND key = ?2 AND state = 'done')",
                params![stage, key.to_string()],
                |row| row.get(0),
            )
        })
    }

    /// The stages, in the order in which they were first started.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn stages(&self) -> Result<Vec<StageRow>, LedgerError> {
        self.read(|c| {
            c.prepare(
                "SELECT name, key, state, started, ended, cpu_s, error, runs FROM stages ORDER BY rowid",
            )?
            .query_map([], StageRow::read)?
            .collect()
        })
    }

    /// Records what came of one view's work; a later record replaces an earlier one.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn record_view(
        &self,
        stage: &str,
        view: &str,
        key: &Key,
        outcome: &ViewOutcome,
    ) -> Result<(), LedgerError> {
        let key = key.to_string();
        self.write(Commit::Quick, |t| {
            t.execute(
                "INSERT INTO views (stage, view, key, state, attempts, seconds, error, time)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7, ?8)
                 ON CONFLICT (stage, view) DO UPDATE SET key = excluded.key, state = excluded.state,
                   attempts = excluded.attempts, seconds = excluded.seconds, error = excluded.error,
                   time = excluded.time",
                params![
                    stage,
                    view,
                    key,
                    outcome.state.word(),
                    outcome.attempts,
                    outcome.seconds,
                    outcome.error,
                    now()
                ],
            )?;
            Ok(())
        })
    }

    /// Forgets the views of a stage that are not among `kept`: an earlier run recorded them, and this one makes nothing of them.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn forget_other_views(&self, stage: &str, kept: &BTreeSet<&str>) -> Result<(), LedgerError> {
        let recorded = self.views(stage)?;
        let others: Vec<&str> =
            recorded.iter().map(|row| row.view.as_str()).filter(|view| !kept.contains(view)).collect();
        if others.is_empty() {
            return Ok(());
        }
        self.write(Commit::Quick, |t| {
            for view in others {
                t.execute("DELETE FROM views WHERE stage = ?1 AND view = ?2", params![stage, view])?;
            }
            Ok(())
        })
    }

    /// The views of a stage, by name.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn views(&self, stage: &str) -> Result<Vec<ViewRow>, LedgerError> {
        self.read(|c| {
            c.prepare(
                "SELECT view, key, state, attempts, seconds, error FROM views WHERE stage = ?1 ORDER BY view",
            )?
            .query_map([stage], ViewRow::read)?
            .collect()
        })
    }

    /// Records a checkpoint whose file is complete and synced; waits for the disk.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn record_checkpoint(&self, row: &CheckpointRow) -> Result<(), LedgerError> {
        self.write(Commit::Full, |t| {
            t.execute(
                "INSERT OR REPLACE INTO checkpoints (stage, key, step, file, digest, time)
                 VALUES (?1, ?2, ?3, ?4, ?5, ?6)",
                params![row.stage, row.key, row.step as i64, row.file, row.digest, now()],
            )?;
            Ok(())
        })
    }

    /// The checkpoints of a stage under a key, the latest step first: a damaged one falls back to the next.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn checkpoints(&self, stage: &str, key: &Key) -> Result<Vec<CheckpointRow>, LedgerError> {
        self.read(|c| {
            c.prepare(
                "SELECT stage, key, step, file, digest FROM checkpoints WHERE stage = ?1 AND key = ?2
                 ORDER BY step DESC",
            )?
            .query_map(params![stage, key.to_string()], CheckpointRow::read)?
            .collect()
        })
    }

    /// The checkpoints of a stage under whatever key.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn all_checkpoints(&self, stage: &str) -> Result<Vec<CheckpointRow>, LedgerError> {
        self.read(|c| {
            c.prepare("SELECT stage, key, step, file, digest FROM checkpoints WHERE stage = ?1")?
                .query_map([stage], CheckpointRow::read)?
                .collect()
        })
    }

    /// Forgets a checkpoint whose file was removed or found damaged.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn forget_checkpoint(&self, row: &CheckpointRow) -> Result<(), LedgerError> {
        self.write(Commit::Quick, |t| {
            t.execute(
                "DELETE FROM checkpoints WHERE stage = ?1 AND key = ?2 AND step = ?3",
                params![row.stage, row.key, row.step as i64],
            )?;
            Ok(())
        })
    }

    /// Writes down an event, if it is worth keeping (progress and metrics are not): a sink for
    /// [`Events`](crate::Events).
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn record_event(&self, record: &EventRecord) -> Result<(), LedgerError> {
        let level = record.event.level();
        if level == EventLevel::Detail {
            return Ok(());
        }
        let message = serde_json::to_string(&record.event).unwrap_or_default();
        self.write(Commit::Quick, |t| {
            t.execute(
                "INSERT INTO events (time, level, stage, message) VALUES (?1, ?2, ?3, ?4)",
                params![record.time, rows::level_word(level), record.event.stage(), message],
            )?;
            Ok(())
        })
    }

    /// The last events, oldest first.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn last_events(&self, count: usize) -> Result<Vec<EventRow>, LedgerError> {
        self.read(|c| {
            c.prepare(
                "SELECT time, level, stage, message FROM
                   (SELECT * FROM events ORDER BY id DESC LIMIT ?1) ORDER BY id",
            )?
            .query_map([i64::try_from(count).unwrap_or(i64::MAX)], EventRow::read)?
            .collect()
        })
    }

    /// Stores the run's effective settings, replacing those of before; names and texts.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn set_settings<'a>(
        &self,
        settings: impl IntoIterator<Item = (&'a str, &'a str)>,
    ) -> Result<(), LedgerError> {
        self.write(Commit::Full, |t| {
            t.execute("DELETE FROM settings", [])?;
            for (name, value) in settings {
                t.execute("INSERT OR REPLACE INTO settings (name, value) VALUES (?1, ?2)", [name, value])?;
            }
            Ok(())
        })
    }

    /// The run's settings, by name.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn settings(&self) -> Result<Vec<(String, String)>, LedgerError> {
        self.read(|c| {
            c.prepare("SELECT name, value FROM settings ORDER BY name")?
                .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
                .collect()
        })
    }
}
