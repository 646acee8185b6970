//! How fast the accelerator engine is: every pass against its floor on the device, and against the CPU engine.

mod goal;
mod measure;
mod page;
mod record;
mod speed;
mod timing;

pub use goal::Goal;
pub use measure::{EngineOptions, engine};
pub use page::{markdown, write};
pub use record::PROTOCOL;
pub use speed::STEP;
