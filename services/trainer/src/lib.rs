//! Actor: geometry, appearance, density control, checkpoints.
//!
//! A [`Trainer`] turns a scene and its photos into a [`Model`], one photo per step: splats start at the
//! reconstruction's points, Adam moves them, a density strategy adds and removes them, each photo has its
//! appearance and its background, and pixels that keep contradicting the scene are left out (method, sections 2, 3, 9).
//!
//! It makes no masks and no features, and selects nothing. What it minimises is in [`segwild_objective`].
//!
//! ```
//! use glam::{Vec2, Vec3};
//! use segwild_raster::CpuEngine;
//! use segwild_scene::{Camera, Image, Photo, Point, Pose, Scene, View};
//! use segwild_trainer::{AppearanceModel, TrainPhoto, TrainSettings, Trainer};
//! use std::convert::Infallible;
//! use std::sync::Arc;
//!
//! // Three cameras before a wall at z = 1 that is dark on the left and bright on the right, and points on it.
//! let camera = Camera { width: 48, height: 36, fx: 40.0, fy: 40.0, cx: 24.0, cy: 18.0 };
//! let wall = |x: f32| if x < 0.0 { 0.2 } else { 0.8 };
//! let views: Vec<View> = (0..3)
//!     .map(|i| {
//!         let eye = Vec3::new(0.2 * i as f32 - 0.2, 0.0, -0.5);
//!         let pose = Pose::look_at(eye, eye + Vec3::Z, Vec3::NEG_Y);
//!         View { name: format!("{i}.jpg"), camera, pose, photo: Photo::new(""), test: false }
//!     })
//!     .collect();
//! let points = (0..300).map(|i| {
//!     let position = Vec3::new(0.1 * (i % 20) as f32 - 0.95, 0.1 * (i / 20) as f32 - 0.7, 1.0);
//!     Point { position, colour: [wall(position.x); 3], track: vec![] }
//! });
//! let scene = Scene::new(views, points.collect());
//! let poses: Vec<Pose> = scene.views.iter().map(|view| view.pose).collect();
//! let photos = Arc::new(move |view: usize| {
//!     let x = |i: usize| poses[view].centre().x + 1.5 * camera.ray(Vec2::new((i % 48) as f32 + 0.5, 0.0)).x;
//!     let data = (0..3 * 48 * 36).map(|i| wall(x(i))).collect();
//!     let image = Image { width: 48, height: 36, channels: 3, data };
//!     Ok::<_, Infallible>(TrainPhoto { image, valid: None, sky: None, transients: None })
//! });
//!
//! let (appearance_model, robust) = (AppearanceModel::None, false);
//! let settings = TrainSettings { steps: 60, splats: 600, appearance_model, robust, ..TrainSettings::default() };
//! let mut trainer = Trainer::new(Arc::new(CpuEngine::new()), &scene, photos, settings)?;
//! for _ in 0..20 {
//!     trainer.step()?;
//! }
//! let [loss_before, ..] = trainer.means();
//! while !trainer.is_done() {
//!     trainer.step()?;
//! }
//! let [loss, ..] = trainer.means();
//! assert!(loss < loss_before, "{loss_before}, then {loss}");
//! let model = trainer.finish()?;
//! assert!(!model.splats.is_empty());
//! # Ok::<(), segwild_trainer::TrainError>(())
//! ```
//!
//! Start reading at `trainer.rs`, then `step.rs`.

mod actor;
mod alignment;
mod appearances;
mod block_training;
mod blocks;
mod camera_motion;
mod checkpoint;
mod choice;
mod colours;
mod density;
mod error;
mod evaluate;
mod foreign_light;
mod imported;
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
mod pose_refinement;
mod posed;
mod poses_by_points;
mod preparation;
mod preparation_progress;
mod refined_pose;
mod resection;
mod sampler;
mod schedule;
mod seams;
mod settings;
mod splat_budget;
mod state;
mod step;
mod stereo_points;
mod trainer;
mod transients;

pub use actor::{FindCheckpoint, TrainActor, TrainOrder, TrainOutcome};
pub use blocks::trained_share;
pub use checkpoint::Checkpoint;
pub use choice::{
    APPEARANCE_MODELS, AppearanceChoice, BudgetChoice, SIZE as CHOICE_SIZE, ShortFit, StepSpeed, TimeBounds,
    TimeChoice, TimeModel, TooLittleTime, Tracks, choose_appearance, choose_budget, measure_steps,
    trial_size,
};
pub use density::DensityChange;
pub use error::TrainError;
pub use evaluate::{Evaluation, Protocol, ViewScore, evaluate};
pub use foreign_light::ForeignLight;
pub use light::{SceneLight, SceneLighting, render_lit};
pub use model::{Model, Stats, render_view};
pub use photos::{Photos, Sifted, TrainPhoto};
pub use preparation_progress::{PreparationPart, PreparationProgress};
pub use refined_pose::{RefinedBy, RefinedPose};
pub use seams::{SeamCheck, SeamPhoto, SeamResidual};
pub use segwild_nn::{Lpips, LpipsError, LpipsNet};
pub use segwild_objective::GswWidth;
pub use segwild_objective::background::Background;
pub use settings::{AppearanceModel, DensityKind, Preset, TrainSettings};
pub use splat_budget::splat_cap;
pub use stereo_points::stereo_bytes;
pub use trainer::{StepReport, Trainer};
pub use transients::{TransientEvidence, transient_evidence};
