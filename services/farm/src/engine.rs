//! Where jobs wait, who works on which, and what becomes of them.

use std::collections::BTreeMap;
use std::fmt;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::job::{Job, Needs};

/// How far a job is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// Waits for a worker, or for the end of its rest.
    Pending,
    /// Somebody works on it.
    Leased,
    /// Done.
    Done,
    /// Given up: a dead letter.
    Dead,
}

impl JobState {
    /// Every state.
    pub const ALL: [JobState; 4] = [Self::Pending, Self::Leased, Self::Done, Self::Dead];

    /// As a word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Pending => "pending",
            Self::Leased => "leased",
            Self::Done => "done",
            Self::Dead => "dead",
        }
    }
}

/// What kind of failure it was.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ErrorClass {
    /// Another attempt may succeed: a full disk, a killed process, a folder in use.
    Retryable,
    /// Another attempt would fail in the same way: bad input, a wrong setting.
    Fatal,
    /// The system had no file descriptors or processes left, which others hold: another attempt follows after a rest.
    /// Costs no attempt.
    Shortage,
    /// No failure: a stop of the worker was requested. Costs no attempt.
    Stopped,
}

impl ErrorClass {
    /// Every class.
    pub const ALL: [ErrorClass; 4] = [Self::Retryable, Self::Fatal, Self::Shortage, Self::Stopped];

    /// As a word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Retryable => "retryable",
            Self::Fatal => "fatal",
            Self::Shortage => "shortage",
            Self::Stopped => "stopped",
        }
    }
}

/// What publishing a job did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Published {
    /// It is new.
    New,
    /// The same job was there already; how far it is stays as it is.
    Known,
    /// It was there with another payload: it starts again.
    Changed,
}

/// A worker that requests work.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkerOffer {
    /// Who.
    pub worker: String,
    /// What it has free; jobs that need more are left for others.
    pub free: Needs,
    /// What it has in all: jobs that need no more may wait for it, and less urgent ones do not take their capacity.
    pub whole: Needs,
    /// What accelerator it has, by name; jobs that want another one are left for others.
    pub accelerator: Option<String>,
    /// A lease that is not renewed for so long, in seconds, is lost.
    pub lease_s: f64,
}

impl WorkerOffer {
    /// All of a worker that has no accelerator by name.
    pub fn all(worker: impl Into<String>, whole: Needs, lease_s: f64) -> Self {
        Self { worker: worker.into(), free: whole, whole, accelerator: None, lease_s }
    }
}

/// The right to work on a job, until it expires or is renewed.
#[derive(Clone, Debug, PartialEq)]
pub struct JobLease {
    /// The job.
    pub job: Job,
    /// The fence: grows with every claim of the job. Whoever holds an older one is a zombie and is refused.
    pub attempt: u32,
    /// Who holds it.
    pub worker: String,
    /// How many attempts failed before this one, since the job was published or revived.
    pub failures: u32,
    /// When it expires, in seconds since 1970.
    pub until: f64,
    /// How long a renewal lasts, in seconds.
    pub lease_s: f64,
    /// The artefact with the state of the work that an earlier attempt stored.
    pub checkpoint: Option<String>,
    /// Whether the worker does nothing else meanwhile: see [`JobStatus::must_be_alone`].
    pub alone: bool,
}

/// What completing a job did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Completed {
    /// It is done now.
    Now,
    /// This very attempt had completed it with this very outcome before.
    Before,
}

/// What becomes of a job that failed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JobFate {
    /// It is tried again at this time (seconds since 1970).
    Retry {
        /// When.
        due: f64,
    },
    /// It is a dead letter.
    Dead,
    /// It can be claimed at once; no attempt was counted.
    Released,
}

/// Why an engine could not serve.
#[derive(Debug, thiserror::Error)]
pub enum EngineError {
    /// The lease was lost: it expired and somebody else took over, or the job has ended otherwise.
    #[error("attempt {attempt} at `{job}` is no longer the current one: its lease was lost")]
    Lost {
        /// The job.
        job: String,
        /// The attempt that came too late.
        attempt: u32,
    },
    /// No job of that name.
    #[error("there is no job `{0}`")]
    Unknown(String),
    /// A job cannot be changed while somebody works on it.
    #[error("`{0}` cannot be changed while it is being worked on; stop it first")]
    InProgress(String),
    /// The store was written by another version of the program.
    #[error("{} has format {found}, this program knows format {known}: use the version that wrote it, or a new folder", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: i64,
        /// The one known.
        known: i64,
    },
    /// There is none.
    #[error("there is no batch at {}", path.display())]
    Missing {
        /// The file that was searched.
        path: PathBuf,
    },
    /// A server that keeps the jobs does not serve.
    #[error("{server}: {reason}")]
    Server {
        /// Its address, and the farm there.
        server: String,
        /// What is wrong with it.
        #[source]
        reason: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The store cannot be read or written.
    #[error("{}: {reason}", path.display())]
    Store {
        /// The file.
        path: PathBuf,
        /// What it says.
        #[source]
        reason: Box<dyn std::error::Error + Send + Sync>,
    },
}

