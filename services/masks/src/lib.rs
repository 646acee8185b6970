//! Actor: scale-adaptive prompts (SASM) to masks, cached per view (method, section 5; paper Eq. 15-23).
//!
//! [`sasm`] places the prompts, [`generate()`] turns the prompts into a photo's masks.
//!
//! It has no 2D model of its own: [`segwild_vision`] has. It decides where that is prompted, and which answers stay.
//!
//! ```
//! use segwild_masks::sasm::{focal_35mm, segs};
//! use segwild_scene::Camera;
//!
//! let wide = Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };
//! let tele = Camera { fx: 2000.0, fy: 2000.0, ..wide };
//! assert!(focal_35mm(&tele) > 3.9 * focal_35mm(&wide));
//! // A far camera sees its object small: its photo is divided into more cells.
//! assert!(segs(0.9) > segs(0.1));
//! ```
//!
//! Start reading at `sasm.rs`, then `generate.rs`.

mod actor;
mod generate;
pub mod sasm;
mod settings;

pub use actor::{MaskActor, MaskFailure, MaskMaker, MaskOutcome, MaskTask, Snapshot};
pub use generate::{Generated, MaskError, MaskTally, generate};
pub use settings::{MaskSettings, MaskSource};
