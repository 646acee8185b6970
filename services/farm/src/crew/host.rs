//! What surrounds a scene's process on its machine.

use crate::engine::{ErrorClass, JobLease};
use crate::job::Job;
use crate::manifest::SceneJob;

/// Why a host could not fetch or store, in words.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{words}")]
pub(crate) struct HostFailure {
    /// What kind of failure it is.
    pub class: ErrorClass,
    /// What is wrong.
    pub words: String,
}

impl HostFailure {
    /// Another attempt may succeed.
    pub fn passing(words: impl ToString) -> Self {
        Self { class: ErrorClass::Retryable, words: words.to_string() }
    }
}

/// Where a scene's photos come from, and where its state goes.
pub(crate) trait SceneHost: Send + Sync {
    /// The scene of a job, as it is run on this machine.
    ///
    /// # Errors
    /// Why it cannot be run here or anywhere.
    fn scene(&self, job: &Job) -> Result<SceneJob, HostFailure>;

    /// Whether scenes are fetched and stored at all: on one machine they are where they are.
    fn is_remote(&self) -> bool;

    /// Fetches what the scene's process reads, and the state that another attempt stored.
    ///
    /// # Errors
    /// Why it cannot.
    fn fetch(&self, lease: &JobLease, scene: &SceneJob) -> Result<(), HostFailure>;

    /// Stores the state of a scene, while its process runs or after; returns the artefact. `None`: there is nothing yet.
    ///
    /// # Errors
    /// Why it cannot.
    fn store(&self, scene: &SceneJob) -> Result<Option<String>, HostFailure>;

    /// The machine has nothing to do with a scene any more, unless it takes it again (`may_return`). Returns whether something
    /// is to be deleted: see [`SceneHost::clear`].
    fn leave(&self, scene: &SceneJob, may_return: bool) -> bool;

    /// Puts aside what scenes left that the machine has not got now, to gain space: they are stored, or are started again.
    /// Returns whether something is to be deleted.
    fn reclaim(&self, here: &[&SceneJob]) -> bool;

    /// Deletes what was put aside. That may take long.
    fn clear(&self);
}

/// The host of a batch on one machine: photos and run folders are where the manifest names them.
pub(crate) struct LocalHost;

impl SceneHost for LocalHost {
    fn scene(&self, job: &Job) -> Result<SceneJob, HostFailure> {
        let wrong = |error| HostFailure {
            class: ErrorClass::Fatal,
            words: format!("its job cannot be read: {error}"),
        };
        serde_json::from_str(&job.payload).map_err(wrong)
    }

    fn is_remote(&self) -> bool {
        false
    }

    fn fetch(&self, _: &JobLease, _: &SceneJob) -> Result<(), HostFailure> {
        Ok(())
    }

    fn store(&self, _: &SceneJob) -> Result<Option<String>, HostFailure> {
        Ok(None)
    }

    fn leave(&self, _: &SceneJob, _: bool) -> bool {
        false
    }

    fn reclaim(&self, _: &[&SceneJob]) -> bool {
        false
    }

    fn clear(&self) {}
}
