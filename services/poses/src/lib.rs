//! Camera poses of photos that come without: structure from motion by COLMAP, as a child process.
//!
//! A [`PoseSource`] is a folder of photos or a video. [`PosesFolder::plan`] says whether its poses are there;
//! [`PosesFolder::estimate`] computes them: frames of a video (ffmpeg), features, pairs, model. All of it lies in one folder:
//!
//! ```text
//! poses.json    what the rest was made from, and of each photo without a pose the reason
//! colmap.db     features and pairs; a run that was stopped goes on with those that are missing
//! models/0/     the models that COLMAP made of them; poses.json says which is used
//! frames/       the frames of a video
//! colmap.log    what the programs wrote
//! ```
//!
//! COLMAP is searched on the `PATH` and nowhere else. Start reading at `estimate.rs`.

mod colmap;
mod database;
mod error;
mod estimate;
mod features;
mod folder;
mod models;
mod pairs;
mod record;
mod settings;
mod source;
mod step;
mod video;

pub use colmap::Colmap;
pub use error::PosesError;
pub use folder::{PosePlan, PosesFolder};
pub use settings::{CameraSharing, PairChoice, PoseSettings};
pub use source::PoseSource;
pub use step::{PoseLimits, PoseSpan, PoseStep};
pub use video::Ffmpeg;
