//! A batch on a farm: its scenes are handed in, watched, and fetched when they are done.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use segwild_pipeline::Until;

use crate::artefacts::{ArtefactDigest, ArtefactError, ArtefactSession};
use crate::batch::BatchSummary;
use crate::crew::{BatchEvent, StopBatch, StopLevel};
use crate::engine::{ChangeKind, EngineError, JobChange, JobEngine, JobState, JobStatus};
use crate::job::Job;
use crate::manifest::{BatchManifest, ManifestError};
use crate::worker::{FarmScene, FarmSceneError, artefact_of, parts};

/// How often the farm is read.
const WATCH_EVERY: Duration = Duration::from_millis(500);

/// A batch for a farm.
pub struct FarmBatch<'a> {
    /// Whose jobs.
    pub engine: &'a dyn JobEngine,
    /// Where photos go and results come from.
    pub artefacts: &'a ArtefactSession,
    /// Its name: scenes of the same batch and name are the same jobs.
    pub name: String,
    /// Where results are fetched to: `OUT/SCENE`; `None`: they stay artefacts.
    pub out: Option<PathBuf>,
    /// Who stops the watching. The farm works on.
    pub stop: StopBatch,
}

/// Why a batch could not be handed in or watched.
#[derive(Debug, thiserror::Error)]
pub enum FarmBatchError {
    /// The manifest does not make sense.
    #[error(transparent)]
    Manifest(#[from] ManifestError),
    /// The engine could not serve.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The name of the batch or of a scene cannot be used on a farm.
    #[error(transparent)]
    Name(FarmSceneError),
    /// A scene is not for a farm.
    #[error("scene `{scene}`: {reason}")]
    Scene {
        /// Which.
        scene: String,
        /// What is wrong.
        reason: FarmSceneError,
    },
    /// The photos of a scene could not be stored.
    #[error("scene `{scene}`: {source}")]
    Photos {
        /// Which.
        scene: String,
        /// Why.
        source: ArtefactError,
    },
    /// A result could not be fetched.
    #[error("the result of `{scene}`: {source}")]
    Result {
        /// Of which scene.
        scene: String,
        /// Why.
        source: ArtefactError,
    },
}

impl FarmBatch<'_> {
    fn id(&self, scene: &str) -> String {
        format!("{}/{scene}", self.name)
    }

    /// Withdraws the scenes of this batch that the manifest does not have, unless somebody works on them; then stores the photos
    /// of each scene and hands it in at once: until a job refers to them, a sweep of the store removes what is old enough. To hand
    /// in the same again changes nothing.
    ///
    /// # Errors
    /// What is wrong with the manifest or a scene, before any is handed in; when the farm or the store does not serve.
    pub fn submit(
        &self,
        manifest: &Path,
        until: Option<Until>,
        retry_dead: bool,
        tell: &mut dyn FnMut(&BatchEvent),
    ) -> Result<(), FarmBatchError> {
        let read = BatchManifest::read_for_farm(manifest, until)?;
        // All of them are checked before the first one's photos travel.
        for (scene, _) in &read.jobs {
            parts(&self.id(&scene.name)).map_err(FarmBatchError::Name)?;
            FarmScene::check(&scene.settings, scene.until.as_deref())
                .map_err(|reason| FarmBatchError::Scene { scene: scene.name.clone(), reason })?;
        }
        let wanted: BTreeSet<String> = read.jobs.iter().map(|(scene, _)| self.id(&scene.name)).collect();
        let unwanted: Vec<String> =
            self.jobs()?.into_iter().map(|status| status.job.id).filter(|id| !wanted.contains(id)).collect();
        self.engine.withdraw(&unwanted)?;
        for (scene, job) in &read.jobs {
            let id = self.id(&scene.name);
            let began = Instant::now();
            let failed = |source| FarmBatchError::Photos { scene: scene.name.clone(), source };
            let photos = self.artefacts.store_folder(&scene.path, &|_| true).map_err(failed)?;
            let payload = FarmScene { photos, settings: scene.settings.clone(), until: scene.until.clone() };
            let payload = serde_json::to_string(&payload).map_err(|e| FarmBatchError::Scene {
                scene: scene.name.clone(),
                reason: FarmSceneError::Payload(e.to_string()),
            })?;
            tell(&BatchEvent::SceneStored { scene: id.clone(), seconds: began.elapsed().as_secs_f64() });
            self.engine.publish(&Job { id, payload, ..job.clone() })?;
        }
        if retry_dead {
            for dead in self.jobs()?.into_iter().filter(|status| status.state == JobState::Dead) {
                self.engine.revive(&dead.job.id)?;
            }
        }
        Ok(())
    }

