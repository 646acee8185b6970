//! The folder of a batch.

use std::path::{Path, PathBuf};

use segwild_flow::process::{self, Lock, LockError, Owner};
use segwild_flow::{FileError, files};
use serde::{Deserialize, Serialize};

use super::error::BatchError;
use crate::crew::SceneFiles;
use crate::embedded::EmbeddedEngine;
use crate::engine::EngineError;
use crate::job::Needs;

/// `batch.json`: what the engine does not know.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BatchRecord {
    /// The manifest.
    pub manifest: PathBuf,
    /// What may be used of the machine.
    pub budget: Needs,
    /// The process that ran it last.
    pub pid: u32,
    /// Since when, in seconds since 1970.
    pub began: f64,
}

/// A batch's folder.
#[derive(Clone, Debug)]
pub struct BatchFolder {
    path: PathBuf,
}

impl BatchFolder {
    /// The folder at `path`, made if it is not there.
    ///
    /// # Errors
    /// When it cannot be made.
    pub fn create(path: &Path) -> Result<Self, BatchError> {
        let folder = Self { path: path.to_owned() };
        let ours = |name: &str| matches!(name, "logs" | "settings") || name.starts_with("batch.");
        files::stays_inside(path, ours).map_err(std::io::Error::other).map_err(file_error("use", path))?;
        for dir in [folder.path.clone(), folder.path.join("logs"), folder.path.join("settings")] {
            std::fs::create_dir_all(&dir).map_err(file_error("create", &dir))?;
        }
        Ok(folder)
    }

    /// An existing batch; `None` when there is none.
    pub fn open(path: &Path) -> Option<Self> {
        let folder = Self { path: path.to_owned() };
        folder.engine_file().is_file().then_some(folder)
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The engine's file.
    pub fn engine_file(&self) -> PathBuf {
        self.path.join("batch.sqlite")
    }

    /// The engine, to read while another process runs the batch.
    ///
    /// # Errors
    /// As [`EmbeddedEngine::open_read_only`].
    pub fn engine(&self) -> Result<EmbeddedEngine, EngineError> {
        EmbeddedEngine::open_read_only(self.engine_file())
    }

    /// What is known of its last run.
    pub fn record(&self) -> Option<BatchRecord> {
        let bytes = segwild_flow::files::read_plain(&self.path.join("batch.json")).ok()?;
        serde_json::from_slice(&bytes).ok()
    }

    /// The output of a scene's processes.
    pub fn log(&self, scene: &str) -> PathBuf {
        SceneFiles::of(&self.path).log(scene)
    }

    /// The process that runs the batch now, if any.
    pub fn owner(&self) -> Option<Owner> {
        process::owner(&self.lock_file())
    }

    fn lock_file(&self) -> PathBuf {
        self.path.join("batch.lock")
    }

    /// Takes the batch for this process; the lock ends with what is returned.
    pub(super) fn lock(&self) -> Result<Lock, BatchError> {
        Lock::take(&self.lock_file()).map_err(|error| match error {
            LockError::Held(owner) => BatchError::Busy { path: self.path.clone(), owner },
            LockError::File(FileError { action, path, source, .. }) => {
                BatchError::File { action, path, source }
            }
        })
    }

    pub(super) fn write_record(&self, record: &BatchRecord) -> Result<(), BatchError> {
        let path = self.path.join("batch.json");
        let text = serde_json::to_vec_pretty(record).map_err(std::io::Error::other);
        let text = text.map_err(file_error("write", &path))?;
        write(&path, &text)
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), BatchError> {
    files::write_atomic(path, bytes).map_err(std::io::Error::other).map_err(file_error("write", path))
}

pub(super) fn file_error(action: &'static str, path: &Path) -> impl Fn(std::io::Error) -> BatchError + use<> {
    let path = path.to_owned();
    move |source| BatchError::File { action, path: path.clone(), source }
}
