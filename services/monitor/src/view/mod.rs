//! The view: what a run or a batch is doing, or did, read from its ledger.
//!
//! Whatever shows something to an operator shows this, so that no two displays disagree.

mod batch;
mod farm;
mod folder;
mod run;
mod runs;
mod scene;
mod stage;
mod why;

use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use segwild_farm::BatchFolder;
use serde::{Deserialize, Serialize};

pub use crate::disk::Disk;
pub use batch::BatchView;
pub use farm::{FarmSample, FarmTarget, FarmView, FarmWorkerView};
pub use folder::ViewError;
pub use run::{LoggedEvent, MailboxView, PhotoFailure, RunState, RunView, STALE_S, SelectionView};
pub use runs::Runs;
pub use scene::{SceneState, SceneView};
pub use stage::{ActorView, StageView, WorkerView};

/// What is shown.
#[derive(Clone, Debug)]
pub enum MonitorTarget {
    /// A run's folder.
    Run(PathBuf),
    /// A batch's folder.
    Batch(BatchFolder),
    /// A farm: all its scenes, whoever works on them.
    Farm(FarmTarget),
}

impl MonitorTarget {
    /// Finds out what a folder is.
    ///
    /// # Errors
    /// When it is neither a run's nor a batch's.
    pub fn at(path: &Path) -> Result<MonitorTarget, ViewError> {
        if let Some(batch) = BatchFolder::open(path) {
            return Ok(MonitorTarget::Batch(batch));
        }
        folder::open_run(path).map(|_| MonitorTarget::Run(path.to_owned()))
    }

    /// How it is now.
    ///
    /// # Errors
    /// When its ledger cannot be read.
    pub fn view(&self) -> Result<MonitorView, ViewError> {
        self.read(&mut Runs::default())
    }

    /// How it is now, for repeated reads.
    ///
    /// # Errors
    /// When its ledger cannot be read.
    pub fn read(&self, runs: &mut Runs) -> Result<MonitorView, ViewError> {
        Ok(match self {
            MonitorTarget::Run(path) => MonitorView::Run(Box::new(runs.view(path, now())?)),
            MonitorTarget::Batch(folder) => {
                MonitorView::Batch(Box::new(BatchView::read(folder, runs, now())?))
            }
            MonitorTarget::Farm(farm) => MonitorView::Batch(Box::new(farm.view()?)),
        })
    }
}

impl FarmTarget {
    /// How it is now.
    ///
    /// # Errors
    /// When the farm cannot be read.
    pub fn view(&self) -> Result<BatchView, ViewError> {
        BatchView::of_farm(self, now())
    }
}

/// A run or a batch at one time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum MonitorView {
    /// One scene.
    Run(Box<RunView>),
    /// Many.
    Batch(Box<BatchView>),
}

impl MonitorView {
    /// The runs that it shows: one, or those of a batch that have started.
    pub fn runs(&self) -> Vec<&RunView> {
        match self {
            MonitorView::Run(run) => vec![run],
            MonitorView::Batch(batch) => batch.scenes.iter().filter_map(|s| s.run.as_deref()).collect(),
        }
    }

    /// When it was taken, in seconds since 1970.
    pub fn time(&self) -> f64 {
        match self {
            MonitorView::Run(run) => run.time,
            MonitorView::Batch(batch) => batch.time,
        }
    }

    /// Whether a process works on it now.
    pub fn is_running(&self) -> bool {
        match self {
            MonitorView::Run(run) => run.state == RunState::Running,
            MonitorView::Batch(batch) => batch.owner.is_some(),
        }
    }
}

pub(crate) fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}
