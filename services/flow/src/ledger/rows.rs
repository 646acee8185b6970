//! The ledger's rows.

use rusqlite::Row;
use rusqlite::types::Type;
use serde::Serialize;

use crate::events::EventLevel;
use crate::key::Key;

/// How far a piece of work is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Not started, or interrupted.
    Pending,
    /// Under way.
    Running,
    /// Done.
    Done,
    /// Failed; the error says why.
    Failed,
}

impl State {
    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
        }
    }

    fn read(row: &Row<'_>, column: usize) -> rusqlite::Result<Self> {
        let word: String = row.get(column)?;
        [Self::Pending, Self::Running, Self::Done, Self::Failed]
            .into_iter()
            .find(|s| s.word() == word)
            .ok_or_else(|| {
                rusqlite::Error::FromSqlConversionFailure(
                    column,
                    Type::Text,
                    format!("no state `{word}`").into(),
                )
            })
    }
}

/// A stage. Times are seconds since 1970.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageRow {
    /// Its name.
    pub name: String,
    /// The key it was started under: [`Key`]'s `Display`.
    pub key: String,
    /// How far it is.
    pub state: State,
    /// When it began, the last time.
    pub started: Option<f64>,
    /// When it ended.
    pub ended: Option<f64>,
    /// Processor seconds.
    pub cpu_s: Option<f64>,
    /// Why it failed.
    pub error: Option<String>,
    /// How often it was started under this key: more than 1 after interruptions.
    pub runs: u32,
}

impl StageRow {
    pub(super) fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        Ok(Self {
            name: row.get(0)?,
            key: row.get(1)?,
            state: State::read(row, 2)?,
            started: row.get(3)?,
            ended: row.get(4)?,
            cpu_s: row.get(5)?,
            error: row.get(6)?,
            runs: row.get(7)?,
        })
    }
}

/// What came of one view's work.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewOutcome {
    /// How far it is.
    pub state: State,
    /// How often it was tried.
    pub attempts: u32,
    /// How long it took; `None` when it was in the cache.
    pub seconds: Option<f64>,
    /// Why it failed.
    pub error: Option<String>,
}

impl ViewOutcome {
    /// Done at the first attempt, in so many seconds.
    pub fn done(seconds: f64) -> Self {
        Self { state: State::Done, attempts: 1, seconds: Some(seconds), error: None }
    }

    /// Found in the cache.
    pub fn cached() -> Self {
        Self { state: State::Done, attempts: 0, seconds: None, error: None }
    }

    /// Given up.
    pub fn failed(attempts: u32, error: impl Into<String>) -> Self {
        Self { state: State::Failed, attempts, seconds: None, error: Some(error.into()) }
    }
}

/// One view's work for a stage.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ViewRow {
    /// The view.
    pub view: String,
    /// The key of its artefact.
    pub key: String,
    /// What came of it.
    #[serde(flatten)]
    pub outcome: ViewOutcome,
}

impl ViewRow {
    pub(super) fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        let outcome = ViewOutcome {
            state: State::read(row, 2)?,
            attempts: row.get(3)?,
            seconds: row.get(4)?,
            error: row.get(5)?,
        };
        Ok(Self { view: row.get(0)?, key: row.get(1)?, outcome })
    }
}

/// A checkpoint of a stage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CheckpointRow {
    /// The stage.
    pub stage: String,
    /// The key it runs under.
    pub key: String,
    /// The step it was taken after.
    pub step: u64,
    /// The file, relative to the run's folder.
    pub file: String,
    /// The file's blake3 in hexadecimal digits.
    pub digest: String,
}

impl CheckpointRow {
    /// A row for a file's bytes.
    pub fn new(stage: &str, key: &Key, step: u64, file: &str, bytes: &[u8]) -> Self {
        let digest = blake3::hash(bytes).to_hex().to_string();
        Self { stage: stage.into(), key: key.to_string(), step, file: file.into(), digest }
    }

    /// Whether these are the bytes that were recorded.
    pub fn fits(&self, bytes: &[u8]) -> bool {
        blake3::hash(bytes).to_hex().as_str() == self.digest
    }

    pub(super) fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        let step: i64 = row.get(2)?;
        Ok(Self {
            stage: row.get(0)?,
            key: row.get(1)?,
            step: step.max(0) as u64,
            file: row.get(3)?,
            digest: row.get(4)?,
        })
    }
}

/// An event worth keeping.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EventRow {
    /// Seconds since 1970.
    pub time: f64,
    /// `info`, `warning` or `error`.
    pub level: String,
    /// The stage it is about.
    pub stage: Option<String>,
    /// A sentence, or the event as JSON.
    pub message: String,
}

impl EventRow {
    pub(super) fn read(row: &Row<'_>) -> rusqlite::Result<Self> {
        Ok(Self { time: row.get(0)?, level: row.get(1)?, stage: row.get(2)?, message: row.get(3)? })
    }
}

pub(super) fn level_word(level: EventLevel) -> &'static str {
    match level {
        EventLevel::Detail => "detail",
        EventLevel::Info => "info",
        EventLevel::Warning => "warning",
        EventLevel::Error => "error",
    }
}