/// What happened to a job.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ChangeKind {
    /// It was published, or published again with another payload.
    Published,
    /// Somebody took it.
    Claimed,
    /// It is done.
    Completed,
    /// An attempt failed; another follows.
    Retried,
    /// A lease ran out.
    Expired,
    /// It was handed back without an attempt being counted.
    Released,
    /// It became a dead letter.
    Died,
    /// A dead letter may try again.
    Revived,
    /// Who took it cannot start yet.
    Waits,
    /// Who had to wait has started.
    Began,
}

impl ChangeKind {
    pub(crate) const ALL: [ChangeKind; 10] = [
        Self::Published,
        Self::Claimed,
        Self::Completed,
        Self::Retried,
        Self::Expired,
        Self::Released,
        Self::Died,
        Self::Revived,
        Self::Waits,
        Self::Began,
    ];

    /// As a word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Published => "published",
            Self::Claimed => "claimed",
            Self::Completed => "completed",
            Self::Retried => "retried",
            Self::Expired => "expired",
            Self::Released => "released",
            Self::Died => "died",
            Self::Revived => "revived",
            Self::Waits => "waits",
            Self::Began => "began",
        }
    }
}

impl fmt::Display for ChangeKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

/// Something that happened to a job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobChange {
    /// Its position in the order of all changes, from 1.
    pub revision: u64,
    /// Seconds since 1970.
    pub time: f64,
    /// The job.
    pub job: String,
    /// What happened.
    pub kind: ChangeKind,
    /// In which attempt; 0 before the first.
    pub attempt: u32,
    /// By whom, with what outcome, or why.
    pub detail: String,
}

/// A job and how far it is. Times are seconds since 1970.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct JobStatus {
    /// The job.
    pub job: Job,
    /// How far it is.
    pub state: JobState,
    /// How often it was claimed.
    pub attempt: u32,
    /// How many attempts failed since it was published or revived.
    pub failures: u32,
    /// Who works on it.
    pub worker: Option<String>,
    /// When the lease expires.
    pub lease_until: Option<f64>,
    /// Not before this time.
    pub due: f64,
    /// When the last attempt started.
    pub started: Option<f64>,
    /// When the last attempt ended.
    pub ended: Option<f64>,
    /// What came of it.
    pub outcome: Option<String>,
    /// Why the last attempt failed.
    pub error: Option<String>,
    /// What kind of failure that was.
    pub error_class: Option<ErrorClass>,
    /// The artefact with the last stored state of the work: whoever takes the job continues from it.
    #[serde(default)]
    pub checkpoint: Option<String>,
    /// How many workers fell silent while they had it, since it was published or revived.
    #[serde(default)]
    pub silences: u32,
}

impl JobStatus {
    /// Whether its next attempt is the last one, and workers fell silent with it. It may be what silences them, or it was
    /// there when something else did: it is tried on a worker that has nothing else, so that no other job is given up
    /// for it, and it is not given up for another.
    pub fn must_be_alone(&self) -> bool {
        self.silences > 0 && self.failures + 1 >= self.job.retry.attempts
    }
}

/// What a worker has done, as far as the log says it. Times are seconds since 1970, by the clock of the log.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WorkerTally {
    /// Attempts that ended in a result.
    pub done: u64,
    /// Attempts that failed.
    pub failed: u64,
    /// Jobs that were handed back as they were.
    pub returned: u64,
    /// Jobs that it fell silent with.
    pub silent: u64,
    /// Why it takes no jobs for now; `None` where it takes them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paused: Option<String>,
    /// When it last announced itself, took, renewed, stored or ended a job, or kept capacity for one.
    pub seen: f64,
    /// What it has in all, as it last announced; `None` where it never did, or the log has forgotten it.
    #[serde(default)]
    pub whole: Option<Needs>,
    /// What accelerator it has, by name.
    #[serde(default)]
    pub accelerator: Option<String>,
    /// The record that says so.
    pub(crate) seen_by: u64,
}

/// How long an engine's log is, and what reading it has cost this handle.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FarmLogState {
    /// Records in the log when it was last read to its end.
    pub records: u64,
    /// Records that this handle has read and folded into its table so far.
    pub read_records: u64,
    /// Time that this took, in seconds.
    pub read_s: f64,
    /// Those of them that are void for this handle, so that they changed nothing; for a handle without a key, also those that are
    /// signed. A snapshot that was made with another key counts as one. Where there are any, the farm may have another key, and
    /// the table may not be that of its other machines.
    #[serde(default)]
    pub void_records: u64,
}

/// Jobs with leases. Deliveries are at least once; the fence makes effects exactly once.
///
/// Every engine passes [`conformance`](crate::conformance).
pub trait JobEngine: Send + Sync {
    /// Hands in a job. The same job again changes nothing but its priority, needs and retries.
    ///
    /// # Errors
    /// [`EngineError::InProgress`] for another payload while somebody works on it; when the store fails.
    fn publish(&self, job: &Job) -> Result<Published, EngineError>;

