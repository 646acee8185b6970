//! Differentiable Gaussian splatting (method, section 1; paper Eq. 1-4, 9).
//!
//! One trait, [`Engine`], and its implementations; losses, optimiser and looks beside it.

mod adam;
mod cpu;
mod engine;
mod look;
mod loss;
pub mod reference;

pub use adam::Adam;
pub use cpu::{CpuEngine, Isa};
pub use engine::{Channels, Engine, Frame, FrameGrad, ProjectOptions, Projected, RasterError, SplatGrads};
pub use look::{
    AffineLook, AnyLook, EmbedLook, Glance, GswLook, GswWidth, HIDDEN, Impression, Look, NoLook, RANK, Sight,
    Tone, bake,
};
pub use loss::{photometric, psnr, ssim};
