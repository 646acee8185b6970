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
//! A scene's process keeps its standard input open and stops, resumable, when it ends: a batch that dies, however it
//! dies, leaves no process running. Until such an orphan has stopped, its run folder is locked, and the next batch waits.

mod child;
mod error;
mod event;
mod folder;
mod stop;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use segwild_pipeline::Until;
use serde::Serialize;

pub use error::BatchError;
pub use event::BatchEvent;
pub use folder::{BatchFolder, BatchRecord};
pub use stop::{StopBatch, StopLevel};

use crate::clock::{JobClock, SystemClock};
use crate::embedded::EmbeddedEngine;
use crate::engine::{
    EngineError, ErrorClass, JobEngine, JobFate, JobLease, JobState, JobStatus, WorkerOffer,
};
use crate::job::Needs;
use crate::manifest::{BatchManifest, SceneJob};
use child::{Ended, SceneWorker};

/// A lease lasts so long without a heartbeat, in seconds.
const LEASE_S: f64 = 60.0;
/// How often processes are checked.
const TICK: Duration = Duration::from_millis(100);
/// A jump of the clock that is reported, in seconds.
const JUMP_REPORTED_S: f64 = 60.0;
/// How often work is requested when nothing has changed.
const ASK_EVERY: Duration = Duration::from_secs(1);

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
    /// Whether it was asked to stop before everything was done.
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
    for (scene, job) in &read.jobs {
        engine.publish(job)?;
        folder.write_settings(scene)?;
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
    let mut batch =
        Batch { engine: &engine, folder: &folder, options, manifest: &read, workers: Vec::new(), tell };
    let outcome = batch.conduct();
    // Whatever went wrong: no process is left running.
    batch.abandon();
    let interrupted = outcome?;
    let mut scenes = engine.jobs()?;
    let rank = |s: &JobStatus| names.iter().position(|n| *n == s.job.id);
    scenes.sort_by_key(rank);
    Ok(BatchSummary { scenes, interrupted, wall_s: began.elapsed().as_secs_f64() })
}

struct Batch<'a> {
    engine: &'a EmbeddedEngine,
    folder: &'a BatchFolder,
    options: &'a BatchOptions,
    manifest: &'a BatchManifest,
    workers: Vec<SceneWorker>,
    tell: &'a mut dyn FnMut(&BatchEvent),
}

