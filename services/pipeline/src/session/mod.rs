//! A run's scene, kept in memory for prompts.
//!
//! A [`Session`] holds what clicks need: the scene, its tree, the engine, the providers and the segmenter's actor. A query
//! ([`Session::ask`]) is answered in steps: by the scene tree, by the prompted photos, by more and more photos. A
//! later query may cancel an earlier one. An answer is [saved](Session::save) as a selection of the run.
//!
//! ```no_run
//! # fn main() -> Result<(), segwild_pipeline::RunError> {
//! use segwild_flow::Stopper;
//! use segwild_pipeline::{Replay, RunFolder, Session, SessionOptions};
//! let replay = Replay::read("prompts.json".as_ref())?;
//! let folder = RunFolder::open("runs/trevi".as_ref())?;
//! let session = Session::open(&folder, SessionOptions::default())?;
//! let pending = session.ask(&replay, &folder.settings()?.segment, &Stopper::new())?;
//! let answer = pending.wait(|step, selected| println!("{step:?}: {} splats", selected.labels.len()))?;
//! println!("{}", session.save("statue", &answer)?.folder.display());
//! # Ok(())
//! # }
//! ```

mod answer;
mod kept_masks;
mod objects;
mod packed;
mod photo_masks;
mod resident;
mod save;
mod segment;
mod viewing;

pub use answer::{Answer, PendingAnswer};
pub use objects::{export_objects, list_objects};
pub use packed::PackedSplats;
pub use photo_masks::MaskedObject;
pub use resident::{Session, SessionOptions};
pub use save::SegmentOutcome;
pub use segment::segment;
pub use viewing::{ShownParts, ShownScene};
