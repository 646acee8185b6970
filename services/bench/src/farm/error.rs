//! Why a farm cannot be measured.

use segwild_farm::{EngineError, FarmAddressError};
use std::path::{Path, PathBuf};

/// Why a farm cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum FarmBenchError {
    /// The log could not serve.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The server's address makes no sense.
    #[error(transparent)]
    Address(#[from] FarmAddressError),
    /// The server does not start.
    #[error("{0} does not start")]
    Server(PathBuf),
    /// A file of the benchmark.
    #[error("{path}: {source}")]
    Io {
        /// Which file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The link of a network could not be cut or restored.
    #[error("`ip link set {link} {state}` is refused")]
    Link {
        /// The link.
        link: String,
        /// What it should be.
        state: &'static str,
    },
    /// A scene could not be made or worked.
    #[error("{0}")]
    Scene(String),
    /// A farm came to no end.
    #[error("the farm came to no end within an hour")]
    Stuck,
    /// A thread of the benchmark panicked.
    #[error("a machine of the benchmark panicked")]
    Panicked,
}

/// What an error of the system becomes, where it is about a file or a process of this folder.
pub(super) fn io_error(path: &Path) -> impl Fn(std::io::Error) -> FarmBenchError {
    move |source| FarmBenchError::Io { path: path.to_owned(), source }
}