impl Batch<'_> {
    /// Returns whether it was interrupted.
    fn conduct(&mut self) -> Result<bool, BatchError> {
        let (mut last_request, mut clocks_read): (Option<Instant>, Option<Instant>) = (None, None);
        loop {
            let stop = self.options.stop.level();
            for worker in &mut self.workers {
                match stop {
                    StopLevel::Run => {}
                    StopLevel::Stop => worker.ask_to_stop(),
                    StopLevel::AtOnce => worker.kill(),
                }
            }
            for worker in &mut self.workers {
                worker.check_progress(self.manifest.patience_s);
            }
            let changed = self.reap()?;
            self.beat()?;
            if clocks_read.is_none_or(|at| at.elapsed() >= ASK_EVERY) {
                clocks_read = Some(Instant::now());
                for seconds in self.engine.jumps()?.into_iter().filter(|s| s.abs() >= JUMP_REPORTED_S) {
                    (self.tell)(&BatchEvent::ClockJumped { seconds });
                }
            }
            if stop > StopLevel::Run {
                if self.workers.is_empty() {
                    let jobs = self.engine.jobs()?;
                    return Ok(jobs.iter().any(|j| matches!(j.state, JobState::Pending | JobState::Leased)));
                }
            } else if changed || last_request.is_none_or(|at| at.elapsed() >= ASK_EVERY) {
                while self.claim()? {}
                last_request = Some(Instant::now());
                let open = |j: &JobStatus| matches!(j.state, JobState::Pending | JobState::Leased);
                if self.workers.is_empty() && !self.engine.jobs()?.iter().any(open) {
                    return Ok(false);
                }
            }
            self.options.stop.wait(TICK);
        }
    }

    fn free(&self) -> Needs {
        self.workers.iter().fold(self.manifest.budget, |free, worker| worker.granted.taken_from(&free))
    }

    /// So many of the machine's cores that no scene has: a scene's actors compute at the same time, each with as many
    /// threads as the scene has cores, and without a fence they would take the cores of others. None where the budget
    /// promises more cores than there are.
    fn cpus(&self, count: u32) -> Vec<u32> {
        let taken = |core: &u32| self.workers.iter().any(|worker| worker.cpus.contains(core));
        let free: Vec<u32> = segwild_flow::cpu::allowed().into_iter().filter(|core| !taken(core)).collect();
        free.get(..count as usize).map(<[u32]>::to_vec).unwrap_or_default()
    }

    /// Takes a scene and starts it; `false` when none fits now.
    fn claim(&mut self) -> Result<bool, BatchError> {
        let free = self.free();
        if free.cores == 0 {
            return Ok(false);
        }
        let worker = format!("batch {}", std::process::id());
        let Some(lease) = self.engine.claim(&WorkerOffer {
            worker,
            free,
            whole: self.manifest.budget,
            lease_s: LEASE_S,
        })?
        else {
            return Ok(false);
        };
        let scene: SceneJob = match serde_json::from_str(&lease.job.payload) {
            Ok(scene) => scene,
            Err(error) => {
                let error = format!("its job cannot be read: {error}");
                self.failed(&lease, ErrorClass::Fatal, &error)?;
                return Ok(true);
            }
        };
        let mut granted = lease.job.needs;
        // The last scene need not leave cores idle that nobody else needs.
        if !self.engine.jobs()?.iter().any(|j| j.state == JobState::Pending) {
            granted.cores = free.cores;
        }
        let cpus = self.cpus(granted.cores);
        self.workers.push(SceneWorker::new(lease, scene, granted, cpus));
        Ok(true)
    }

    /// Starts processes that can start, and books those that have ended; returns whether any has.
    fn reap(&mut self) -> Result<bool, BatchError> {
        let mut changed = false;
        let mut i = 0;
        // In the order in which they were claimed: the most urgent process is started first.
        while i < self.workers.len() {
            let worker = &mut self.workers[i];
            let (waited, had_started) = (worker.waits.is_some(), worker.has_started());
            let ended = worker.advance(self.folder, &self.options.program, self.tell);
            let Some(ended) = ended else {
                // The status of the batch shows which scenes wait, and why.
                let starts = waited && worker.has_started() && !had_started;
                if starts || !waited && worker.waits.is_some() {
                    let reason = worker.waits.as_deref().filter(|_| !starts);
                    lost(self.engine.note_wait(&worker.lease, reason))?;
                }
                i += 1;
                continue;
            };
            changed = true;
            let worker = self.workers.remove(i);
            let lease = &worker.lease;
            let scene = lease.job.id.clone();
            match ended {
                Ended::Code(Some(0)) => {
                    let seconds = worker.seconds();
                    let outcome = serde_json::json!({ "seconds": seconds }).to_string();
                    if !lost(self.engine.complete(lease, &outcome))? {
                        (self.tell)(&BatchEvent::SceneDone { scene, seconds });
                    }
                }
                _ if worker.stop_requested => {
                    if !lost(self.engine.fail(lease, ErrorClass::Stopped, "stopped"))? {
                        (self.tell)(&BatchEvent::SceneStopped { scene });
                    }
                }
                Ended::Code(code) => {
                    let error = worker.last_words(self.folder, code);
                    self.failed(lease, (self.options.classify)(code), &error)?;
                }
                Ended::NotStarted(class, error) => self.failed(lease, class, &error)?,
            }
        }
        Ok(changed)
    }

    fn failed(&mut self, lease: &JobLease, class: ErrorClass, error: &str) -> Result<(), BatchError> {
        let (scene, error) = (lease.job.id.clone(), error.to_owned());
        match self.engine.fail(lease, class, &error) {
            Ok(JobFate::Retry { due }) => {
                // Between the two readings the clock may have jumped.
                let delay_s = (due - SystemClock.now()).clamp(0.0, lease.job.retry.longest_delay_s);
                (self.tell)(&BatchEvent::SceneRetries { scene, error, delay_s });
            }
            Ok(JobFate::Dead) => (self.tell)(&BatchEvent::SceneDied { scene, error }),
            Ok(JobFate::Released) => (self.tell)(&BatchEvent::SceneStopped { scene }),
            Err(EngineError::Lost { .. }) => {}
            Err(error) => return Err(error.into()),
        }
        Ok(())
    }

    /// Renews leases that are a third over.
    fn beat(&mut self) -> Result<(), BatchError> {
        for worker in &mut self.workers {
            if worker.renewed.elapsed().as_secs_f64() < LEASE_S / 3.0 {
                continue;
            }
            worker.renewed = Instant::now();
            match self.engine.heartbeat(&worker.lease) {
                Ok(until) => worker.lease.until = until,
                // Somebody else has the scene: two must not work on it.
                Err(EngineError::Lost { .. }) => worker.kill(),
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// After an error of the batch itself: stops who still runs.
    fn abandon(&mut self) {
        for worker in &mut self.workers {
            worker.ask_to_stop();
        }
        for mut worker in self.workers.drain(..) {
            worker.wait();
        }
    }
}

/// Whether a result came too late; other errors go on.
fn lost<T>(result: Result<T, EngineError>) -> Result<bool, EngineError> {
    match result {
        Ok(_) => Ok(false),
        Err(EngineError::Lost { .. }) => Ok(true),
        Err(error) => Err(error),
    }
}