    /// The jobs of this batch.
    fn jobs(&self) -> Result<Vec<JobStatus>, EngineError> {
        let prefix = self.id("");
        let mut jobs = self.engine.jobs()?;
        jobs.retain(|status| status.job.id.starts_with(&prefix));
        Ok(jobs)
    }

    /// Watches the batch until every scene is done or a dead letter, and fetches results as they come. A farm that does not
    /// answer for a while is waited for.
    ///
    /// # Errors
    /// When the farm cannot be read; when a result cannot be fetched.
    pub fn watch(&self, tell: &mut dyn FnMut(&BatchEvent)) -> Result<BatchSummary, FarmBatchError> {
        let began = Instant::now();
        let mut revision = self.engine.watch(0, usize::MAX)?.last().map_or(0, |change| change.revision);
        let (mut silent, mut fetched) = (false, BTreeSet::new());
        let prefix = self.id("");
        loop {
            let read =
                self.engine.watch(revision, usize::MAX).and_then(|changes| Ok((changes, self.jobs()?)));
            let (changes, scenes) = match read {
                Ok(read) => read,
                Err(EngineError::Server { reason, .. }) if self.stop.level() == StopLevel::Run => {
                    if !std::mem::replace(&mut silent, true) {
                        tell(&BatchEvent::EngineSilent { reason: reason.to_string() });
                    }
                    self.stop.wait(WATCH_EVERY);
                    continue;
                }
                Err(error) => return Err(error.into()),
            };
            if std::mem::take(&mut silent) {
                tell(&BatchEvent::EngineBack);
            }
            for change in changes {
                revision = change.revision;
                if change.job.starts_with(&prefix)
                    && let Some(event) = event_of(&change, &scenes)
                {
                    tell(&event);
                }
            }
            for status in scenes.iter().filter(|status| status.state == JobState::Done) {
                let artefact =
                    status.outcome.as_deref().and_then(|outcome| artefact_of(outcome).ok().flatten());
                if let Some((out, artefact)) = self.out.as_ref().zip(artefact)
                    && fetched.insert(artefact)
                {
                    self.fetch(status, &artefact, out, tell)?;
                }
            }
            let over = |s: &JobStatus| matches!(s.state, JobState::Done | JobState::Dead);
            let interrupted = self.stop.level() > StopLevel::Run;
            if interrupted || scenes.iter().all(over) {
                let interrupted = interrupted && !scenes.iter().all(over);
                return Ok(BatchSummary { scenes, interrupted, wall_s: began.elapsed().as_secs_f64() });
            }
            self.stop.wait(WATCH_EVERY);
        }
    }

    /// Fetches a result, unless it is there.
    fn fetch(
        &self,
        status: &JobStatus,
        artefact: &ArtefactDigest,
        out: &Path,
        tell: &mut dyn FnMut(&BatchEvent),
    ) -> Result<(), FarmBatchError> {
        let id = &status.job.id;
        let Ok((_, scene)) = parts(id) else { return Ok(()) };
        let began = Instant::now();
        let failed = |source| FarmBatchError::Result { scene: id.clone(), source };
        self.artefacts.fetch_run(artefact, &out.join(scene)).map_err(failed)?;
        tell(&BatchEvent::SceneFetched { scene: id.clone(), seconds: began.elapsed().as_secs_f64() });
        Ok(())
    }
}

fn event_of(change: &JobChange, scenes: &[JobStatus]) -> Option<BatchEvent> {
    let (scene, error) = (change.job.clone(), change.detail.clone());
    let status = scenes.iter().find(|status| status.job.id == change.job);
    Some(match change.kind {
        ChangeKind::Claimed => {
            BatchEvent::SceneTaken { scene, worker: change.detail.clone(), attempt: change.attempt }
        }
        ChangeKind::Completed => {
            let outcome: serde_json::Value = serde_json::from_str(&change.detail).unwrap_or_default();
            BatchEvent::SceneDone { scene, seconds: outcome["seconds"].as_f64().unwrap_or_default() }
        }
        ChangeKind::Retried => {
            let delay_s = status.map_or(0.0, |status| (status.due - change.time).max(0.0));
            BatchEvent::SceneRetries { scene, error, delay_s }
        }
        ChangeKind::Died => BatchEvent::SceneDied { scene, error },
        ChangeKind::Released => BatchEvent::SceneStopped { scene },
        ChangeKind::Waits => BatchEvent::SceneWaits { scene, reason: error },
        // A retry, or the end, follows.
        ChangeKind::Expired | ChangeKind::Published | ChangeKind::Revived | ChangeKind::Began => return None,
    })
}
