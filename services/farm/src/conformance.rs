//! What every engine has to do, as one suite of checks.
//!
//! ```
//! use segwild_farm::{EmbeddedEngine, JobEngine, SimulatedClock, conformance};
//! use std::sync::Arc;
//!
//! struct Here { folder: tempfile::TempDir, clock: SimulatedClock }
//! impl conformance::Site for Here {
//!     fn engine(&self) -> Box<dyn JobEngine> {
//!         let path = self.folder.path().join("jobs.sqlite");
//!         Box::new(EmbeddedEngine::with_clock(path, Arc::new(self.clock.clone())).unwrap())
//!     }
//!     fn pass(&self, seconds: f64) { self.clock.pass(seconds) }
//!     fn jump(&self, seconds: f64) { self.clock.jump(seconds) }
//! }
//! let site = || -> Box<dyn conformance::Site> {
//!     Box::new(Here { folder: tempfile::tempdir().unwrap(), clock: SimulatedClock::new(1e9) })
//! };
//! assert_eq!(conformance::broken(&site), []);
//! ```

use std::collections::BTreeMap;
use std::fmt::Debug;

use crate::engine::{
    ChangeKind, Completed, EngineError, ErrorClass, JobEngine, JobFate, JobLease, JobState, Published,
    WorkerOffer,
};
use crate::job::{Job, Needs, Retry};

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

