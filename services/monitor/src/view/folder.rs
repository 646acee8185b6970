//! Folders of runs: opened, and why there is no view of one.

use std::path::{Path, PathBuf};

use segwild_farm::EngineError;
use segwild_flow::LedgerError;
use segwild_pipeline::RunFolder;

/// Why there is no view.
#[derive(Debug, thiserror::Error)]
pub enum ViewError {
    /// The folder is neither a run's nor a batch's.
    #[error("{}: this is no run folder and no batch folder; `segwild run SCENE --out FOLDER` makes the one, `segwild batch MANIFEST --out FOLDER` the other", .0.display())]
    NoFolder(PathBuf),
    /// The folder is a run's, and is not to be used as it is.
    #[error("{0}")]
    Unusable(String),
    /// A run's ledger cannot be read.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// A batch's engine cannot be read.
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// An existing run's folder; where it is one and is not to be used, why.
pub(super) fn open_run(path: &Path) -> Result<RunFolder, ViewError> {
    RunFolder::open(path).map_err(|error| match RunFolder::at(path).ledger().exists() {
        true => ViewError::Unusable(error.to_string()),
        false => ViewError::NoFolder(path.to_owned()),
    })
}

pub(super) fn name_of(path: &Path) -> String {
    path.file_name().map_or_else(|| path.display().to_string(), |n| n.to_string_lossy().into_owned())
}
