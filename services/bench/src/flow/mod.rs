//! What the dataflow promises, as ratios that anyone can measure again: `segwild bench flow`.
//!
//! Each row puts the program through a run that would show the promise broken, and prints a number beside its bar.

mod kills;
mod memory;
mod overlap;
mod waiting;

pub use waiting::{Calls, Waits, counted, waiting};

use segwild_eval::record::Provenance;
use segwild_eval::stamp;
use segwild_flow::files;
use segwild_pipeline::{RunError, Settings, SettingsError};
use segwild_synthetic::{LightVariation, Manifest, SyntheticError, SyntheticOptions, generate};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// The rows, in order.
pub const ROWS: [&str; 6] = ["overlap", "accelerator", "cost", "cache", "kills", "memory"];

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
    #[error("there is no row `{0}`; the rows are overlap, accelerator, cost, cache, kills, memory")]
    Unknown(String),
}

/// Names what was tried when the system refuses.
fn io<T>(what: impl Into<String>, result: std::io::Result<T>) -> Result<T, FlowError> {
    result.map_err(|source| FlowError::Io { what: what.into(), source })
}

/// Measures the rows; `report` receives each as soon as it is known.
///
/// # Errors
/// When a run fails that should not, or the machine refuses.
pub fn flow(options: &FlowOptions, mut report: impl FnMut(&Row)) -> Result<Vec<Row>, FlowError> {
    if let Some(unknown) = options.only.iter().find(|o| !ROWS.contains(&o.as_str())) {
        return Err(FlowError::Unknown(unknown.clone()));
    }
    let wanted = |name: &str| options.only.is_empty() || options.only.iter().any(|o| o == name);
    let mut rows = Vec::new();
    io(format!("create {}", options.dir.display()), std::fs::create_dir_all(&options.dir))?;
    let mut tell = |mut more: Vec<Row>| -> Result<(), FlowError> {
        more.iter_mut().for_each(|row| row.load = load_average());
        more.iter().for_each(&mut report);
        rows.extend(more);
        keep(&options.dir, &rows)
    };
    if wanted("overlap") || wanted("cache") {
        tell(overlap::overlap(options)?.into_iter().filter(|r| wanted(&r.name)).collect())?;
    }
    if wanted("accelerator") {
        tell(overlap::accelerator(options)?)?;
    }
    if wanted("cost") {
        tell(overlap::cost(options)?)?;
    }
    if wanted("kills") {
        tell(kills::kills(options)?)?;
    }
    if wanted("memory") {
        tell(memory::memory(options)?)?;
    }
    Ok(rows)
}

/// The file in [`FlowOptions::dir`] that holds every row as it was measured last.
const KEPT: &str = "rows.json";

/// Puts new rows in the place of those of the same name that were measured before.
fn keep(dir: &Path, new: &[Row]) -> Result<(), FlowError> {
    let mut rows: Vec<Row> =
        measured(dir).into_iter().filter(|r| new.iter().all(|n| n.name != r.name)).collect();
    rows.extend_from_slice(new);
    // In the order of the list, whatever was measured last.
    rows.sort_by_key(|r| ROWS.iter().position(|name| r.name.split(',').next() == Some(*name)));
    let path = dir.join(KEPT);
    // Numbers and strings only: nothing here can fail to serialise.
    let text = serde_json::to_string_pretty(&rows).unwrap_or_default();
    io(format!("write {}", path.display()), files::write_plain(&path, text))
}

/// Every row as it was measured last in this folder, also by earlier calls with other [`FlowOptions::only`]. Empty
/// where nothing was measured yet.
pub fn measured(dir: &Path) -> Vec<Row> {
    let text = std::fs::read_to_string(dir.join(KEPT)).unwrap_or_default();
    serde_json::from_str(&text).unwrap_or_default()
}

/// How many threads wanted a core, on average over the last minute.
fn load_average() -> Option<f64> {
    std::fs::read_to_string("/proc/loadavg").ok()?.split_whitespace().next()?.parse().ok()
}

/// The rows that are over their bars, in words; nothing where all keep to them.
pub fn over(rows: &[Row]) -> Option<String> {
    let over: Vec<String> = rows
        .iter()
        .filter(|r| !r.holds())
        .map(|r| format!("{} is {:.3}, its bar {}", r.name, r.value, r.bar))
        .collect();
    (!over.is_empty())
        .then(|| format!("{} of {} rows over the bar: {}", over.len(), rows.len(), over.join("; ")))
}

/// The rows as a page; those that are over their bars are named first.
pub fn page(rows: &[Row], made: &Provenance) -> String {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let first = over(rows).map_or("All rows keep to their bars.".into(), |over| format!("**{over}.**"));
    let stamp = stamp::stamp(made, &["built-in, and one that waits in `overlap` and `accelerator`"]);
    let mut text = format!(
        "# The dataflow, measured\n\n{first} This page is generated. {stamp}\n\nEvery number is a ratio \
         or a count. A ratio of times is the median over pairs of runs, each pair back to back; all of them are listed. \
         The load is the machine's average over a minute, on {cores} cores: what is over {cores} had to wait for a \
         core.\n\n| row | what | measured | bar | load | from |\n|---|---|---:|---:|---:|---|\n",
    );
    for r in rows {
        text += &format!(
            "| {} | {} | {:.3} | {} {} | {} | {} |\n",
            r.name,
            r.what,
            r.value,
            if r.holds() { "<=" } else { "**over**" },
            r.bar,
            r.load.map_or("unknown".into(), |load| format!("{load:.1}")),
            r.from
        );
    }
    text
}

/// A small synthetic scene with `train` photos, written to `dir`.
fn write_scene(dir: &Path, train: usize, long_side: u32) -> Result<Manifest, FlowError> {
    let options = SyntheticOptions {
        train,
        test: train.div_ceil(10),
        long_side,
        points: 800,
        occlusion: 0.0,
        photo_light: LightVariation::Affine,
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

#[cfg(test)]
mod tests {
    use super::*;

    fn row(name: &str, value: f64) -> Row {
        Row { name: name.into(), what: "w".into(), value, bar: 1.0, from: "f".into(), load: Some(2.5) }
    }

    #[test]
    fn a_row_measured_again_replaces_the_old_one_and_the_others_stay_on_the_page() {
        let dir = tempfile::tempdir().unwrap();
        keep(dir.path(), &[row("memory", 1.3), row("memory, budget", 0.5)]).unwrap();
        keep(dir.path(), &[row("kills", 0.0)]).unwrap();
        keep(dir.path(), &[row("memory", 1.1)]).unwrap();
        let rows = measured(dir.path());
        let found: Vec<(&str, f64)> = rows.iter().map(|r| (r.name.as_str(), r.value)).collect();
        assert_eq!(found, [("kills", 0.0), ("memory, budget", 0.5), ("memory", 1.1)]);
        let made = Provenance { command: "segwild bench flow".into(), ..Provenance::default() };
        let text = page(&rows, &made);
        let first = "# The dataflow, measured\n\n**1 of 3 rows over the bar: memory is 1.100, its bar 1.**";
        assert!(text.starts_with(first) && text.contains("Command: `segwild bench flow`"), "{text}");
        assert!(text.contains("| memory | w | 1.100 | **over** 1 | 2.5 | f |"), "{text}");
    }
}
