//! The artefacts that farms need, and the removal of all others from their store.

use std::collections::BTreeSet;
use std::time::Duration;

use crate::artefacts::{ArtefactDigest, ArtefactError, ArtefactSession, StoredArtefact, SweptArtefacts};
use crate::engine::{EngineError, JobEngine, JobStatus};
use crate::worker::{FarmScene, artefact_of};

/// A sweep of a store of artefacts.
pub struct FarmSweep<'a> {
    /// All farms whose artefacts the store has, each with its name for people: what is used by one of them alone is kept as well.
    pub farms: Vec<(String, &'a dyn JobEngine)>,
    /// The store.
    pub artefacts: &'a ArtefactSession,
    /// What is younger stays, whatever refers to it.
    pub older_than: Duration,
    /// Whether nothing is removed.
    pub dry_run: bool,
}

/// Why nothing is swept.
#[derive(Debug, thiserror::Error)]
pub enum FarmSweepError {
    /// A farm without scenes needs nothing: that is a wrong name or a wrong key more often than it is true.
    #[error(
        "the farm {farm} has no scene, so that nothing in the store would be needed for it: check its name and --farm-key; a store that nobody needs can be removed as a whole"
    )]
    Empty {
        /// Which farm.
        farm: String,
    },
    /// A farm's log has records that are void for who sweeps: what they say of its scenes is not known.
    #[error(
        "{records} records in the log of the farm {farm} are not by the key of --farm-key, or by any key where none is given, so it is not known what its scenes need: give the key of the farm (all farms of one sweep have the same); records that somebody else wrote go when the log is next compacted, at the latest after 1,024 further ones"
    )]
    OtherKey {
        /// Which farm.
        farm: String,
        /// How many records.
        records: u64,
    },
    /// What a job refers to is not known.
    #[error(
        "it is not known what `{job}` needs ({reason}): withdraw it, or use the version of the program that handed it in"
    )]
    Job {
        /// Its name.
        job: String,
        /// What cannot be read.
        reason: String,
    },
    /// A farm could not be read.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The store, or a folder in it.
    #[error(transparent)]
    Artefact(#[from] ArtefactError),
}

impl FarmSweep<'_> {
    /// Removes what no job, stored state or result of the farms refers to, and what is old enough; `show` sees each of them.
    ///
    /// # Errors
    /// When a farm has no scene or one that cannot be read, or another key than who sweeps; when the store is another one, or
    /// something cannot be reached. As long as it is not known what is needed, nothing is removed.
    pub fn sweep(&self, show: &mut dyn FnMut(&StoredArtefact)) -> Result<SweptArtefacts, FarmSweepError> {
        let needed = || -> Result<BTreeSet<ArtefactDigest>, FarmSweepError> {
            let mut all = BTreeSet::new();
            for (name, farm) in &self.farms {
                let jobs = farm.jobs()?;
                let records = farm.log_state().unwrap_or_default().void_records;
                if records > 0 {
                    return Err(FarmSweepError::OtherKey { farm: name.clone(), records });
                }
                if jobs.is_empty() {
                    return Err(FarmSweepError::Empty { farm: name.clone() });
                }
                for status in &jobs {
                    all.extend(needed_by(status)?);
                }
            }
            Ok(all)
        };
        self.artefacts.sweep(self.older_than, self.dry_run, needed, show)
    }
}

/// The folders that a job refers to: its photos, the state of its work, its result.
fn needed_by(status: &JobStatus) -> Result<Vec<ArtefactDigest>, FarmSweepError> {
    let unknown = |reason: &dyn std::fmt::Display| FarmSweepError::Job {
        job: status.job.id.clone(),
        reason: reason.to_string(),
    };
    let scene: FarmScene = serde_json::from_str(&status.job.payload).map_err(|e| unknown(&e))?;
    let mut needed = vec![scene.photos];
    if let Some(checkpoint) = &status.checkpoint {
        needed.push(checkpoint.parse::<ArtefactDigest>().map_err(|e| unknown(&e))?);
    }
    let result = status.outcome.as_deref().map(artefact_of).transpose().map_err(|e| unknown(&e))?;
    needed.extend(result.flatten());
    Ok(needed)
}
