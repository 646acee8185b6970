//! The accelerator engine: implements [`segwild_objective::Engine`] with the kernels of `shaders/`, through wgpu (Vulkan,
//! Metal, Direct3D 12).
//!
//! Each kernel bears the name of its twin in the CPU engine (`services/raster/src/cpu/`), with which
//! `segwild-selftest` compares it through [`probe`]; those of networks (`nets/`) have theirs in `services/nn` and
//! `services/objective/src/appearance/gsw/`. Buffers of a view stay on the device from `project` to `backward`.
//! Channels are uploaded, unless they are kept there for many views; images and gradients are downloaded. Splats in
//! training stay on the device too, with their optimiser, photos and networks (`training.rs`), and so do features
//! while they are refined (`field/`): then a whole step is submitted at once.
//!
//! ```
//! use glam::Vec3;
//! use segwild_gpu::{AdapterChoice, GpuEngine, GpuError};
//! use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
//! use segwild_scene::{Camera, Pose, Splats};
//!
//! // Without an accelerator the CPU engine renders the same.
//! let engine: Box<dyn Rasterizer> = match GpuEngine::new(&AdapterChoice::Hardware) {
//!     Ok(engine) => Box::new(engine),
//!     Err(GpuError::NoAdapter(_)) => Box::new(CpuEngine::new()),
//!     Err(error) => return Err(error.into()),
//! };
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
//! let view = engine.project(&splats, &camera, &pose, &ProjectOptions::default())?;
//! let frame = view.blend(&Channels { count: 3, values: &view.shade() })?;
//! assert!(frame.alpha.data[12 * 32 + 16] > 0.9 && frame.alpha.data[0] == 0.0);
//! # Ok::<(), segwild_raster::RasterError>(())
//! ```
//!
//! Start reading at `engine.rs`, then `view.rs`.

#[cfg(test)]
extern crate self as segwild_gpu;

mod adapter;
mod bin;
mod channels;
mod clock;
mod compare;
mod device;
mod engine;
mod field;
mod groups;
mod layer_flags;
mod memory;
mod need;
mod nets;
mod optimiser;
mod packing;
mod parameters;
mod passes;
pub mod probe;
mod shaders;
mod sort;
#[cfg(test)]
#[path = "../tests/adapter/mod.rs"]
mod test_adapter;
mod training;
mod view;
mod work_counts;

pub use adapter::{Adapter, AdapterChoice, NO_DRIVER, adapters};
pub use engine::GpuEngine;
pub use memory::LEAST_PHOTOS;
pub use need::{longest_of_photo, training_bytes};
pub use shaders::{KERNELS, Kernel, source};
pub use work_counts::WorkCounts;

/// Why the accelerator engine refused, or stopped.
#[derive(Debug, Clone, thiserror::Error)]
pub enum GpuError {
    /// There is no adapter, or none of the requested name.
    #[error("{0}")]
    NoAdapter(String),
    /// The adapter cannot do what every kernel needs.
    #[error("{adapter}: {what} is {available} where the kernels need {needed}")]
    TooSmall {
        /// Its name.
        adapter: String,
        /// Which limit.
        what: &'static str,
        /// What the adapter offers.
        available: u64,
        /// What is needed.
        needed: u64,
    },
    /// One array of this view does not fit.
    #[error(
        "{what} would take {bytes} bytes where {adapter} binds at most {limit} at once: render smaller frames, fewer \
         splats or fewer channels"
    )]
    TooLarge {
        /// Its name.
        adapter: String,
        /// What the array holds.
        what: &'static str,
        /// How long it would be.
        bytes: u64,
        /// How long it may be.
        limit: u64,
    },
    /// All arrays together are to take less.
    #[error(
        "{what} would take {bytes} bytes of {adapter}'s memory, of which {allocated} are taken and {budget} allowed: give more by \
         --memory-budget, or lower --splats or --size"
    )]
    OverBudget {
        /// Its name.
        adapter: String,
        /// What the array holds.
        what: &'static str,
        /// How long it would be.
        bytes: u64,
        /// Bytes of the others.
        allocated: u64,
        /// How many there may be.
        budget: u64,
    },
    /// The device failed: lost, out of memory, or a kernel that its driver does not compile.
    #[error("the accelerator {adapter} failed: {why}")]
    Failed {
        /// Its name.
        adapter: String,
        /// The reason that the driver reports.
        why: String,
    },
}

impl GpuError {
    /// Whether memory is the only reason: with less to hold the device would go on.
    pub(crate) fn is_out_of_memory(&self) -> bool {
        matches!(self, GpuError::TooLarge { .. } | GpuError::OverBudget { .. })
    }
}

impl From<GpuError> for segwild_raster::RasterError {
    fn from(error: GpuError) -> Self {
        segwild_raster::RasterError::Device(error.to_string())
    }
}
