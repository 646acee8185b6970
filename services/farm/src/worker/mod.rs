//! A worker of a farm: takes scenes from the farm's jobs, runs them here, and stores their state where any worker finds it.
//!
//! ```text
//! WORK/worker.id       its name on the farm
//! WORK/worker.lock     held by the process
//! WORK/settings/       each scene's settings file
//! WORK/logs/           the output of each scene's process
//! ```
//!
//! A scene that is done is removed from the folder: its run folder is an artefact of the farm then.

mod host;
mod scene;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use segwild_flow::files;
use segwild_flow::process::{Lock, LockError, Owner};

use self::host::FarmHost;
pub use self::scene::{FarmScene, FarmSceneError};
pub(crate) use self::scene::{artefact_of, parts};
use crate::artefacts::ArtefactSession;
use crate::crew::{BatchEvent, CrewTerms, DiskGate, SceneFiles, StopBatch};
use crate::engine::{EngineError, ErrorClass, JobEngine};
use crate::job::Needs;
use crate::machine;

/// How a worker works.
pub struct WorkerTerms<'a> {
    /// Whose jobs.
    pub engine: &'a dyn JobEngine,
    /// Where photos come from and states go.
    pub artefacts: ArtefactSession,
    /// The worker's folder, on a disk of this machine.
    pub folder: PathBuf,
    /// What may be used of the machine.
    pub budget: Needs,
    /// The accelerator of the machine, as jobs name it.
    pub accelerator: Option<String>,
    /// A scene's process in which nothing has moved for so long, in seconds, is ended and tried again.
    pub patience_s: f64,
    /// How often the state of a scene that runs is stored.
    pub store_every: Duration,
    /// No further scene is taken while the disk of the folder has less than so many bytes free.
    pub least_free_bytes: u64,
    /// Whether it ends when no job is open.
    pub drain: bool,
    /// The program whose `run` command runs a scene.
    pub program: PathBuf,
    /// What kind of failure an exit code is; `None`: ended by a signal.
    pub classify: fn(Option<i32>) -> ErrorClass,
    /// Who stops it.
    pub stop: StopBatch,
}

/// Why a worker cannot work.
#[derive(Debug, thiserror::Error)]
pub enum WorkerError {
    /// The engine could not serve.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A file of the folder could not be read or written.
    #[error("cannot {action} {}: {source}", path.display())]
    File {
        /// What was tried.
        action: &'static str,
        /// With which file.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Another worker uses the folder.
    #[error("the worker folder {} is used by {owner}; give each worker of a machine a folder of its own", path.display())]
    Busy {
        /// The folder.
        path: PathBuf,
        /// Who uses it.
        owner: Owner,
    },
}

/// What this machine gives to scenes where nobody limits it: all cores, 80 % of the memory.
pub fn usual_budget() -> Needs {
    let whole = machine::whole();
    Needs { memory_bytes: whole.memory_bytes / 5 * 4, ..whole }
}

/// Works until it is stopped, or, if it drains, until no job is open; returns whether it was stopped.
///
/// # Errors
/// The folder is in use or cannot be written; the engine refuses. A farm that does not answer is no error: the scenes go on.
pub fn work(terms: WorkerTerms<'_>, tell: &mut dyn FnMut(&BatchEvent)) -> Result<bool, WorkerError> {
    let folder = std::path::absolute(&terms.folder).unwrap_or_else(|_| terms.folder.clone());
    std::fs::create_dir_all(&folder).map_err(file_error("create", &folder))?;
    let lock = Lock::take(&folder.join("worker.lock")).map_err(|error| match error {
        LockError::Held(owner) => WorkerError::Busy { path: folder.clone(), owner },
        LockError::File(error) => {
            WorkerError::File { action: error.action, path: error.path, source: error.source }
        }
    })?;
    let name = name_of(&folder)?;
    // The lock says that whoever held leases under this name is gone.
    terms.engine.release(Some(&name), "the worker was started again")?;
    terms.engine.note_pause(&name, None)?;
    let stopped = CrewTerms {
        engine: terms.engine,
        name,
        budget: terms.budget,
        accelerator: terms.accelerator,
        patience_s: terms.patience_s,
        store_every: terms.store_every,
        ends_when_idle: terms.drain,
        program: terms.program,
        classify: terms.classify,
        stop: terms.stop,
        files: SceneFiles::of(&folder),
        host: Arc::new(FarmHost::new(&folder, terms.artefacts)),
        disk: Some(DiskGate::new(folder.clone(), terms.least_free_bytes)),
        tell,
    }
    .work()?;
    drop(lock);
    Ok(stopped)
}

/// The name of the worker of a folder: that of its machine, and a random part, so that no two have the same.
fn name_of(folder: &Path) -> Result<String, WorkerError> {
    let file = folder.join("worker.id");
    if let Some(name) = files::read_plain(&file).ok().and_then(|bytes| String::from_utf8(bytes).ok()) {
        return Ok(name.trim().to_owned());
    }
    let mut random = [0; 4];
    let no_number = |error: getrandom::Error| std::io::Error::other(error.to_string());
    getrandom::fill(&mut random).map_err(no_number).map_err(file_error("name", &file))?;
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let host: String = host
        .trim()
        .chars()
        .filter(|c| c.is_ascii_alphanumeric() || matches!(c, '-' | '.'))
        .take(40)
        .collect();
    let host = if host.is_empty() { "worker" } else { &host };
    let name = format!("{host}-{:08x}", u32::from_le_bytes(random));
    files::write_atomic(&file, name.as_bytes())
        .map_err(std::io::Error::other)
        .map_err(file_error("write", &file))?;
    Ok(name)
}

fn file_error(action: &'static str, path: &Path) -> impl Fn(std::io::Error) -> WorkerError + use<> {
    let path = path.to_owned();
    move |source| WorkerError::File { action, path: path.clone(), source }
}
