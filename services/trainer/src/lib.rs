//! Actor: geometry, appearance, density control, checkpoints.
//!
//! A [`Trainer`] turns a scene and its photos into a [`Model`], one photo per step: splats start at the
//! reconstruction's points, Adam moves them, a density strategy adds and removes them, each photo has its
//! appearance and its background, and pixels that keep contradicting the scene are left out (method, sections 2, 3, 9).
//!
//! It makes no masks and no features, and selects nothing. What it minimises is in [`segwild_objective`].
//!
//! Start reading at `trainer.rs`, then `step.rs`.

mod actor;
mod appearances;
mod checkpoint;
mod choice;
mod colours;
mod density;
mod error;
mod evaluate;
mod initial;
mod initial_transients;
mod light;
mod model;
mod multi_view_pruning;
mod on_device;
mod painter;
mod params;
mod photometric;
mod photos;
mod pixels;
mod posed;
mod preparation;
mod sampler;
mod schedule;
mod settings;
mod splat_budget;
mod state;
mod step;
mod stereo_points;
mod trainer;
mod transients;

pub use actor::{FindCheckpoint, TrainActor, TrainOrder, TrainOutcome};
pub use checkpoint::Checkpoint;
pub use choice::{
    APPEARANCE_MODELS, AppearanceChoice, BudgetChoice, SIZE as CHOICE_SIZE, ShortFit, Tracks,
    choose_appearance, choose_budget, trial_size,
};
pub use density::DensityChange;
pub use error::TrainError;
pub use evaluate::{Evaluation, Protocol, ViewScore, evaluate};
pub use light::{SceneLight, SceneLighting, render_lit};
pub use model::{Model, Stats, render_view};
pub use photos::{Photos, Sifted, TrainPhoto};
pub use segwild_objective::GswWidth;
pub use segwild_objective::background::Background;
pub use settings::{AppearanceModel, DensityKind, Preset, TrainSettings};
pub use splat_budget::splat_cap;
pub use stereo_points::stereo_bytes;
pub use trainer::{StepReport, Trainer};
pub use transients::{TransientEvidence, transient_evidence};