    /// Takes the most urgent job that fits the offer and whose rest is over, if there is one. A more urgent one that
    /// waits for capacity keeps it: see [`turns`](crate::turns).
    ///
    /// # Errors
    /// When the store fails.
    fn claim(&self, offer: &WorkerOffer) -> Result<Option<JobLease>, EngineError>;

    /// Says what a worker has in all (`whole` and `accelerator` of the offer), and that it lives: for those who watch.
    ///
    /// # Errors
    /// When the store fails.
    fn announce(&self, offer: &WorkerOffer) -> Result<(), EngineError>;

    /// Renews a lease, and returns until when.
    ///
    /// # Errors
    /// [`EngineError::Lost`] when it is too late: the worker must leave the work. When the store fails.
    fn heartbeat(&self, lease: &JobLease) -> Result<f64, EngineError>;

    /// Ends a job as done. A late completion counts as long as nobody else has taken the job.
    ///
    /// # Errors
    /// [`EngineError::Lost`] for a zombie; when the store fails.
    fn complete(&self, lease: &JobLease, outcome: &str) -> Result<Completed, EngineError>;

    /// Ends an attempt that did not succeed.
    ///
    /// # Errors
    /// [`EngineError::Lost`] for a zombie; when the store fails.
    fn fail(&self, lease: &JobLease, class: ErrorClass, error: &str) -> Result<JobFate, EngineError>;

    /// Lets a dead letter try again, from the first attempt on.
    ///
    /// # Errors
    /// [`EngineError::Unknown`] when there is no dead letter of that name; when the store fails.
    fn revive(&self, id: &str) -> Result<(), EngineError>;

    /// Hands back the leases of a worker, or of all, without counting an attempt; returns how many. Only for who knows
    /// that the holders do not live: who holds a lock that they have lost.
    ///
    /// # Errors
    /// When the store fails.
    fn release(&self, worker: Option<&str>, reason: &str) -> Result<usize, EngineError>;

    /// Forgets jobs that are not wanted any more, but for those that somebody works on, and returns how many; what
    /// happened to them stays recorded.
    ///
    /// # Errors
    /// When the store fails.
    fn withdraw(&self, ids: &[String]) -> Result<usize, EngineError>;

    /// Notes that who holds a lease cannot start yet, and why; or, with `None`, that it has started after all.
    ///
    /// # Errors
    /// [`EngineError::Lost`] for a zombie; when the store fails.
    fn note_wait(&self, lease: &JobLease, reason: Option<&str>) -> Result<(), EngineError>;

    /// Notes that the state of the work is stored as this artefact: whoever takes the job next continues from it.
    ///
    /// # Errors
    /// [`EngineError::Lost`] for a zombie; when the store fails.
    fn checkpoint(&self, lease: &JobLease, artefact: &str) -> Result<(), EngineError>;

    /// What happened after a revision, in order; at most `limit` changes. Of what happened long ago, an engine may have
    /// forgotten the oldest.
    ///
    /// # Errors
    /// When the store fails.
    fn watch(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError>;

    /// All jobs, in the order in which they were first published.
    ///
    /// # Errors
    /// When the store fails.
    fn jobs(&self) -> Result<Vec<JobStatus>, EngineError>;

    /// The jobs that somebody has taken and cannot start yet, and why.
    ///
    /// # Errors
    /// When the store fails.
    fn waits(&self) -> Result<BTreeMap<String, String>, EngineError>;

    /// How often something has happened, over all jobs and ever.
    ///
    /// # Errors
    /// When the store fails.
    fn count(&self, kind: ChangeKind) -> Result<u64, EngineError>;

    /// Which jumps of the wall clock this handle has met since it was last called, in seconds; back is negative. Rests
    /// and leases moved along with the clock.
    ///
    /// # Errors
    /// When the store fails.
    fn jumps(&self) -> Result<Vec<f64>, EngineError>;

    /// What each worker has done, by its name. An engine may have forgotten workers that were not seen for longest; one for a
    /// single machine need not remember any.
    ///
    /// # Errors
    /// When the store fails.
    fn tallies(&self) -> Result<BTreeMap<String, WorkerTally>, EngineError> {
        Ok(BTreeMap::new())
    }

    /// Notes that a worker takes no jobs for now, and why; or, with `None`, that it takes them again. An engine for a single
    /// machine need not remember it.
    ///
    /// # Errors
    /// When the store fails.
    fn note_pause(&self, _worker: &str, _reason: Option<&str>) -> Result<(), EngineError> {
        Ok(())
    }

    /// How long the log is, when it was last read; `None` where the engine keeps none that others read.
    fn log_state(&self) -> Option<FarmLogState> {
        None
    }

    /// The time by the clock of the log, in seconds since 1970, as far as who only reads it knows: when the newest record was
    /// stored, and how long ago this handle read it. `None` where times are by this machine's clock.
    fn log_time(&self) -> Option<f64> {
        None
    }
}
