//! Many scenes: jobs that are leased, fenced, retried and, when nothing helps, kept as dead letters.
//!
//! - [`JobEngine`]: where jobs wait and who works on which; [`EmbeddedEngine`] keeps them in SQLite, and
//!   [`conformance`] is what any engine has to pass.
//! - [`BatchManifest`]: the scenes of a batch, their settings, priorities and needs, and the machine's budget.
//! - [`batch`]: runs a manifest's scenes side by side, each as a process of its own.
//!
//! It runs no stage by itself: each scene is a `segwild run` of its own, which resumes.
//!
//! Start reading at `engine.rs`, then `batch/mod.rs`.

pub mod batch;
mod clock;
pub mod conformance;
mod embedded;
mod engine;
mod job;
mod jumps;
mod machine;
mod manifest;
mod turn;
mod waits;

pub use batch::{
    BatchError, BatchEvent, BatchFolder, BatchOptions, BatchRecord, BatchSummary, StopBatch, StopLevel,
};
pub use clock::{JobClock, SimulatedClock, SystemClock};
pub use embedded::EmbeddedEngine;
pub use engine::{
    ChangeKind, Completed, EngineError, ErrorClass, JobChange, JobEngine, JobFate, JobLease, JobState,
    JobStatus, Published, WorkerOffer,
};
pub use job::{Job, Needs, Retry};
pub use manifest::{
    BatchManifest, FolderTaken, ManifestError, ManifestFileError, MemorySizeError, SceneEntryError, SceneJob,
};
pub use turn::{JobTurn, turns};
