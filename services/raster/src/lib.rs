//! Differentiable Gaussian splatting (method, section 1; paper Eq. 1-4, 9).
//!
//! One trait, [`Engine`], and its implementations; losses, optimiser and looks beside it.

mod adam;
pub mod compare;
mod cpu;
mod engine;
pub mod field;
mod kept;
mod look;
mod loss;
pub mod reference;
mod resident;
mod sh;
mod shade;
mod spare;

pub use adam::{Adam, Rule};
pub use cpu::{ALPHA_MAX, ALPHA_MIN, CpuEngine, Isa, LOG2_ALPHA_MIN, SLACK, T_MIN, jacobian_limits};
pub use engine::{
    Channels, Engine, Frame, FrameGrad, ProjectOptions, Projected, RasterError, SplatGrads, check,
};
pub use kept::Kept;
pub use look::{
    AffineLook, AnyLook, Directions, EmbedLook, Glance, Glimpse, GswLook, GswWidth, HIDDEN, HeldNetworks,
    Impression, Light, Look, NoLook, RANK, Sight, Tone, bake, gsw,
};
pub use loss::{photometric, psnr, ssim};
pub use resident::{Codes, Held, NetworksStep, Reshaped, Resident, Rules, Step};
pub use shade::{shade, shade_backward};
pub use spare::SpareEngine;
