//! Actor: scale-adaptive prompts (SASM) to masks, cached per view (method, section 5; paper Eq. 15-23).
//!
//! [`sasm`] places the prompts, [`generate()`] turns the prompts into a photo's masks.

mod actor;
mod generate;
pub mod sasm;
mod settings;

pub use actor::{MaskActor, MaskFailure, MaskMaker, MaskOutcome, MaskTask, Snapshot};
pub use generate::{Generated, MaskError, MaskTally, generate};
pub use settings::{MaskSettings, MaskSource};
