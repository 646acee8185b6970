//! Where an engine is checked, how it fails a check, and the steps that checks share.

use crate::engine::{EngineError, JobEngine, JobFate, JobLease, JobState, WorkerOffer};
use crate::job::{Job, Needs, Retry};
use std::fmt::Debug;

/// The engine under test with its clock, nothing published yet.
pub trait Site: Sync {
    /// A handle to the engine; a further call is as from another process.
    fn engine(&self) -> Box<dyn JobEngine>;

    /// Lets time pass for the engine, by its clock or by waiting.
    fn pass(&self, seconds: f64);

    /// Sets the wall clock of the engine ahead, or back, while no time passes. An engine that reads none ignores it.
    fn jump(&self, seconds: f64);
}

/// How an engine fails a check.
#[derive(Debug, thiserror::Error)]
pub enum ConformanceFailure {
    /// It cannot serve.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// It answers something else.
    #[error("{what}: {found} instead of {wanted}")]
    Differs {
        /// What was compared.
        what: String,
        /// What the engine gives.
        found: String,
        /// What it should give.
        wanted: String,
    },
    /// A call has another outcome than it should.
    #[error("{what}: {found}")]
    Outcome {
        /// The call.
        what: &'static str,
        /// Its outcome.
        found: String,
    },
    /// Who has lost a lease can still use it.
    #[error("{what} is not refused as lost: {found}")]
    NotLost {
        /// The call.
        what: String,
        /// Its outcome.
        found: String,
    },
    /// A job that failed does not rest.
    #[error("failure {failures} ends in {fate:?}")]
    NoRest {
        /// Failures of the job before this one.
        failures: u32,
        /// What becomes of it.
        fate: JobFate,
    },
    /// A shortage of the machine does not let the job rest.
    #[error("its fate is {0:?}")]
    NoShortage(JobFate),
    /// A worker is given no job although one waits that fits.
    #[error("{0} is given nothing")]
    NothingGiven(String),
    /// A job is given to a worker that should get none.
    #[error("{when}, `{job}` is given")]
    GivenInVain {
        /// When.
        when: String,
        /// The job.
        job: String,
    },
    /// A published job is not in the list.
    #[error("`{0}` is not listed")]
    NotListed(String),
    /// The engine made a worker's thread panic.
    #[error("a worker panicked")]
    Panicked,
}

/// Seconds that a lease of the suite lasts.
pub const LEASE_S: f64 = 2.0;
/// Rest after the first failure in the suite, in seconds.
pub const REST_S: f64 = 1.0;

/// A day, either way.
pub const JUMPS_S: [f64; 2] = [-86_400.0, 86_400.0];

/// A job that is tried three times.
pub fn job(id: &str) -> Job {
    let needs = Needs { cores: 1, memory_bytes: 100, accelerators: 0 };
    let retry = Retry { attempts: 3, first_delay_s: REST_S, longest_delay_s: 60.0 };
    Job { retry, ..Job::new(id, format!("do {id}"), needs) }
}

/// What an idle worker offers.
pub fn offer(worker: &str) -> WorkerOffer {
    WorkerOffer::all(worker, Needs { cores: 4, memory_bytes: 1000, accelerators: 1 }, LEASE_S)
}

/// Fails where an engine gives something else.
pub fn expect<T: PartialEq + Debug>(what: &str, found: T, wanted: T) -> Result<(), ConformanceFailure> {
    if found == wanted {
        return Ok(());
    }
    let (found, wanted) = (format!("{found:?}"), format!("{wanted:?}"));
    Err(ConformanceFailure::Differs { what: what.to_owned(), found, wanted })
}

/// The failure of a call that ends otherwise than it should.
pub fn outcome(what: &'static str, found: &dyn Debug) -> ConformanceFailure {
    ConformanceFailure::Outcome { what, found: format!("{found:?}") }
}

/// The job that a worker is given.
pub fn claim(engine: &dyn JobEngine, worker: &str) -> Result<JobLease, ConformanceFailure> {
    engine.claim(&offer(worker))?.ok_or_else(|| ConformanceFailure::NothingGiven(worker.to_owned()))
}

/// Fails where a worker is given a job.
pub fn nothing(engine: &dyn JobEngine, when: &str) -> Result<(), ConformanceFailure> {
    match engine.claim(&offer("anybody"))? {
        None => Ok(()),
        Some(lease) => Err(ConformanceFailure::GivenInVain { when: when.to_owned(), job: lease.job.id }),
    }
}

/// Fails where a call is not refused since its lease is lost.
pub fn lost<T: Debug>(what: &str, result: Result<T, EngineError>) -> Result<(), ConformanceFailure> {
    match result {
        Err(EngineError::Lost { .. }) => Ok(()),
        other => Err(ConformanceFailure::NotLost { what: what.to_owned(), found: format!("{other:?}") }),
    }
}

/// The state of a job.
pub fn state(engine: &dyn JobEngine, id: &str) -> Result<JobState, ConformanceFailure> {
    let jobs = engine.jobs()?;
    let found = jobs.iter().find(|j| j.job.id == id).map(|j| j.state);
    found.ok_or_else(|| ConformanceFailure::NotListed(id.to_owned()))
}
