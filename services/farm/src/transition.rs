//! What can happen to jobs, as it is kept in a log.

use serde::{Deserialize, Serialize};

use crate::engine::ErrorClass;
use crate::job::{Job, Needs};

/// One change of the jobs. It says what was decided; what follows from it (when a rest ends, whether a failure was the
/// last) is computed by [`JobTable::apply`](crate::JobTable::apply), by everybody in the same way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Transition {
    /// A job was handed in: a new one, or a known one with another payload or other terms.
    Published(Job),
    /// A worker took a job.
    Claimed {
        /// The job.
        job: String,
        /// Who took it.
        worker: String,
        /// How long the lease lasts without a renewal, in seconds.
        lease_s: f64,
    },
    /// A lease was renewed.
    Renewed {
        /// The job.
        job: String,
        /// For how long, in seconds.
        lease_s: f64,
    },
    /// A lease ran out.
    Expired {
        /// The job.
        job: String,
    },
    /// A job is done.
    Completed {
        /// The job.
        job: String,
        /// What came of it.
        outcome: String,
    },
    /// An attempt failed.
    Failed {
        /// The job.
        job: String,
        /// In what way.
        class: ErrorClass,
        /// Why.
        error: String,
    },
    /// A job was handed back; no attempt is counted.
    Released {
        /// The job.
        job: String,
        /// Why.
        reason: String,
    },
    /// A dead letter may try again.
    Revived {
        /// The job.
        job: String,
    },
    /// A job is not wanted any more.
    Withdrawn {
        /// The job.
        job: String,
    },
    /// Who holds a job cannot start yet, or, without a reason, has started after all.
    Waited {
        /// The job.
        job: String,
        /// Why it cannot.
        reason: Option<String>,
    },
    /// The state of the work was stored where any worker finds it.
    Stored {
        /// The job.
        job: String,
        /// The artefact that holds the copy.
        checkpoint: String,
    },
    /// A worker keeps capacity free for a job, so that no other one needs to.
    Kept {
        /// The job.
        job: String,
        /// The worker.
        worker: String,
        /// For how long, in seconds.
        keep_s: f64,
    },
    /// A worker says what it has, and that it lives.
    Announced {
        /// The worker.
        worker: String,
        /// What it has in all.
        whole: Needs,
        /// What accelerator it has, by name.
        accelerator: Option<String>,
    },
    /// A worker takes no jobs for now, or, without a reason, takes them again.
    Paused {
        /// The worker.
        worker: String,
        /// Why it takes none.
        reason: Option<String>,
    },
    /// The wall clock was set while no time passed: all times to come move along.
    ClockSet {
        /// By how much, in seconds; back is negative.
        seconds: f64,
        /// What was written from this record on is in the time of the new clock already.
        since: u64,
    },
    /// All times to come move, and no clock was set: as nobody could renew a lease while the log was out of reach.
    TimesMoved {
        /// By how much, in seconds.
        seconds: f64,
        /// What was written from this record on does not move.
        since: u64,
    },
    /// A rest was started under another clock and is over.
    RestEnded {
        /// The job.
        job: String,
    },
}

impl Transition {
    /// The job; `None` where it is about all of them, or about a worker.
    pub fn job(&self) -> Option<&str> {
        match self {
            Self::Published(job) => Some(&job.id),
            Self::Claimed { job, .. }
            | Self::Renewed { job, .. }
            | Self::Expired { job }
            | Self::Completed { job, .. }
            | Self::Failed { job, .. }
            | Self::Released { job, .. }
            | Self::Revived { job }
            | Self::Withdrawn { job }
            | Self::Waited { job, .. }
            | Self::Stored { job, .. }
            | Self::Kept { job, .. }
            | Self::RestEnded { job } => Some(job),
            Self::Announced { .. }
            | Self::Paused { .. }
            | Self::ClockSet { .. }
            | Self::TimesMoved { .. } => None,
        }
    }
}
