//! Whether the work goes as it should: the checks behind `/readyz`.

use serde::{Deserialize, Serialize};

use crate::view::{Disk, MonitorView, ViewError};
use crate::words::{bytes, duration};

/// A disk with less than this share free is nearly full.
pub const DISK_SHARE: f64 = 0.05;
/// A disk with less than this many bytes free is nearly full, whatever its size.
pub const DISK_BYTES: u64 = 512 << 20;

/// One thing that was checked.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReadyCheck {
    /// What.
    pub name: String,
    /// Whether it is as it should be.
    pub ok: bool,
    /// What was seen.
    pub says: String,
}

fn check(name: &str, ok: bool, says: impl Into<String>) -> ReadyCheck {
    ReadyCheck { name: name.into(), ok, says: says.into() }
}

/// Looks at everything that should hold while work goes on.
pub fn ready(view: Result<&MonitorView, &ViewError>) -> Vec<ReadyCheck> {
    let view = match view {
        Ok(view) => view,
        Err(error) => return vec![check("ledger", false, error.to_string())],
    };
    let mut checks = vec![check("ledger", true, "readable")];
    let running: Vec<_> = view.runs().into_iter().filter(|run| run.running).collect();
    let stale: Vec<String> = running
        .iter()
        .filter(|run| run.is_stale())
        .map(|run| match run.age_s {
            Some(age) => format!("{} was last seen {} ago", run.name, duration(age)),
            None => format!("{} has not been seen yet", run.name),
        })
        .collect();
    let fresh = format!("{} running", running.len());
    checks.push(check("live", stale.is_empty(), if stale.is_empty() { fresh } else { stale.join("; ") }));
    let stuck: Vec<String> = running
        .iter()
        .flat_map(|run| {
            run.stuck()
                .map(|(actor, item, s)| format!("{}: {actor} on `{item}` for {}", run.name, duration(s)))
        })
        .collect();
    let none = "nobody is stuck".to_owned();
    checks.push(check("actors", stuck.is_empty(), if stuck.is_empty() { none } else { stuck.join("; ") }));
    let disk = match view {
        MonitorView::Run(run) => run.disk,
        MonitorView::Batch(batch) => batch.disk,
    };
    if let Some(disk) = disk {
        let says = format!("{} of {} free", bytes(disk.free_bytes), bytes(disk.size_bytes));
        checks.push(check("disk", has_free_space(&disk), says));
    }
    if let MonitorView::Batch(batch) = view {
        let runs = batch.owner.is_some();
        checks.push(check("batch", runs, batch.owner.as_deref().unwrap_or("no process runs it")));
    }
    checks
}

/// Whether a disk is not nearly full.
pub fn has_free_space(disk: &Disk) -> bool {
    disk.free_bytes >= DISK_BYTES && disk.free_bytes as f64 >= disk.size_bytes as f64 * DISK_SHARE
}
