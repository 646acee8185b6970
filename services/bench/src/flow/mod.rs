//! What the dataflow promises, as ratios that anyone can measure again: `segwild bench flow`.
//!
//! Each row puts the program through a run that would show the promise broken, and prints a number beside its bar.

mod kills;
mod memory;
mod overlap;
mod page;
mod remote;
mod row;
mod scene;
mod waiting;

pub use page::{over, page};
pub use row::{FlowError, FlowOptions, ROWS, Row};
pub use waiting::{Waits, waiting};

use row::io;
use segwild_flow::files;
use std::path::Path;

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
    if wanted("remote") {
        tell(remote::remote(options)?)?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_eval::record::Provenance;

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
