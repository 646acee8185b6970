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

mod choice;
mod failures;
mod leases;
mod listing;
mod site;

pub use site::{ConformanceFailure, Site};

use choice::{fitting, kept_by_one, named_accelerator, one_worker_per_job, reserving_capacity, urgency};
use failures::{
    attempts_end, back_off, fatal, rest_under_jumps, reviving, shortage, silent_to_death, stopping,
    tried_alone,
};
use leases::{
    completing_twice, heartbeat_holds, late_completion, lease_under_jumps, releasing, silence, zombie,
};
use listing::{another_payload, checkpoints, publishing_twice, watching, withdrawing};

/// A check: its name, and what it does with a fresh site.
pub type ConformanceCheck = (&'static str, fn(&dyn Site) -> Result<(), ConformanceFailure>);

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
