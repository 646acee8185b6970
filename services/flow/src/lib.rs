//! The dataflow: typed bounded mailboxes, supervised actors, content cache, run ledger. Knows nothing of splats.
//!
//! - [`mailbox`](fn@mailbox): typed, bounded by count and by bytes, with an urgent lane; from async tasks and
//!   compute threads alike.
//! - [`Actor`] and [`System`]: actors on threads of their own, supervised: retried, restarted, quarantined,
//!   watched, stopped in order; their times are the timings of the run.
//! - [`Lease`]: the one accelerator, in turn, a click first.
//! - [`Events`]: what happens, sent to progress bars, `--json` and the ledger without ever holding up a worker.
//! - [`Cache`]: artefacts by the hash of what they were made from ([`Key`]); verified on every read.
//! - [`Ledger`]: what a run has done, in SQLite, readable by others while it is written.
//! - [`Recorder`]: what actors and mailboxes are doing, written into the ledger about once a second.
//! - [`ProgramRunner`]: other programs as children, with a log, ended with this process.
//! - [`SystemRefusal`]: what the disk or the system is at fault for, found in an error and its sources.
//! - [`shortage`]: what the system says when it has no file descriptors or processes left.
//! - [`codec`]: binary records with a header.
//! - [`database`]: SQLite files of somebody else; one with more than tables and indexes is refused.
//! - [`files`], [`fault`] and [`lock`]: the one writer of files, faults on purpose, and mutexes that serve on after a panic, from
//!   the floor below.
//!
//! ```
//! use segwild_flow::{Cache, Key};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = std::env::temp_dir().join(format!("segwild-flow-{}", std::process::id()));
//! let cache = Cache::open(&folder)?;
//! // The key of an artefact is the hash of all that it is made from.
//! let key = Key::of("masks").part("photo", b"its bytes").value("prompts", 32).finish();
//! assert_eq!(cache.get(&key)?, None);
//! cache.put(&key, b"the masks")?;
//! assert_eq!(cache.get(&key)?.as_deref(), Some(&b"the masks"[..]));
//! # std::fs::remove_dir_all(folder)?;
//! # Ok(())
//! # }
//! ```
//!
//! Start reading at `mailbox.rs`, then `actor.rs` and `system.rs`.

pub mod actor;
pub mod cache;
pub mod clock;
pub mod codec;
mod compute;
pub mod control;
pub mod cpu;
pub mod database;
pub mod events;
pub mod key;
pub mod lease;
pub mod ledger;
pub mod mailbox;
pub mod message;
mod meter;
mod park;
pub mod process;
mod program;
pub mod progress;
pub mod recorder;
pub mod refusal;
pub mod report;
pub mod shortage;
pub mod supervise;
pub mod system;
pub mod timeline;
pub mod trace;

pub use actor::{Actor, ActorFailure, Context, Idle, Quarantined};
pub use cache::{Artefact, Cache, CacheCounters, CacheError, MakeError, Origin, Swept};
pub use codec::CodecError;
pub use compute::all_cores;
pub use control::{Phase, Stopper};
pub use events::{Event, EventLevel, EventRecord, Events, Sink, Subscription};
pub use key::{Key, KeyBuilder};
pub use lease::{Lease, LeaseGuard, LeaseStats, LeaseTurn};
pub use ledger::{Ledger, LedgerError};
pub use mailbox::{Closed, Limits, MailboxStats, Receiver, RecvError, Sender, TrySendError, mailbox};
pub use message::Message;
pub use meter::{WaitingFor, WorkerState, sign_of_life, waiting_for};
pub use program::{ProgramError, ProgramRunner, find_program, program_output};
pub use progress::StageProgress;
pub use recorder::Recorder;
pub use refusal::SystemRefusal;
pub use report::{ActorReport, Exit, Report, StorageFailure, WorkerStatus};
pub use segwild_files::{self as files, FileError, fault, lock};
pub use supervise::{ActorOptions, RestartBudget};
pub use system::{Guest, Observer, SpawnError, System, SystemOptions};
pub use timeline::{SpanKind, Timeline, TimelineRecord, TimelineSpan};