/// A check: its name, and what it does with a fresh site.
pub type ConformanceCheck = (&'static str, fn(&dyn Site) -> Result<(), ConformanceFailure>);

/// Seconds that a lease of the suite lasts.
const LEASE_S: f64 = 2.0;
/// Rest after the first failure in the suite, in seconds.
const REST_S: f64 = 1.0;

/// The suite.
pub const CHECKS: [ConformanceCheck; 27] = [
    ("publishing twice is publishing once", publishing_twice),
    ("another payload starts again, but not under a worker's hands", another_payload),
    ("the most urgent job goes first, equals in order", urgency),
    ("a job that does not fit is left for a worker that has the capacity", fitting),
    ("a job that wants an accelerator by name is left for who has that one", named_accelerator),
    ("what a more urgent job waits for is not given to a less urgent one", reserving_capacity),
    ("one worker gets free for a more urgent job, and the others go on", kept_by_one),
    ("no job is given to two workers", one_worker_per_job),
    ("a heartbeat holds a lease beyond its time", heartbeat_holds),
    ("a silent worker loses its lease, and the next attempt has a higher fence", silence),
    ("a zombie's heartbeat, completion and failure are refused", zombie),
    ("a late completion counts while nobody else has taken the job", late_completion),
    ("completing twice is completing once", completing_twice),
    ("a retryable failure rests, each time twice as long", back_off),
    ("a job that keeps failing becomes a dead letter", attempts_end),
    ("a rest lasts as long as it should under a clock that jumps", rest_under_jumps),
    ("a lease lasts as long as it should under a clock that jumps", lease_under_jumps),
    ("a fatal failure is a dead letter at once", fatal),
    ("a job that silences every worker becomes a dead letter", silent_to_death),
    (
        "a job that may silence workers is tried alone the last time, and others are not given up for it",
        tried_alone,
    ),
    ("being stopped costs no attempt", stopping),
    ("a shortage of the machine rests, and costs no attempt", shortage),
    ("a dead letter can be revived, and nothing else can", reviving),
    ("a worker that starts again hands back what it held before, and no more", releasing),
    ("what is not wanted any more is forgotten, but not under a worker's hands", withdrawing),
    ("who takes a job over finds its last checkpoint, and a zombie stores none", checkpoints),
    ("changes are reported in order to any handle, from any revision", watching),
];

/// Puts an engine through the suite, each check on a site of its own, and says which checks it fails and why.
pub fn broken(site: &dyn Fn() -> Box<dyn Site>) -> Vec<(&'static str, String)> {
    let failed =
        |(name, check): &ConformanceCheck| check(&*site()).err().map(|failure| (*name, failure.to_string()));
    CHECKS.iter().filter_map(failed).collect()
}

fn job(id: &str) -> Job {
    let needs = Needs { cores: 1, memory_bytes: 100, accelerators: 0 };
    let retry = Retry { attempts: 3, first_delay_s: REST_S, longest_delay_s: 60.0 };
    Job { retry, ..Job::new(id, format!("do {id}"), needs) }
}

fn offer(worker: &str) -> WorkerOffer {
    WorkerOffer::all(worker, Needs { cores: 4, memory_bytes: 1000, accelerators: 1 }, LEASE_S)
}

fn expect<T: PartialEq + Debug>(what: &str, found: T, wanted: T) -> Result<(), ConformanceFailure> {
    if found == wanted {
        return Ok(());
    }
    let (found, wanted) = (format!("{found:?}"), format!("{wanted:?}"));
    Err(ConformanceFailure::Differs { what: what.to_owned(), found, wanted })
}

fn outcome(what: &'static str, found: &dyn Debug) -> ConformanceFailure {
    ConformanceFailure::Outcome { what, found: format!("{found:?}") }
}

fn claim(engine: &dyn JobEngine, worker: &str) -> Result<JobLease, ConformanceFailure> {
    engine.claim(&offer(worker))?.ok_or_else(|| ConformanceFailure::NothingGiven(worker.to_owned()))
}

fn nothing(engine: &dyn JobEngine, when: &str) -> Result<(), ConformanceFailure> {
    match engine.claim(&offer("anybody"))? {
        None => Ok(()),
        Some(lease) => Err(ConformanceFailure::GivenInVain { when: when.to_owned(), job: lease.job.id }),
    }
}

fn lost<T: Debug>(what: &str, result: Result<T, EngineError>) -> Result<(), ConformanceFailure> {
    match result {
        Err(EngineError::Lost { .. }) => Ok(()),
        other => Err(ConformanceFailure::NotLost { what: what.to_owned(), found: format!("{other:?}") }),
    }
}

fn state(engine: &dyn JobEngine, id: &str) -> Result<JobState, ConformanceFailure> {
    let jobs = engine.jobs()?;
    let found = jobs.iter().find(|j| j.job.id == id).map(|j| j.state);
    found.ok_or_else(|| ConformanceFailure::NotListed(id.to_owned()))
}

fn publishing_twice(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    expect("the first time", engine.publish(&job("a"))?, Published::New)?;
    expect("the second time", site.engine().publish(&job("a"))?, Published::Known)?;
    let lease = claim(&*engine, "w")?;
    expect("while it is worked on", engine.publish(&job("a"))?, Published::Known)?;
    engine.complete(&lease, "done")?;
    expect("when it is done", engine.publish(&job("a"))?, Published::Known)?;
    nothing(&*engine, "done and published again")?;
    expect("jobs", engine.jobs()?.len(), 1)
}

fn another_payload(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let changed = Job { payload: "do it differently".into(), ..job("a") };
    let lease = claim(&*engine, "w")?;
    match engine.publish(&changed) {
        Err(EngineError::InProgress(_)) => {}
        other => return Err(outcome("changing it under a worker's hands", &other)),
    }
    engine.complete(&lease, "done")?;
    expect("when it is done", engine.publish(&changed)?, Published::Changed)?;
    let again = claim(&*engine, "w")?;
    expect("the payload", again.job.payload.as_str(), "do it differently")?;
    expect("a higher fence", again.attempt > lease.attempt, true)
}

fn urgency(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for (id, priority) in [("low", -1), ("first", 0), ("second", 0), ("high", 5)] {
        engine.publish(&Job { priority, ..job(id) })?;
    }
    for wanted in ["high", "first", "second", "low"] {
        expect("the next", claim(&*engine, "w")?.job.id.as_str(), wanted)?;
    }
    nothing(&*engine, "with every job taken")
}

fn fitting(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let large = Needs { cores: 8, memory_bytes: 100, accelerators: 0 };
    engine.publish(&Job { needs: large, priority: 9, ..job("large") })?;
    engine.publish(&job("small"))?;
    expect("what fits", claim(&*engine, "w")?.job.id.as_str(), "small")?;
    nothing(&*engine, "with only the large job left")?;
    let roomy = WorkerOffer { free: Needs { cores: 8, ..offer("w").free }, ..offer("roomy") };
    let given = engine.claim(&roomy)?;
    let lease = given.ok_or_else(|| ConformanceFailure::NothingGiven("a worker with the capacity".into()))?;
    expect("to the worker with the capacity", lease.job.id.as_str(), "large")
}

fn named_accelerator(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let wanted = |name: &str| Some(name.to_owned());
    engine.publish(&Job { accelerator: wanted("h100"), priority: 9, ..job("picky") })?;
    engine.publish(&job("any"))?;
    expect("without a name", claim(&*engine, "w")?.job.id.as_str(), "any")?;
    nothing(&*engine, "with only the picky one left")?;
    let other = WorkerOffer { accelerator: wanted("l4"), ..offer("other") };
    expect("with another one", engine.claim(&other)?, None)?;
    let given = site.engine().claim(&WorkerOffer { accelerator: wanted("h100"), ..offer("right") })?;
    expect("with the right one", given.map(|lease| lease.job.id).as_deref(), Some("picky"))
}

fn reserving_capacity(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let whole = Needs { accelerators: 2, ..offer("w").free };
    let with = |id: &str, priority, accelerators| {
        let needs = Needs { accelerators, ..job(id).needs };
        Job { priority, needs, ..job(id) }
    };
    for job in [with("both", 9, 2), with("one", 1, 1), with("none", 0, 0), with("too many", 99, 3)] {
        engine.publish(&job)?;
    }
    let claim = |accelerators| {
        let free = Needs { accelerators, ..whole };
        let lease = engine.claim(&WorkerOffer { free, whole, ..offer("w") })?;
        Ok::<_, ConformanceFailure>(lease.map(|lease| lease.job.id))
    };
    // One of two accelerators is free: it is kept for the job that needs both.
    expect("what needs none goes ahead", claim(1)?.as_deref(), Some("none"))?;
    expect("with one accelerator free", claim(1)?, None)?;
    expect("with both free", claim(2)?.as_deref(), Some("both"))?;
    // What this worker could never take holds nobody up.
    expect("with one free again", claim(1)?.as_deref(), Some("one"))
}

fn kept_by_one(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let whole = Needs { accelerators: 2, ..offer("w").free };
    let with = |id: &str, priority, accelerators| {
        let needs = Needs { accelerators, ..job(id).needs };
        Job { priority, needs, ..job(id) }
    };
    for job in [with("both", 9, 2), with("one", 1, 1), with("another", 1, 1)] {
        engine.publish(&job)?;
    }
    let claim = |worker: &str, accelerators| {
        let free = Needs { accelerators, ..whole };
        let lease = site.engine().claim(&WorkerOffer { free, whole, ..offer(worker) })?;
        Ok::<_, ConformanceFailure>(lease.map(|lease| lease.job.id))
    };
    expect("who keeps one accelerator free", claim("w", 1)?, None)?;
    expect("another worker", claim("v", 1)?.as_deref(), Some("one"))?;
    expect("who keeps it, still", claim("w", 1)?, None)?;
    // It fell silent: somebody else gets free for the job.
    site.pass(3600.0);
    expect("another worker, later", claim("v", 1)?, None)?;
    expect("who kept it before", claim("w", 1)?.as_deref(), Some("another"))?;
    expect("who is free", claim("v", 2)?.as_deref(), Some("both"))
}

fn one_worker_per_job(site: &dyn Site) -> Result<(), ConformanceFailure> {
    const JOBS: usize = 24;
    let engine = site.engine();
    for i in 0..JOBS {
        engine.publish(&job(&format!("job {i}")))?;
    }
    let taken = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..4)
            .map(|w| {
                scope.spawn(move || -> Result<Vec<String>, ConformanceFailure> {
                    let (engine, mut mine) = (site.engine(), Vec::new());
                    while let Some(lease) = engine.claim(&offer(&format!("w{w}")))? {
                        engine.complete(&lease, "done")?;
                        mine.push(lease.job.id);
                    }
                    Ok(mine)
                })
            })
            .collect();
        let joined = workers.into_iter().map(|w| w.join().unwrap_or(Err(ConformanceFailure::Panicked)));
        joined.collect::<Result<Vec<_>, _>>()
    })?;
    let mut counts = BTreeMap::new();
    for id in taken.into_iter().flatten() {
        *counts.entry(id).or_insert(0) += 1;
    }
    expect("jobs done", counts.len(), JOBS)?;
    expect("jobs done twice", counts.values().filter(|&&n| n != 1).count(), 0)
}

