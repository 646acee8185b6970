//! A batch and its scenes.

use std::collections::BTreeMap;
use std::path::PathBuf;

use segwild_farm::{BatchFolder, ChangeKind, Job, JobEngine, JobState, JobStatus, Needs, SceneJob, turns};
use serde::{Deserialize, Serialize};

use super::farm::{FarmTarget, FarmView};
use super::folder::{ViewError, name_of};
use super::scene::{SceneState, SceneView};
use super::why;
use super::{Disk, Runs};

/// A batch, as it is or as it was left.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BatchView {
    /// Its name: the folder's.
    pub name: String,
    /// Its folder.
    pub folder: PathBuf,
    /// When it was read, in seconds since 1970.
    pub time: f64,
    /// The process that runs it.
    pub owner: Option<String>,
    /// When that process, or the last one, began, in seconds since 1970.
    pub began: Option<f64>,
    /// What may be used of the machine.
    pub budget: Needs,
    /// What of it is given to scenes now.
    pub used: Needs,
    /// The scenes, in the order of the manifest in which they first were.
    pub scenes: Vec<SceneView>,
    /// Leases that ran out, ever.
    pub leases_expired: u64,
    /// Attempts that failed and were followed by another one, ever.
    pub retries: u64,
    /// The disk under the folder.
    pub disk: Option<Disk>,
    /// What only a farm has.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub farm: Option<FarmView>,
}

impl BatchView {
    /// Reads a batch's folder as it is at a time.
    ///
    /// # Errors
    /// When the engine's file, or a run's ledger, cannot be read.
    pub fn read(folder: &BatchFolder, runs: &mut Runs, now: f64) -> Result<BatchView, ViewError> {
        let owner = folder.owner().map(|owner| owner.to_string());
        let engine = folder.engine()?;
        let (record, jobs) = (folder.record(), engine.jobs()?);
        let waits = engine.waits()?;
        let mut scenes: Vec<SceneView> =
            jobs.iter().map(|job| scene(job, runs, &waits, owner.is_some(), now)).collect();
        let budget = record.as_ref().map(|r| r.budget).unwrap_or_default();
        let mut used = Needs::default();
        // Who cannot start yet has its part of the budget all the same.
        let held = |s: &&SceneView| s.state == SceneState::Running || s.is_held_up(&waits, owner.is_some());
        for scene in scenes.iter().filter(held) {
            // The last scene is given idle cores as well.
            let mine = scene.run.as_ref().filter(|run| run.running && scene.state == SceneState::Running);
            let given = mine.and_then(|run| run.cores);
            let cores = given.unwrap_or(0).max(scene.needs.cores);
            used = used.with(&Needs { cores, ..scene.needs });
        }
        let could_start = |s: &&JobStatus| s.state == JobState::Pending && s.due <= now;
        let mut waiting: Vec<&Job> = jobs.iter().filter(could_start).map(|s| &s.job).collect();
        waiting.sort_by_key(|job| std::cmp::Reverse(job.priority));
        let turns = turns(&waiting, &used.taken_from(&budget), &budget);
        let turns = waiting.iter().map(|job| job.id.as_str()).zip(turns).collect();
        why::scenes(&mut scenes, &turns, &waits, owner.is_some());
        let whole = std::path::absolute(folder.path()).unwrap_or_else(|_| folder.path().to_owned());
        Ok(BatchView {
            name: name_of(&whole),
            time: now,
            owner,
            began: record.map(|r| r.began),
            budget,
            used,
            scenes,
            leases_expired: engine.count(ChangeKind::Expired)?,
            retries: engine.count(ChangeKind::Retried)?,
            disk: Disk::of(&whole),
            folder: whole,
            farm: None,
        })
    }

    /// A farm as it is at a time. Its scenes run elsewhere: how far each run is, its worker shows.
    ///
    /// # Errors
    /// When the farm cannot be read.
    pub fn of_farm(farm: &FarmTarget, now: f64) -> Result<BatchView, ViewError> {
        let (jobs, waits) = (farm.engine.jobs()?, farm.engine.waits()?);
        let mut scenes: Vec<SceneView> = jobs
            .iter()
            .map(|job| SceneView { run: None, ..scene(job, &mut Runs::default(), &waits, true, now) })
            .collect();
        let mut used = Needs::default();
        for (scene, job) in scenes.iter_mut().zip(&jobs).filter(|(_, job)| job.state == JobState::Leased) {
            used = used.with(&scene.needs);
            scene.worker.clone_from(&job.worker);
        }
        let own = FarmView::of(farm, &jobs, now)?;
        why::farm_scenes(&mut scenes, &jobs, &waits, &own.workers);
        let whole = own.whole();
        // Scenes may be held by workers that did not say what they have.
        let budget = Needs {
            cores: whole.cores.max(used.cores),
            memory_bytes: whole.memory_bytes.max(used.memory_bytes),
            accelerators: whole.accelerators.max(used.accelerators),
        };
        Ok(BatchView {
            name: farm.name.clone(),
            folder: PathBuf::new(),
            time: now,
            owner: Some("its workers".into()),
            began: None,
            budget,
            used,
            scenes,
            leases_expired: farm.engine.count(ChangeKind::Expired)?,
            retries: farm.engine.count(ChangeKind::Retried)?,
            disk: None,
            farm: Some(own),
        })
    }

    /// How many scenes are in a state.
    pub fn count(&self, state: SceneState) -> usize {
        self.scenes.iter().filter(|s| s.state == state).count()
    }
}

fn scene(
    status: &JobStatus,
    runs: &mut Runs,
    waits: &BTreeMap<String, String>,
    batch_runs: bool,
    now: f64,
) -> SceneView {
    let job = &status.job;
    let scene = serde_json::from_str::<SceneJob>(&job.payload).ok();
    let (out, until) = scene.map(|s| (s.out, s.until)).unwrap_or_default();
    // A run that cannot be read now (it is being made) is shown as not started.
    let run = runs.view(&out, now).ok().map(Box::new);
    let state = match status.state {
        JobState::Done => SceneState::Done,
        JobState::Dead => SceneState::Dead,
        // A lease that a killed batch left behind is no work.
        JobState::Leased if batch_runs && !waits.contains_key(&job.id) => SceneState::Running,
        JobState::Leased | JobState::Pending => SceneState::Waiting,
    };
    let end = if state == SceneState::Running { Some(now) } else { status.ended };
    SceneView {
        name: job.id.clone(),
        state,
        priority: job.priority,
        needs: job.needs,
        attempt: status.attempt,
        failures: status.failures,
        attempts: job.retry.attempts,
        error: status.error.clone(),
        rests_s: Some((status.due - now).min(job.retry.longest_delay_s))
            .filter(|&s| s > 0.0 && state == SceneState::Waiting),
        started: status.started,
        wall_s: status.started.zip(end).map(|(a, b)| (b - a).max(0.0)),
        worker: None,
        why: None,
        until,
        out,
        run,
    }
}
