//! A batch: many scenes on one machine, each as a process of its own, sharing a declared budget.
//!
//! ```text
//! BATCH/batch.sqlite    the engine's jobs and what happened to them
//! BATCH/batch.json      the budget, who runs the batch, since when
//! BATCH/batch.lock      held by the process that runs the batch
//! BATCH/settings/       each scene's settings file
//! BATCH/logs/           the output of each scene's process
//! BATCH/NAME/           the run folders of scenes that name none
//! ```
//!
//! A batch that dies, however it dies, leaves no process running. Until such an orphan has stopped, its run folder is locked,
//! and the next batch waits.

mod error;
mod folder;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use segwild_pipeline::Until;
use serde::Serialize;

pub use error::BatchError;
pub use folder::{BatchFolder, BatchRecord};

use crate::clock::{JobClock, SystemClock};
use crate::crew::{BatchEvent, CrewTerms, LocalHost, SceneFiles, StopBatch};
use crate::embedded::EmbeddedEngine;
use crate::engine::{ErrorClass, JobEngine, JobState, JobStatus};
use crate::manifest::BatchManifest;

/// How a batch is run.
#[derive(Clone)]
pub struct BatchOptions {
    /// The program whose `run` command runs a scene.
    pub program: PathBuf,
    /// What kind of failure an exit code is; `None`: ended by a signal.
    pub classify: fn(Option<i32>) -> ErrorClass,
    /// Who stops it.
    pub stop: StopBatch,
    /// Whether dead letters of earlier runs try again.
    pub retry_dead: bool,
    /// Where every scene stops, whatever the manifest says.
    pub until: Option<Until>,
}

/// How a batch ended.
#[derive(Clone, Debug, Serialize)]
pub struct BatchSummary {
    /// The scenes, in the manifest's order.
    pub scenes: Vec<JobStatus>,
    /// Whether it was stopped before everything was done.
    pub interrupted: bool,
    /// Wall time in seconds.
    pub wall_s: f64,
}

impl BatchSummary {
    /// How many scenes are in a state.
    pub fn count(&self, state: JobState) -> usize {
        self.scenes.iter().filter(|s| s.state == state).count()
    }
}

/// Runs a manifest's scenes, or what is left of them, until every one is done or a dead letter.
///
/// # Errors
/// In words, before anything is started: a manifest that makes no sense, a folder that is in use or cannot be written.
/// Scenes that fail are no error of the batch.
pub fn run(
    manifest: &Path,
    folder: &Path,
    options: &BatchOptions,
    tell: &mut dyn FnMut(&BatchEvent),
) -> Result<BatchSummary, BatchError> {
    let began = Instant::now();
    let read = BatchManifest::read(manifest, folder, options.until)?;
    let folder = BatchFolder::create(folder)?;
    let _lock = folder.lock()?;
    let engine = EmbeddedEngine::open(folder.engine_file())?;
    // The lock says that whoever held these leases is gone.
    engine.release(None, "the batch that held it ended early")?;
    let names: Vec<&str> = read.jobs.iter().map(|(scene, _)| scene.name.as_str()).collect();
    let known = engine.jobs()?.into_iter().map(|status| status.job.id);
    engine.withdraw(&known.filter(|id| !names.contains(&id.as_str())).collect::<Vec<_>>())?;
    let files = SceneFiles::of(folder.path());
    for (scene, job) in &read.jobs {
        engine.publish(job)?;
        let path = files.settings_file(&scene.name);
        files.write_settings(scene).map_err(folder::file_error("write", &path))?;
    }
    if options.retry_dead {
        for dead in engine.jobs()?.into_iter().filter(|j| j.state == JobState::Dead) {
            engine.revive(&dead.job.id)?;
        }
    }
    folder.write_record(&BatchRecord {
        manifest: std::path::absolute(manifest).unwrap_or_else(|_| manifest.to_owned()),
        budget: read.budget,
        pid: std::process::id(),
        began: SystemClock.now(),
    })?;
    let interrupted = CrewTerms {
        engine: &engine,
        name: format!("batch {}", std::process::id()),
        budget: read.budget,
        accelerator: None,
        patience_s: read.patience_s,
        store_every: Duration::MAX,
        ends_when_idle: true,
        program: options.program.clone(),
        classify: options.classify,
        stop: options.stop.clone(),
        files,
        host: Arc::new(LocalHost),
        disk: None,
        tell,
    }
    .work()?;
    let mut scenes = engine.jobs()?;
    let rank = |s: &JobStatus| names.iter().position(|n| *n == s.job.id);
    scenes.sort_by_key(rank);
    Ok(BatchSummary { scenes, interrupted, wall_s: began.elapsed().as_secs_f64() })
}