fn heartbeat_holds(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    for _ in 0..4 {
        site.pass(LEASE_S * 0.6);
        nothing(&*site.engine(), "while its worker beats")?;
        engine.heartbeat(&lease)?;
    }
    expect("completing it", engine.complete(&lease, "done")?, Completed::Now)
}

/// Publishes a job, lets a worker take it and fall silent, and another one take over.
fn taken_over(site: &dyn Site, engine: &dyn JobEngine) -> Result<(JobLease, JobLease), ConformanceFailure> {
    engine.publish(&job("a"))?;
    let zombie = claim(engine, "zombie")?;
    nothing(engine, "before the lease ends")?;
    site.pass(LEASE_S * 1.5);
    // Whoever looks first notices; the job then rests as after any failure.
    nothing(engine, "during the rest after a lost lease")?;
    site.pass(REST_S * 1.5);
    Ok((zombie, claim(&*site.engine(), "heir")?))
}

fn silence(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let (zombie, heir) = taken_over(site, &*engine)?;
    expect("the same job", &heir.job.id, &zombie.job.id)?;
    expect("a higher fence", heir.attempt > zombie.attempt, true)?;
    let changes = engine.watch(0, usize::MAX)?;
    expect("it is reported", changes.iter().any(|c| c.kind == ChangeKind::Expired), true)
}

