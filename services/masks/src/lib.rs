//! Actor: scale-adaptive prompts (SASM) to masks, cached per view (method, section 5; paper Eq. 15-23).
//!
//! [`sasm`] says where to prompt, [`generate()`] turns the prompts into a photo's masks.

mod actor;
mod generate;
pub mod sasm;
mod settings;

pub use actor::{MaskActor, MaskMaker, MaskOutcome, MaskTask, Refused, Snapshot};
pub use generate::{Generated, MaskError, Tally, generate};
pub use settings::{MaskSettings, MaskSource};
