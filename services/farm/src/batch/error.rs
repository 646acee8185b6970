//! Why a batch could not run.

use std::path::PathBuf;

use segwild_flow::process::Owner;

use crate::engine::EngineError;
use crate::manifest::ManifestError;

/// Why a batch could not run.
#[derive(Debug, thiserror::Error)]
pub enum BatchError {
    /// The manifest does not make sense.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The engine could not serve.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A file of the batch folder could not be read or written.
    #[error("cannot {action} {}: {source}", path.display())]
    File {
        /// What was tried.
        action: &'static str,
        /// With which file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Another process runs this batch.
    #[error("the batch {} is run by {owner}; wait for it or stop it", path.display())]
    Busy {
        /// The folder.
        path: PathBuf,
        /// Who runs it.
        owner: Owner,
    },
}