fn zombie(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let (zombie, heir) = taken_over(site, &*engine)?;
    lost("a zombie's heartbeat", engine.heartbeat(&zombie))?;
    lost("a zombie's completion", engine.complete(&zombie, "stale"))?;
    lost("a zombie's failure", engine.fail(&zombie, ErrorClass::Fatal, "stale"))?;
    expect("the heir completes", engine.complete(&heir, "fresh")?, Completed::Now)?;
    lost("a zombie's completion after the end", engine.complete(&zombie, "stale"))?;
    let jobs = engine.jobs()?;
    expect("the outcome", jobs[0].outcome.as_deref(), Some("fresh"))
}

fn late_completion(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    site.pass(LEASE_S * 1.5);
    expect("completing late", engine.complete(&lease, "done")?, Completed::Now)?;
    nothing(&*engine, "after that")
}

fn completing_twice(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    expect("the first time", engine.complete(&lease, "done")?, Completed::Now)?;
    expect("the second time", site.engine().complete(&lease, "done")?, Completed::Before)?;
    lost("another outcome", engine.complete(&lease, "something else"))?;
    lost("a failure after the end", engine.fail(&lease, ErrorClass::Retryable, "late"))?;
    let changes = engine.watch(0, usize::MAX)?;
    expect("completions reported", changes.iter().filter(|c| c.kind == ChangeKind::Completed).count(), 1)
}

fn back_off(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&Job { retry: Retry { attempts: 9, ..job("a").retry }, ..job("a") })?;
    for failures in 0..3 {
        let lease = claim(&*engine, "w")?;
        match engine.fail(&lease, ErrorClass::Retryable, "no luck")? {
            JobFate::Retry { .. } => {}
            fate => return Err(ConformanceFailure::NoRest { failures, fate }),
        }
        let rest = REST_S * f64::from(1 << failures);
        site.pass(rest * 0.5);
        nothing(&*engine, "during the rest")?;
        site.pass(rest * 0.75);
    }
    claim(&*engine, "w").map(drop)
}

/// A day, either way.
const JUMPS_S: [f64; 2] = [-86_400.0, 86_400.0];

