//! Differentiable Gaussian splatting (method, section 1; paper Eq. 1-4, 9).
//!
//! One trait, [`Engine`], and its implementations; losses, optimiser and appearance models beside it.

mod adam;
mod appearance;
pub mod compare;
mod cpu;
mod engine;
mod fallback;
pub mod field;
mod kept;
mod loss;
pub mod reference;
mod resident;
mod sh;
mod shade;

pub use adam::{Adam, Rule};
pub use appearance::{
    AffineAppearance, AnyAppearance, Appearance, AppearanceEmbedding, AppearanceMaps, Directions,
    EmbedAppearance, EmbedLight, GswAppearance, GswWidth, HIDDEN_LAYER, HeldNetworks, ImageConditioning,
    NoAppearance, RANK, UNetInput, VisibleSplats, bake, gsw,
};
pub use cpu::{
    ALPHA_MAX, ALPHA_MIN, CpuEngine, FrontLayer, Isa, LOG2_ALPHA_MIN, NO_SPLAT, SLACK, T_MIN, jacobian_limits,
};
pub use engine::{
    Channels, Engine, Frame, FrameGrad, ProjectOptions, Projected, RasterError, SplatGrads, check,
};
pub use fallback::FallbackEngine;
pub use kept::Kept;
pub use loss::{photometric, psnr, ssim};
pub use resident::{Held, NetworksStep, OptimiserRules, Reshaped, Resident, SplatEmbeddings, TrainingStep};
pub use shade::{shade, shade_backward};
