//! What the dataflow promises, as ratios that anyone can measure again: `segwild bench flow`.
//!
//! Each row puts the program through a run that would show the promise broken, and prints a number beside its bar.

mod kills;
mod memory;
mod overlap;
mod waiting;

pub use waiting::{Calls, Waits, counted, waiting};

use crate::synthetic::{LookKind, Manifest, SyntheticError, SyntheticOptions, generate};
use segwild_pipeline::{RunError, Settings, SettingsError};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// The rows, in order.
pub const ROWS: [&str; 5] = ["overlap", "cost", "cache", "kills", "memory"];

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
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Row {
    /// Its name, one of [`ROWS`], or that with a part.
    pub name: String,
    /// What is measured.
    pub what: &'static str,
    /// The number.
    pub value: f64,
    /// What it must not exceed.
    pub bar: f64,
    /// The numbers it comes from.
    pub from: String,
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
    /// A row was asked for that does not exist.
    #[error("there is no row `{0}`; the rows are overlap, cost, cache, kills, memory")]
    Unknown(String),
}

/// Names what was tried when the system refuses.
fn io<T>(what: impl Into<String>, result: std::io::Result<T>) -> Result<T, FlowError> {
    result.map_err(|source| FlowError::Io { what: what.into(), source })
}

/// Measures the rows; `told` hears of each as soon as it is known.
///
/// # Errors
/// When a run fails that should not, or the machine refuses.
pub fn flow(options: &FlowOptions, mut told: impl FnMut(&Row)) -> Result<Vec<Row>, FlowError> {
    if let Some(unknown) = options.only.iter().find(|o| !ROWS.contains(&o.as_str())) {
        return Err(FlowError::Unknown(unknown.clone()));
    }
    let wanted = |name: &str| options.only.is_empty() || options.only.iter().any(|o| o == name);
    let mut rows = Vec::new();
    let mut tell = |more: Vec<Row>| {
        more.iter().for_each(&mut told);
        rows.extend(more);
    };
    if wanted("overlap") || wanted("cache") {
        tell(overlap::overlap(options)?.into_iter().filter(|r| wanted(&r.name)).collect());
    }
    if wanted("cost") {
        tell(overlap::cost(options)?);
    }
    if wanted("kills") {
        tell(kills::kills(options)?);
    }
    if wanted("memory") {
        tell(memory::memory(options)?);
    }
    Ok(rows)
}

/// The rows as a page.
pub fn page(rows: &[Row]) -> String {
    let mut text = String::from(
        "# The dataflow, measured\n\nThis page is generated: `segwild bench flow --page docs/flow.md`. Every number is a ratio \
         or a count, so that it says the same on another machine.\n\n| row | what | measured | bar | from |\n\
         |---|---|---:|---:|---|\n",
    );
    for r in rows {
        text += &format!(
            "| {} | {} | {:.3} | {} {} | {} |\n",
            r.name,
            r.what,
            r.value,
            if r.holds() { "<=" } else { "**over**" },
            r.bar,
            r.from
        );
    }
    text
}

/// A small place with `train` photos, written to `dir`.
fn place(dir: &Path, train: usize, long_side: u32) -> Result<Manifest, FlowError> {
    let options = SyntheticOptions {
        train,
        test: train.div_ceil(10),
        long_side,
        points: 800,
        occlusion: 0.0,
        look: LookKind::Affine,
        ..SyntheticOptions::small()
    };
    Ok(generate(&options)?.write(dir)?)
}

/// A quick preset, with changes.
fn settings(changes: &[(&str, &str)]) -> Result<Settings, FlowError> {
    let pairs: Vec<(String, String)> = [("preset", "draft")]
        .iter()
        .chain(changes)
        .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
        .collect();
    Ok(Settings::layered(None, &pairs)?)
}

/// A folder of its own, empty.
fn fresh(dir: &Path) -> Result<PathBuf, FlowError> {
    if dir.exists() {
        io(format!("remove {}", dir.display()), std::fs::remove_dir_all(dir))?;
    }
    io(format!("create {}", dir.display()), std::fs::create_dir_all(dir))?;
    Ok(dir.to_owned())
}