fn rest_under_jumps(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    let retry = Retry { attempts: 9, longest_delay_s: REST_S, ..job("a").retry };
    engine.publish(&Job { retry, ..job("a") })?;
    for jump in JUMPS_S {
        let lease = claim(&*engine, "w")?;
        engine.fail(&lease, ErrorClass::Retryable, "no luck")?;
        site.jump(jump);
        nothing(&*engine, &format!("in a rest, after a jump of {jump} s"))?;
        site.pass(REST_S * 1.5);
    }
    claim(&*engine, "w").map(drop)
}

fn lease_under_jumps(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for (id, jump) in ["a", "b"].into_iter().zip(JUMPS_S) {
        engine.publish(&job(id))?;
        let lease = claim(&*engine, "w")?;
        site.jump(jump);
        nothing(&*site.engine(), &format!("while its worker holds it, after a jump of {jump} s"))?;
        engine.heartbeat(&lease)?;
        site.jump(jump);
        site.pass(LEASE_S * 1.5);
        nothing(&*engine, "as the lease ends")?;
        site.pass(REST_S * 1.5);
        let heir = claim(&*engine, "heir")?;
        expect("a silent worker has lost it", heir.attempt > lease.attempt, true)?;
        engine.complete(&heir, "done")?;
    }
    Ok(())
}

fn attempts_end(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for last in [false, false, true] {
        let lease = claim(&*engine, "w")?;
        let fate = engine.fail(&lease, ErrorClass::Retryable, "no luck")?;
        expect("a dead letter", fate == JobFate::Dead, last)?;
        site.pass(60.0 * REST_S);
    }
    expect("its state", state(&*engine, "a")?, JobState::Dead)?;
    nothing(&*engine, "dead")?;
    let jobs = engine.jobs()?;
    expect("its last error", jobs[0].error.as_deref(), Some("no luck"))
}

fn fatal(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    engine.publish(&job("b"))?;
    let lease = claim(&*engine, "w")?;
    expect("its fate", engine.fail(&lease, ErrorClass::Fatal, "bad input")?, JobFate::Dead)?;
    expect("the rest goes on", claim(&*engine, "w")?.job.id.as_str(), "b")?;
    nothing(&*engine, "with the other one dead")
}

fn silent_to_death(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for _ in 0..3 {
        claim(&*engine, "w")?;
        site.pass(LEASE_S * 1.5);
        nothing(&*engine, "as the lease ends")?;
        site.pass(60.0 * REST_S);
    }
    nothing(&*engine, "after it has silenced three workers")?;
    expect("its state", state(&*engine, "a")?, JobState::Dead)
}

fn tried_alone(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("innocent"))?;
    engine.publish(&job("poison"))?;
    for _ in 0..2 {
        let both = [claim(&*engine, "w")?, claim(&*engine, "w")?];
        expect("not alone yet", both.map(|lease| lease.alone), [false, false])?;
        site.pass(LEASE_S * 1.5);
        nothing(&*engine, "as the leases end")?;
        site.pass(60.0 * REST_S);
    }
    let busy = WorkerOffer { free: Needs { cores: 3, ..offer("w").free }, ..offer("w") };
    expect("who has something else to do", engine.claim(&busy)?, None)?;
    let lease = claim(&*site.engine(), "w")?;
    expect("the last attempt", (lease.job.id.as_str(), lease.alone, lease.failures), ("innocent", true, 2))?;
    expect("it was not the one", engine.complete(&lease, "done")?, Completed::Now)?;
    claim(&*engine, "w")?;
    site.pass(LEASE_S * 1.5);
    nothing(&*engine, "as the last lease ends")?;
    expect("the other one", state(&*engine, "poison")?, JobState::Dead)
}

fn stopping(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for _ in 0..5 {
        let lease = claim(&*engine, "w")?;
        let fate = engine.fail(&lease, ErrorClass::Stopped, "stopped")?;
        expect("its fate", fate, JobFate::Released)?;
    }
    let lease = claim(&*engine, "w")?;
    expect("completing it", engine.complete(&lease, "done")?, Completed::Now)
}

