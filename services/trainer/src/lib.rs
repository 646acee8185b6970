//! Actor: geometry, look, density control, checkpoints.
//!
//! A [`Trainer`] turns a scene and its photos into a [`Model`], one photo per step: splats start at the
//! reconstruction's points, Adam moves them, a density strategy adds and removes them, each photo has its
//! look and its background, and what keeps contradicting the scene is left out (method, sections 2, 3, 9).

mod actor;
mod away;
mod background;
mod between;
mod choice;
mod colours;
mod density;
mod error;
mod evaluate;
mod initial;
mod judge;
mod light;
mod looks;

mod model;
mod params;
mod photos;
mod pixels;
mod posed;
mod robust;
mod room;
mod sampler;
mod schedule;
mod settings;
mod state;
mod step;
mod strangers;
mod suspects;
mod trainer;
mod witness;

pub use actor::{FindCheckpoint, TrainActor, TrainOrder, TrainOutcome};
pub use background::Background;
pub use between::stereo_bytes;
pub use choice::{
    BudgetChoice, LookChoice, RUNGS, SIZE as CHOICE_SIZE, ShortFit, Tracks, choose_budget, choose_look,
    trial_size,
};
pub use density::Change;
pub use error::TrainError;
pub use evaluate::{Evaluation, Protocol, ViewScore, evaluate};
pub use light::{Light, Lighting, render_lit};
pub use model::{Model, Stats, render_view};
pub use photos::{Photos, Sifted, TrainPhoto};
pub use room::splat_cap;
pub use segwild_raster::GswWidth;
pub use settings::{DensityKind, LookKind, Preset, TrainSettings};
pub use strangers::{Strangeness, strangeness};
pub use trainer::{Checkpoint, StepReport, Trainer};
