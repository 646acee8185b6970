//! Network files that are in use.

use std::path::{Path, PathBuf};

/// A network file in use.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct NetworkFile {
    /// The setting that led to it: `models`, `transient_network` or `vision_service`.
    pub setting: String,
    /// Where it is: a path, or the addresses of services.
    pub file: PathBuf,
    /// The first 16 digits of its BLAKE3, hexadecimal; those of weights beside it are in it.
    pub hash: String,
}

impl NetworkFile {
    pub(crate) fn of_models(file: &Path, hash: &str) -> NetworkFile {
        NetworkFile { setting: "models".into(), file: file.to_owned(), hash: hash.to_owned() }
    }
}
