//! A log of transitions is an engine.

use std::collections::BTreeMap;

use crate::engine::{
    ChangeKind, Completed, EngineError, ErrorClass, FarmLogState, JobChange, JobEngine, JobFate, JobLease,
    JobStatus, Published, WorkerOffer, WorkerTally,
};
use crate::job::Job;
use crate::table::{Decision, JobTable};

/// Where transitions are kept, one after the other, for everybody in the same order. Whoever keeps one has a
/// [`JobEngine`]: the state machine is the [`JobTable`]'s.
pub trait TransitionLog: Send + Sync {
    /// Lets `decide` see the table as it is and the time, appends what it decides before anybody else appends anything,
    /// applies it, and lets `then` see the table right after. Where somebody else was first, it decides again.
    ///
    /// # Errors
    /// What `decide` refuses; when the log cannot be read or written.
    fn transact<A, R>(
        &self,
        decide: impl Fn(&JobTable, f64) -> Decision<A>,
        then: impl FnOnce(&JobTable, A) -> R,
    ) -> Result<R, EngineError>;

    /// Lets `read` see the table as it is.
    ///
    /// # Errors
    /// When the log cannot be read.
    fn with_table<R>(&self, read: impl FnOnce(&JobTable) -> R) -> Result<R, EngineError>;

    /// What was reported after a revision, in order; at most `limit` changes.
    ///
    /// # Errors
    /// When the log cannot be read.
    fn changes(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError>;

    /// How often something has happened, over all jobs and ever.
    ///
    /// # Errors
    /// When the log cannot be read.
    fn count_of(&self, kind: ChangeKind) -> Result<u64, EngineError>;

    /// Which jumps of the wall clock this handle has met since it was last called, in seconds; back is negative.
    ///
    /// # Errors
    /// When the log cannot be read or written.
    fn met_jumps(&self) -> Result<Vec<f64>, EngineError>;

    /// How long it is, when it was last read; `None` where it is a file of this machine.
    fn extent_read(&self) -> Option<FarmLogState> {
        None
    }

    /// The time by the clock of the log, as far as its newest record shows it; `None` where that is this machine's clock.
    fn time_read(&self) -> Option<f64> {
        None
    }
}

impl<L: TransitionLog> JobEngine for L {
    fn publish(&self, job: &Job) -> Result<Published, EngineError> {
        self.transact(|table, _| table.publish(job), |_, published| published)
    }

    fn claim(&self, offer: &WorkerOffer) -> Result<Option<JobLease>, EngineError> {
        let then = |table: &JobTable, job: Option<String>| table.lease(&job?, offer.lease_s);
        self.transact(|table, now| table.claim(offer, now), then)
    }

    fn announce(&self, offer: &WorkerOffer) -> Result<(), EngineError> {
        self.transact(|table, _| table.announce(offer), |_, ()| ())
    }

    fn heartbeat(&self, lease: &JobLease) -> Result<f64, EngineError> {
        let until = |table: &JobTable| table.job(&lease.job.id)?.lease_until;
        self.transact(|table, _| table.heartbeat(lease), |table, ()| until(table).unwrap_or(lease.until))
    }

    fn complete(&self, lease: &JobLease, outcome: &str) -> Result<Completed, EngineError> {
        self.transact(|table, _| table.complete(lease, outcome), |_, completed| completed)
    }

    fn fail(&self, lease: &JobLease, class: ErrorClass, error: &str) -> Result<JobFate, EngineError> {
        let fate = |table: &JobTable, released: bool| match released {
            true => JobFate::Released,
            false => table.fate(&lease.job.id),
        };
        self.transact(|table, _| table.fail(lease, class, error), fate)
    }

    fn revive(&self, id: &str) -> Result<(), EngineError> {
        self.transact(|table, _| table.revive(id), |_, ()| ())
    }

    fn release(&self, worker: Option<&str>, reason: &str) -> Result<usize, EngineError> {
        self.transact(|table, _| table.release(worker, reason), |_, count| count)
    }

    fn withdraw(&self, ids: &[String]) -> Result<usize, EngineError> {
        self.transact(|table, _| table.withdraw(ids), |_, count| count)
    }

    fn note_wait(&self, lease: &JobLease, reason: Option<&str>) -> Result<(), EngineError> {
        self.transact(|table, _| table.note_wait(lease, reason), |_, ()| ())
    }

    fn note_pause(&self, worker: &str, reason: Option<&str>) -> Result<(), EngineError> {
        self.transact(|table, _| table.note_pause(worker, reason), |_, ()| ())
    }

    fn checkpoint(&self, lease: &JobLease, artefact: &str) -> Result<(), EngineError> {
        self.transact(|table, _| table.checkpoint(lease, artefact), |_, ()| ())
    }

    fn watch(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError> {
        self.changes(after, limit)
    }

    fn jobs(&self) -> Result<Vec<JobStatus>, EngineError> {
        self.with_table(|table| table.jobs().cloned().collect())
    }

    fn waits(&self) -> Result<BTreeMap<String, String>, EngineError> {
        self.with_table(JobTable::waits)
    }

    fn count(&self, kind: ChangeKind) -> Result<u64, EngineError> {
        self.count_of(kind)
    }

    fn jumps(&self) -> Result<Vec<f64>, EngineError> {
        self.met_jumps()
    }

    fn tallies(&self) -> Result<BTreeMap<String, WorkerTally>, EngineError> {
        self.with_table(|table| table.workers.clone())
    }

    fn log_state(&self) -> Option<FarmLogState> {
        self.extent_read()
    }

    fn log_time(&self) -> Option<f64> {
        self.time_read()
    }
}
