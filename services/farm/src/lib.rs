//! Many scenes: jobs that are leased, fenced, retried and, when nothing helps, kept as dead letters.
//!
//! - [`JobEngine`]: where jobs wait and who works on which; [`EmbeddedEngine`] keeps them in SQLite, and
//!   [`conformance`] is what any engine has to pass.
//! - [`BatchManifest`]: the scenes of a batch, their settings, priorities and needs, and the machine's budget.
//! - [`ArtefactStore`], [`ArtefactSession`]: inputs, checkpoints and results between machines, by their bytes.
//! - [`NatsEngine`]: the engine of a farm, a log on JetStream; [`FarmBatch`] hands scenes in, [`work`] is a worker.
//! - [`batch`]: runs a manifest's scenes side by side, each as a process of its own.
//!
//! It runs no stage by itself: each scene is a `segwild run` of its own, which resumes.
//!
//! ```
//! use segwild_farm::{EmbeddedEngine, Job, JobEngine, JobState, Needs, Published, WorkerOffer};
//!
//! let folder = tempfile::tempdir()?;
//! let engine = EmbeddedEngine::open(folder.path().join("jobs.sqlite"))?;
//! let needs = Needs { cores: 2, memory_bytes: 1 << 30, accelerators: 0 };
//! let job = Job::new("liberty", "photos/liberty", needs);
//! assert_eq!(engine.publish(&job)?, Published::New);
//!
//! // A worker with too little memory gets nothing; the next one gets a lease, and nobody else the same job.
//! let offer = WorkerOffer::all("here", needs, 60.0);
//! let small = WorkerOffer { free: Needs { memory_bytes: 1 << 20, ..needs }, ..offer.clone() };
//! assert!(engine.claim(&small)?.is_none());
//! let lease = engine.claim(&offer)?.expect("it is free");
//! assert!(engine.claim(&offer)?.is_none());
//! engine.complete(&lease, "runs/liberty")?;
//! assert_eq!(engine.jobs()?[0].state, JobState::Done);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Start reading at `engine.rs`, then `batch/mod.rs`.

mod artefacts;
pub mod batch;
mod clock;
pub mod conformance;
mod crew;
mod embedded;
mod engine;
mod job;
mod jumps;
mod log;
mod machine;
mod manifest;
mod nats;
mod pending;
mod submit;
mod sweep;
mod table;
mod transition;
mod turn;
mod worker;

pub use artefacts::{
    ArtefactCount, ArtefactDigest, ArtefactError, ArtefactSession, ArtefactStore, DigestError,
    FetchedFolderError, FolderEntry, FolderLimits, FolderManifest, FolderManifestError, JetStreamArtefacts,
    LEAST_AGE, ObjectArtefacts, StoreAddressError, StoredArtefact, SweptArtefacts, UnfitFolderError,
};
pub use batch::{BatchError, BatchFolder, BatchOptions, BatchRecord, BatchSummary};
pub use clock::{JobClock, SimulatedClock, SystemClock};
pub use crew::{ANNOUNCE_EVERY, BatchEvent, LEASE_S, StopBatch, StopLevel};
pub use embedded::EmbeddedEngine;
pub use engine::{
    ChangeKind, Completed, EngineError, ErrorClass, FarmLogState, JobChange, JobEngine, JobFate, JobLease,
    JobState, JobStatus, Published, WorkerOffer, WorkerTally,
};
pub use job::{Job, Needs, Retry};
pub use log::TransitionLog;
pub use manifest::{
    BatchManifest, FolderTaken, ManifestError, ManifestFileError, MemorySizeError, SceneEntryError, SceneJob,
};
pub use nats::{FarmAccess, FarmAddress, FarmAddressError, FarmKey, NatsEngine, USUAL_PATIENCE, transitions};
pub use submit::{FarmBatch, FarmBatchError};
pub use sweep::{FarmSweep, FarmSweepError};
pub use table::{Decision, JobTable};
pub use transition::Transition;
pub use turn::{JobTurn, turns};
pub use worker::{FarmScene, FarmSceneError, WorkerError, WorkerTerms, usual_budget, work};
