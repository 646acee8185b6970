//! The embedded engine goes through the conformance suite, and the suite finds engines that are broken.

use segwild_farm::conformance::{Site, broken};
use segwild_farm::{
    ChangeKind, Completed, EmbeddedEngine, EngineError, ErrorClass, Job, JobChange, JobClock, JobEngine,
    JobFate, JobLease, JobStatus, Needs, Published, SimulatedClock, WorkerOffer,
};
use segwild_flow::clock::Steady;
use std::collections::BTreeMap;
use std::sync::Arc;

/// What is wrong with the engine of a site.
#[derive(Clone, Copy, PartialEq)]
enum EngineFault {
    None,
    /// Completes for whoever asks.
    NoFence,
    /// A stop counts as a failure.
    StopCosts,
    /// A shortage counts as a failure.
    ShortageCosts,
    /// Heartbeats are ignored.
    DeafToHeartbeats,
    /// Gives jobs to workers that have no capacity.
    IgnoresNeeds,
    /// Gives small jobs the capacity that a more urgent one waits for.
    SmallOnesFirst,
    /// Measures rests and leases by the wall clock.
    WallClockAlone,
}

/// A clock that takes a jump for time that passed.
struct WallAlone(SimulatedClock);

impl JobClock for WallAlone {
    fn now(&self) -> f64 {
        self.0.now()
    }
    fn steady(&self) -> Steady {
        Steady { since: "the wall".into(), seconds: self.0.now() }
    }
}

struct Here {
    folder: tempfile::TempDir,
    clock: SimulatedClock,
    fault: EngineFault,
}

impl Here {
    fn site(fault: EngineFault) -> Box<dyn Site> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        Box::new(Here { folder, clock: SimulatedClock::new(1.7e9), fault })
    }

    fn embedded(&self) -> EmbeddedEngine {
        let path = self.folder.path().join("jobs.sqlite");
        let clock: Arc<dyn JobClock> = match self.fault {
            EngineFault::WallClockAlone => Arc::new(WallAlone(self.clock.clone())),
            _ => Arc::new(self.clock.clone()),
        };
        EmbeddedEngine::with_clock(path, clock).expect("an engine")
    }
}

impl Site for Here {
    fn engine(&self) -> Box<dyn JobEngine> {
        match self.fault {
            EngineFault::None | EngineFault::WallClockAlone => Box::new(self.embedded()),
            fault => Box::new(Faulty(self.embedded(), fault)),
        }
    }

    fn pass(&self, seconds: f64) {
        self.clock.pass(seconds);
    }

    fn jump(&self, seconds: f64) {
        self.clock.jump(seconds);
    }
}

struct Faulty(EmbeddedEngine, EngineFault);