fn shortage(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    for _ in 0..5 {
        let lease = claim(&*engine, "w")?;
        expect("the failures before", lease.failures, 0)?;
        match engine.fail(&lease, ErrorClass::Shortage, "too many open files")? {
            JobFate::Retry { .. } => {}
            fate => return Err(ConformanceFailure::NoShortage(fate)),
        }
        nothing(&*engine, "in its rest")?;
        site.pass(REST_S * 1.1);
    }
    let lease = claim(&*engine, "w")?;
    expect("completing it", engine.complete(&lease, "done")?, Completed::Now)
}

fn reviving(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    match engine.revive("a") {
        Err(EngineError::Unknown(_)) => {}
        other => return Err(outcome("reviving who lives", &other)),
    }
    let lease = claim(&*engine, "w")?;
    engine.fail(&lease, ErrorClass::Fatal, "bad input")?;
    engine.revive("a")?;
    let again = claim(&*engine, "w")?;
    expect("a higher fence", again.attempt > lease.attempt, true)?;
    match engine.fail(&again, ErrorClass::Retryable, "no luck")? {
        JobFate::Retry { .. } => Ok(()),
        other => Err(outcome("its attempts are not counted from 0 again", &other)),
    }
}

fn releasing(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for id in ["a", "b"] {
        engine.publish(&job(id))?;
    }
    let (mine, other) = (claim(&*engine, "w")?, claim(&*engine, "v")?);
    engine.note_wait(&mine, Some("its folder is in use"))?;
    expect("what waits", site.engine().waits()?.into_keys().collect::<Vec<_>>(), vec!["a".to_owned()])?;
    expect("how many", engine.release(Some("w"), "started again")?, 1)?;
    expect("what waits after that", engine.waits()?.len(), 0)?;
    lost("what was handed back", engine.complete(&mine, "stale"))?;
    let again = claim(&*engine, "w")?;
    expect("no attempt is counted", (again.job.id.as_str(), again.failures), ("a", 0))?;
    expect("the other one's", engine.complete(&other, "done")?, Completed::Now)
}

fn withdrawing(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    for id in ["a", "b"] {
        engine.publish(&job(id))?;
    }
    let lease = claim(&*engine, "w")?;
    let all = ["a", "b", "unknown"].map(str::to_owned);
    expect("how many", engine.withdraw(&all)?, 1)?;
    expect("completing the other", engine.complete(&lease, "done")?, Completed::Now)?;
    nothing(&*engine, "withdrawn")?;
    expect("later", site.engine().withdraw(&all)?, 1)?;
    expect("jobs", engine.jobs()?.len(), 0)?;
    expect("published again", engine.publish(&job("a"))?, Published::New)
}

fn checkpoints(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let first = claim(&*engine, "w")?;
    engine.checkpoint(&first, "half of it")?;
    engine.fail(&first, ErrorClass::Stopped, "stopped")?;
    lost("a zombie's checkpoint", engine.checkpoint(&first, "stale"))?;
    let heir = claim(&*site.engine(), "heir")?;
    let stored = || -> Result<Option<String>, ConformanceFailure> { Ok(engine.jobs()?.remove(0).checkpoint) };
    expect("what the heir finds", stored()?.as_deref(), Some("half of it"))?;
    engine.complete(&heir, "done")?;
    engine.publish(&Job { payload: "do it differently".into(), ..job("a") })?;
    expect("of another payload", stored()?, None)
}

fn watching(site: &dyn Site) -> Result<(), ConformanceFailure> {
    let engine = site.engine();
    engine.publish(&job("a"))?;
    let lease = claim(&*engine, "w")?;
    engine.complete(&lease, "done")?;
    let changes = site.engine().watch(0, usize::MAX)?;
    let kinds: Vec<_> = changes.iter().map(|c| c.kind).collect();
    expect(
        "what is reported",
        kinds,
        vec![ChangeKind::Published, ChangeKind::Claimed, ChangeKind::Completed],
    )?;
    expect("in order", changes.windows(2).all(|w| w[0].revision < w[1].revision), true)?;
    let rest = engine.watch(changes[0].revision, usize::MAX)?;
    expect("from a revision on", &rest[..], &changes[1..])?;
    expect("at most so many", engine.watch(0, 1)?.len(), 1)?;
    expect("nothing new", engine.watch(changes[2].revision, usize::MAX)?.len(), 0)
}
