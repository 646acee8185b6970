//! Jobs that somebody has taken and cannot start yet, for those who read the store.

use std::collections::BTreeMap;

use crate::embedded::{EmbeddedEngine, held, note};
use crate::engine::{ChangeKind, EngineError, JobLease};

impl EmbeddedEngine {
    /// Notes that who holds a lease cannot start yet, and why; or, with `None`, that it has started after all.
    ///
    /// # Errors
    /// [`EngineError::Lost`] for a zombie; when the store fails.
    pub fn note_wait(&self, lease: &JobLease, reason: Option<&str>) -> Result<(), EngineError> {
        self.write(|t, now| {
            if let Err(lost) = held(t, lease)? {
                return Ok(Err(lost));
            }
            let kind = if reason.is_some() { ChangeKind::Waits } else { ChangeKind::Began };
            note(t, now, &lease.job.id, kind, lease.attempt, reason.unwrap_or(""))?;
            Ok(Ok(()))
        })
    }

    /// The jobs that somebody has taken and cannot start yet, and why.
    ///
    /// # Errors
    /// When the store fails.
    pub fn waits(&self) -> Result<BTreeMap<String, String>, EngineError> {
        self.read(|c| {
            c.prepare(
                "SELECT job, detail FROM changes WHERE kind = 'waits' AND revision IN
                   (SELECT max(revision) FROM changes JOIN jobs ON jobs.id = changes.job
                    WHERE jobs.state = 'leased' GROUP BY job)",
            )?
            .query_map([], |row| Ok((row.get(0)?, row.get(1)?)))?
            .collect()
        })
    }
}