impl JobEngine for Faulty {
    fn publish(&self, job: &Job) -> Result<Published, EngineError> {
        self.0.publish(job)
    }
    fn claim(&self, offer: &WorkerOffer) -> Result<Option<JobLease>, EngineError> {
        let everything = Needs { cores: u32::MAX, memory_bytes: i64::MAX as u64, accelerators: u32::MAX };
        let free = if self.1 == EngineFault::IgnoresNeeds { everything } else { offer.free };
        let whole = if self.1 == EngineFault::SmallOnesFirst { Needs::default() } else { offer.whole };
        self.0.claim(&WorkerOffer { free, whole, ..offer.clone() })
    }
    fn announce(&self, offer: &WorkerOffer) -> Result<(), EngineError> {
        self.0.announce(offer)
    }
    fn heartbeat(&self, lease: &JobLease) -> Result<f64, EngineError> {
        if self.1 == EngineFault::DeafToHeartbeats { Ok(lease.until) } else { self.0.heartbeat(lease) }
    }
    fn complete(&self, lease: &JobLease, outcome: &str) -> Result<Completed, EngineError> {
        if self.1 != EngineFault::NoFence {
            return self.0.complete(lease, outcome);
        }
        let current = self.0.jobs()?.into_iter().find(|j| j.job.id == lease.job.id).map_or(0, |j| j.attempt);
        self.0.complete(&JobLease { attempt: current, ..lease.clone() }, outcome)
    }
    fn fail(&self, lease: &JobLease, class: ErrorClass, error: &str) -> Result<JobFate, EngineError> {
        let costs = self.1 == EngineFault::StopCosts && class == ErrorClass::Stopped
            || self.1 == EngineFault::ShortageCosts && class == ErrorClass::Shortage;
        self.0.fail(lease, if costs { ErrorClass::Retryable } else { class }, error)
    }
    fn revive(&self, id: &str) -> Result<(), EngineError> {
        self.0.revive(id)
    }
    fn watch(&self, after: u64, limit: usize) -> Result<Vec<JobChange>, EngineError> {
        self.0.watch(after, limit)
    }
    fn jobs(&self) -> Result<Vec<JobStatus>, EngineError> {
        self.0.jobs()
    }
    fn release(&self, worker: Option<&str>, reason: &str) -> Result<usize, EngineError> {
        self.0.release(worker, reason)
    }
    fn withdraw(&self, ids: &[String]) -> Result<usize, EngineError> {
        self.0.withdraw(ids)
    }
    fn note_wait(&self, lease: &JobLease, reason: Option<&str>) -> Result<(), EngineError> {
        self.0.note_wait(lease, reason)
    }
    fn checkpoint(&self, lease: &JobLease, artefact: &str) -> Result<(), EngineError> {
        self.0.checkpoint(lease, artefact)
    }
    fn waits(&self) -> Result<BTreeMap<String, String>, EngineError> {
        self.0.waits()
    }
    fn count(&self, kind: ChangeKind) -> Result<u64, EngineError> {
        self.0.count(kind)
    }
    fn jumps(&self) -> Result<Vec<f64>, EngineError> {
        self.0.jumps()
    }
}

#[test]
fn the_embedded_engine_conforms() {
    assert_eq!(broken(&|| Here::site(EngineFault::None)), []);
}

#[test]
fn the_suite_finds_what_is_broken() {
    for (fault, word) in [
        (EngineFault::NoFence, "zombie"),
        (EngineFault::StopCosts, "stopped costs no attempt"),
        (EngineFault::ShortageCosts, "a shortage of the machine"),
        (EngineFault::DeafToHeartbeats, "heartbeat holds"),
        (EngineFault::IgnoresNeeds, "does not fit"),
        (EngineFault::SmallOnesFirst, "not given to a less urgent one"),
        (EngineFault::WallClockAlone, "a rest lasts as long"),
        (EngineFault::WallClockAlone, "a lease lasts as long"),
    ] {
        let found = broken(&|| Here::site(fault));
        assert!(found.iter().any(|(name, _)| name.contains(word)), "`{word}` was not found: {found:?}");
    }
}

fn job(id: &str) -> Job {
    let needs = Needs { cores: 1, ..Needs::default() };
    Job::new(id, "", needs)
}

#[test]
fn a_pause_of_a_worker_is_noted_until_it_ends_or_the_worker_takes_a_job() {
    let folder = tempfile::tempdir().expect("a folder");
    let engine = EmbeddedEngine::open(folder.path().join("jobs.sqlite")).expect("an engine");
    let tallies = || engine.tallies().expect("it reads");
    let paused = || tallies().get("w").and_then(|tally| tally.paused.clone());
    let note = |reason: Option<&str>| engine.note_pause("w", reason).expect("it writes");
    note(None);
    assert!(tallies().is_empty(), "there was nothing to note");
    note(Some("its disk is full"));
    assert_eq!(paused().as_deref(), Some("its disk is full"));
    note(None);
    assert_eq!(paused(), None);
    note(Some("its disk is full"));
    engine.publish(&job("a")).expect("it writes");
    let whole = Needs { cores: 1, ..Needs::default() };
    let lease = engine.claim(&WorkerOffer::all("w", whole, 60.0)).expect("it writes");
    assert!(lease.is_some() && paused().is_none(), "who takes a job is not paused");
}

