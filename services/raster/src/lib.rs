//! Differentiable Gaussian splatting (method, section 1; paper Eq. 1-4): projects splats, blends them, and goes back.
//!
//! [`Rasterizer`] is the interface, [`CpuEngine`] its implementation for processors, [`reference`] the same formulas in
//! f64, pixel by pixel, against which every implementation is tested. What a training minimises (losses, optimiser,
//! appearance, feature field) is in `segwild-objective`; the accelerator's implementation is in `segwild-gpu`.
//!
//! ```
//! use glam::Vec3;
//! use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
//! use segwild_scene::{Camera, Pose, Splats};
//!
//! let splats = Splats {
//!     means: vec![[0.0, 0.0, 2.0]],
//!     log_scales: vec![[-2.0; 3]],
//!     rotations: vec![[1.0, 0.0, 0.0, 0.0]],
//!     opacities: vec![4.0],
//!     sh: vec![0.5; 3],
//!     ..Splats::default()
//! };
//! let camera = Camera { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 16.0, cy: 12.0 };
//! let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
//! let engine = CpuEngine::new();
//! let view = engine.project(&splats, &camera, &pose, &ProjectOptions::default())?;
//! let frame = view.blend(&Channels { count: 3, values: &view.shade() })?;
//! // The splat covers the centre, and no corner.
//! assert!(frame.alpha.data[12 * 32 + 16] > 0.9 && frame.alpha.data[0] == 0.0);
//! # Ok::<(), segwild_raster::RasterError>(())
//! ```
//!
//! Start reading at `engine.rs` (the interface), then `cpu/project.rs` (one splat) and `cpu/kernels.rs` (one tile).

mod cpu;
mod engine;
pub mod reference;
pub mod sh;
mod shade;

pub use cpu::simd;
pub use cpu::{
    ALPHA_MAX, ALPHA_MIN, CpuEngine, FrontLayer, Isa, LOG2_ALPHA_MIN, NO_SPLAT, SLACK, T_MIN, jacobian_limits,
};
pub use engine::{
    Channels, Frame, FrameGrad, ProjectOptions, Projected, RasterError, Rasterizer, ResidentChannels,
    SplatGrads, check,
};
pub use shade::{shade, shade_backward};
