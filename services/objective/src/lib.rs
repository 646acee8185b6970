//! What a training minimises (method, sections 2 to 4): the losses of a rendered view against its photo, and what they
//! are minimised by.
//!
//! - [`compare`]: the losses of an image against its photo, with gradients; [`photometric`] is their colour term.
//! - [`transients`]: which pixels of a photo are left out of them, and [`background`]: what stands behind the splats.
//! - [`Appearance`] and its models: how each photo changes the scene's colours.
//! - [`field`]: the feature field, its losses, and the similarity of splats to a click.
//! - [`Adam`]: the optimiser.
//! - [`Engine`]: a rasteriser that may also train on its device ([`TrainingBackend`], [`FieldBackend`]).
//!
//! Nothing here knows photos on disk, schedules or density control: those are the trainer's. The splats are rendered by
//! `segwild-raster`.
//!
//! ```
//! use segwild_objective::{photometric, psnr};
//! use segwild_scene::Image;
//!
//! let photo = Image { width: 16, height: 16, channels: 3, data: vec![0.5; 3 * 256] };
//! let render = Image { data: vec![0.6; 3 * 256], ..photo.clone() };
//! let (loss, gradient) = photometric(&render, &photo, None, 0.2);
//! assert!(loss > 0.0 && gradient.data.iter().sum::<f32>() > 0.0, "darker is better");
//! assert!((psnr(&render, &photo, None) - 20.0).abs() < 0.01);
//! ```
//!
//! Start reading at `compare.rs`: one photo's part of a training step.

mod adam;
mod appearance;
pub mod background;
pub mod compare;
mod engine;
mod fallback;
pub mod field;
mod losses;
mod photo_target;
mod training;
pub mod transients;

pub use adam::{Adam, Rule};
pub use appearance::{
    AffineAppearance, AnyAppearance, Appearance, AppearanceEmbedding, AppearanceMaps, Directions,
    EmbedAppearance, EmbedLight, GswAppearance, GswWidth, HIDDEN_LAYER, ImageConditioning, NoAppearance,
    RANK, TrainingNetworks, UNetInput, VisibleSplats, bake, gsw,
};
pub use engine::{Engine, FieldBackend, TrainingBackend};
pub use fallback::FallbackEngine;
pub use losses::{photometric, psnr, ssim};
pub use training::{
    DeviceTraining, NetworksStep, OptimiserRules, Reshaped, SplatEmbeddings, TrainingSplats, TrainingStep,
};