#[test]
fn what_was_published_survives_its_process() {
    let site = Here {
        folder: tempfile::tempdir().unwrap(),
        clock: SimulatedClock::new(0.0),
        fault: EngineFault::None,
    };
    site.embedded().publish(&job("a")).unwrap();
    let free = Needs { cores: 1, ..Needs::default() };
    let offer = WorkerOffer::all("w", free, 1e9);
    let lease = site.embedded().claim(&offer).unwrap().expect("a lease");
    // The worker's process is gone, and whoever holds the batch's lock knows it.
    let engine = site.embedded();
    assert_eq!(engine.release(None, "the batch was killed").unwrap(), 1);
    let again = engine.claim(&offer).unwrap().expect("it can be claimed at once");
    assert_eq!((again.attempt, engine.jobs().unwrap()[0].failures), (2, 0));
    assert!(matches!(engine.complete(&lease, "late"), Err(EngineError::Lost { .. })));
}

#[test]
fn a_rest_that_ends_later_than_it_lasts_is_over_when_the_machine_was_restarted() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("jobs.sqlite");
    let at = |since: &'static str, wall: f64| -> Arc<dyn JobClock> { Arc::new(Standing { since, wall }) };
    let free = Needs { cores: 1, ..Needs::default() };
    let offer = WorkerOffer::all("w", free, 60.0);
    let before = EmbeddedEngine::with_clock(&path, at("the first start", 1e9)).unwrap();
    before.publish(&job("a")).unwrap();
    let lease = before.claim(&offer).unwrap().expect("a lease");
    before.fail(&lease, ErrorClass::Retryable, "no luck").unwrap();
    assert!(before.claim(&offer).unwrap().is_none(), "it rests");
    // The machine's clock comes up an hour early.
    let after = EmbeddedEngine::with_clock(&path, at("the second start", 1e9 - 3600.0)).unwrap();
    assert!(after.claim(&offer).unwrap().is_some(), "the rest is over");
    assert_eq!(
        (after.jumps().unwrap(), after.jumps().unwrap()),
        (vec![-3600.0], vec![]),
        "it is reported, and once"
    );
}

/// A clock of one start of the machine, at a standstill.
struct Standing {
    since: &'static str,
    wall: f64,
}

impl JobClock for Standing {
    fn now(&self) -> f64 {
        self.wall
    }
    fn steady(&self) -> Steady {
        Steady { since: self.since.into(), seconds: 5.0 }
    }
}

#[test]
fn another_format_is_refused_in_words() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("jobs.sqlite");
    drop(EmbeddedEngine::open(&path).unwrap());
    rusqlite::Connection::open(&path).unwrap().pragma_update(None, "user_version", 9).unwrap();
    let message = EmbeddedEngine::open(&path).map(drop).unwrap_err().to_string();
    assert!(message.contains("format 9") && message.contains("format 1"), "{message}");
    assert!(matches!(
        EmbeddedEngine::open_read_only(folder.path().join("none")),
        Err(EngineError::Missing { .. })
    ));
    std::fs::write(&path, "this is no database at all, however long one makes it").unwrap();
    assert!(matches!(EmbeddedEngine::open(&path), Err(EngineError::Store { .. })));
}

#[test]
fn a_view_in_somebody_elses_jobs_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("jobs.sqlite");
    drop(EmbeddedEngine::open(&path).unwrap());
    let endless = "DROP TABLE changes; CREATE VIEW changes AS
        WITH RECURSIVE n (kind) AS (SELECT 1 UNION ALL SELECT kind + 1 FROM n) SELECT kind FROM n;";
    rusqlite::Connection::open(&path).unwrap().execute_batch(endless).unwrap();
    for opened in [EmbeddedEngine::open(&path), EmbeddedEngine::open_read_only(&path)] {
        let message = opened.map(drop).unwrap_err().to_string();
        assert!(message.contains("view `changes`") && message.contains("move it away"), "{message}");
    }
}

#[test]
fn another_programs_database_is_refused_before_it_is_changed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("jobs.sqlite");
    let theirs = "CREATE TABLE t (x); PRAGMA application_id = 7; PRAGMA user_version = 1;";
    rusqlite::Connection::open(&path).unwrap().execute_batch(theirs).unwrap();
    let before = std::fs::read(&path).unwrap();
    assert!(matches!(EmbeddedEngine::open(&path), Err(EngineError::Store { .. })));
    assert!(std::fs::read(&path).unwrap() == before);
}
