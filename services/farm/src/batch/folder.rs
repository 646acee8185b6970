//! The folder of a batch.

use std::fs::{File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use segwild_flow::files;
use serde::{Deserialize, Serialize};

use super::BatchError;
use crate::embedded::EmbeddedEngine;
use crate::engine::EngineError;
use crate::job::Needs;
use crate::manifest::SceneJob;

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

    /// The engine, to look at while another process runs the batch.
    ///
    /// # Errors
    /// As [`EmbeddedEngine::open_read_only`].
    pub fn engine(&self) -> Result<EmbeddedEngine, EngineError> {
        EmbeddedEngine::open_read_only(self.engine_file())
    }

    /// What is known of its last run.
    pub fn record(&self) -> Option<BatchRecord> {
        let bytes = std::fs::read(self.path.join("batch.json")).ok()?;
        serde_json::from_slice(&bytes).ok()
    }

    /// What a scene's processes said.
    pub fn log(&self, scene: &str) -> PathBuf {
        self.path.join("logs").join(format!("{scene}.log"))
    }

    /// The process that runs the batch now, if any.
    pub fn owner(&self) -> Option<String> {
        let path = self.path.join("batch.lock");
        match File::open(&path).ok()?.try_lock_shared() {
            Err(TryLockError::WouldBlock) => Some(owner(&path)),
            _ => None,
        }
    }

    pub(super) fn settings_file(&self, scene: &str) -> PathBuf {
        self.path.join("settings").join(format!("{scene}.toml"))
    }

    /// Takes the batch for this process; the lock ends with the file.
    pub(super) fn lock(&self) -> Result<File, BatchError> {
        let path = self.path.join("batch.lock");
        let mut file = File::options()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&path)
            .map_err(file_error("write", &path))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(BatchError::Busy { path: self.path.clone(), owner: owner(&path) });
            }
            Err(TryLockError::Error(e)) => return Err(file_error("lock", &path)(e)),
        }
        // Only for words: what locks is the lock.
        file.set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()))
            .map_err(file_error("write", &path))?;
        Ok(file)
    }

    pub(super) fn write_record(&self, record: &BatchRecord) -> Result<(), BatchError> {
        let path = self.path.join("batch.json");
        let text = serde_json::to_vec_pretty(record).map_err(std::io::Error::other);
        let text = text.map_err(file_error("write", &path))?;
        write(&path, &text)
    }

    pub(super) fn write_settings(&self, scene: &SceneJob) -> Result<(), BatchError> {
        let path = self.settings_file(&scene.name);
        let settings =
            scene.effective().map_err(std::io::Error::other).map_err(file_error("write", &path))?;
        write(&path, settings.to_toml().as_bytes())
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), BatchError> {
    files::write_atomic(path, bytes).map_err(std::io::Error::other).map_err(file_error("write", path))
}

fn owner(path: &Path) -> String {
    let mut text = String::new();
    let read = File::open(path).and_then(|mut file| file.read_to_string(&mut text));
    match read.ok().and_then(|_| text.trim().parse::<u32>().ok()) {
        Some(pid) => format!("process {pid}"),
        None => "another process".into(),
    }
}

pub(super) fn file_error(action: &'static str, path: &Path) -> impl Fn(std::io::Error) -> BatchError + use<> {
    let path = path.to_owned();
    move |source| BatchError::File { action, path: path.clone(), source }
}
