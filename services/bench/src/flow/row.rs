//! A row, how rows are measured, and why one cannot be.

use segwild_pipeline::{RunError, SettingsError};
use segwild_synthetic::SyntheticError;
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::PathBuf;

/// The rows, in order.
pub const ROWS: [&str; 7] = ["overlap", "accelerator", "remote", "cost", "cache", "kills", "memory"];

/// How to measure.
#[derive(Clone, Debug)]
pub struct FlowOptions {
    /// Scenes and runs go here; what is there is removed.
    pub dir: PathBuf,
    /// The `segwild` program, for what needs a process of its own.
    pub program: PathBuf,
    /// Which of [`ROWS`]; all when empty.
    pub only: Vec<String>,
    /// How many runs are killed.
    pub kills: usize,
    /// Photos of the small and of the large scene whose memory is compared.
    pub photos: [usize; 2],
}

/// One measured promise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Its name, one of [`ROWS`], or that with a part.
    pub name: String,
    /// What is measured.
    pub what: Cow<'static, str>,
    /// The number.
    pub value: f64,
    /// What it must not exceed.
    pub bar: f64,
    /// The numbers it comes from.
    pub from: String,
    /// The machine's load average over the last minute, just after the row was measured, if the system reports it.
    pub load: Option<f64>,
}

impl Row {
    /// Whether the promise is kept.
    pub fn holds(&self) -> bool {
        self.value <= self.bar
    }
}

/// Why a row cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum FlowError {
    /// The scene could not be made.
    #[error(transparent)]
    Synthetic(#[from] SyntheticError),
    /// A run failed.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A setting was refused.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A file or a process of the benchmark.
    #[error("{what}: {source}")]
    Io {
        /// What was tried.
        what: String,
        /// The system's error.
        source: std::io::Error,
    },
    /// A child process did not do its work.
    #[error("{0}")]
    Child(String),
    /// There is no row of this name.
    #[error("there is no row `{0}`; the rows are overlap, accelerator, remote, cost, cache, kills, memory")]
    Unknown(String),
}

/// Names what was tried when the system refuses.
pub(super) fn io<T>(what: impl Into<String>, result: std::io::Result<T>) -> Result<T, FlowError> {
    result.map_err(|source| FlowError::Io { what: what.into(), source })
}
