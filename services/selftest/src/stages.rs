//! The stages of the self-test, in the order in which kernels depend on one another.

use crate::compare::{compared, test_cases};
use crate::field::field;
use crate::frame::{OPTIONS, SIZE, scene};
use crate::kernel_check::KernelCheck;
use crate::networks::networks;
use crate::sums::check_sums;
use crate::training::{training, training_splats, training_splats_with_embeddings};
use crate::view::check_view;
use segwild_gpu::GpuEngine;
use segwild_raster::{RasterError, Rasterizer};
use segwild_scene::Random;

/// Splats that go through networks: more than one piece of them.
const FEW: usize = 500;

/// Some of the kernels, compared.
pub type Stage = fn(&GpuEngine) -> Result<Vec<KernelCheck>, RasterError>;

/// All stages; kernels that others depend on come first.
pub const STAGES: [Stage; 6] =
    [check_sums, check_view, check_splats, check_networks, check_comparison, check_field];

/// Compares every kernel. Steps after one that is off may be off because of it.
pub fn check(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked = Vec::new();
    for stage in STAGES {
        checked.extend(stage(engine)?);
    }
    Ok(checked)
}

/// Compares the kernels of the splats' half of a training step.
pub fn check_splats(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let (mut splats, camera, pose) = scene();
    let random = &mut Random::new(6);
    splats.sh_degree = 3;
    splats.sh = (0..splats.len() * splats.sh_stride()).map(|_| 0.5 * random.uniform() - 0.25).collect();
    let mut checked = training(engine, &training_splats(splats.clone()), &camera, &pose, &OPTIONS)?;
    checked.extend(training(engine, &training_splats_with_embeddings(splats), &camera, &pose, &OPTIONS)?);
    Ok(checked)
}

/// Compares the kernels of the networks of the appearance model `gsw`.
pub fn check_networks(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let (splats, camera, pose) = scene();
    let few = splats.select(&(0..FEW).collect::<Vec<_>>());
    networks(engine, &few, &camera, &pose)
}

/// Compares the kernels of a photo's half of a step.
pub fn check_comparison(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked = Vec::new();
    for test_case in test_cases(SIZE) {
        checked.extend(compared(engine, &test_case)?);
    }
    Ok(checked)
}

/// Compares the kernels of the feature field.
pub fn check_field(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let (splats, camera, pose) = scene();
    field(engine, &*engine.project(&splats, &camera, &pose, &OPTIONS)?)
}
