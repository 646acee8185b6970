//! An accelerator for tests, and scenes.
#![allow(dead_code, unused_imports)]

#[path = "../../../gpu/tests/adapter/mod.rs"]
mod adapter;

pub use adapter::{either_way, engine};

use glam::Vec3;
use segwild_gpu::{AdapterChoice, GpuEngine, Kernel};
use segwild_objective::compare::{LeaveOut, LossInputs, LossOutput, PhotoTarget};
use segwild_objective::transients::Residuals;
use segwild_objective::{DeviceTraining, EmbedLight, NetworksStep, OptimiserRules, Rule, TrainingStep};
use segwild_raster::{ProjectOptions, RasterError};
use segwild_scene::{Camera, Image, Pose, Random, Splats};
use segwild_selftest::Stage;

pub fn uniform(random: &mut Random, from: f32, to: f32) -> f32 {
    from + (to - from) * random.uniform()
}

pub fn many(random: &mut Random, count: usize, from: f32, to: f32) -> Vec<f32> {
    (0..count).map(|_| uniform(random, from, to)).collect()
}

pub fn image(seed: u64, width: usize, height: usize, channels: usize) -> Image {
    Image {
        width,
        height,
        channels,
        data: many(&mut Random::new(seed), width * height * channels, -1.0, 1.0),
    }
}

/// A camera whose principal point is off the middle, and a pose that looks at the origin from the side.
pub fn view(width: u32, height: u32) -> (Camera, Pose) {
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: 1.1 * w, fy: 1.05 * w, cx: 0.47 * w, cy: 0.52 * h };
    (camera, Pose::look_at(Vec3::new(0.3, -0.4, -1.6), Vec3::new(0.02, 0.01, 0.0), Vec3::new(0.1, -1.0, 0.0)))
}

/// `count` splats in a ball in front of [`view`], some beyond its edges, with scales of `sizes`.
pub fn splats(seed: u64, count: usize, sizes: (f32, f32)) -> Splats {
    let random = &mut Random::new(seed);
    fn vector<const N: usize>(random: &mut Random, from: f32, to: f32) -> [f32; N] {
        std::array::from_fn(|_| uniform(random, from, to))
    }
    Splats {
        means: (0..count).map(|_| vector(random, -0.7, 0.7)).collect(),
        log_scales: (0..count).map(|_| vector(random, sizes.0.ln(), sizes.1.ln())).collect(),
        rotations: (0..count).map(|_| vector(random, -1.0, 1.0)).collect(),
        opacities: many(random, count, -3.0, 4.0),
        sh_degree: 1,
        sh: many(random, count * 12, -0.5, 0.5),
    }
}

/// A photo of noise with some sky.
pub fn photo(seed: u64, width: usize, height: usize) -> PhotoTarget {
    let random = &mut Random::new(seed);
    let pixel = |i: usize| {
        let sky = i < width * height / 5;
        let flags = if sky { PhotoTarget::SKY | PhotoTarget::INNER } else { PhotoTarget::COUNTS };
        [0, 1, 2, 3].map(|c| if c < 3 { random.below(256) as u8 } else { flags })
    };
    let pixels = (0..width * height).map(pixel).collect();
    PhotoTarget { width, height, pixels, trust: Vec::new() }
}

/// One step of training on [`photo`], which is kept under `key`.
pub fn step(
    on_device: &mut dyn DeviceTraining,
    (camera, pose): &(Camera, Pose),
    light: Option<&EmbedLight>,
    rules: &OptimiserRules,
    key: u64,
    sky_weight: f32,
) -> Result<LossOutput, RasterError> {
    step_with(on_device, (camera, pose), light, None, rules, key, sky_weight)
}

/// The same with networks.
pub fn step_with(
    on_device: &mut dyn DeviceTraining,
    (camera, pose): (&Camera, &Pose),
    light: Option<&EmbedLight>,
    networks: Option<NetworksStep>,
    rules: &OptimiserRules,
    key: u64,
    sky_weight: f32,
) -> Result<LossOutput, RasterError> {
    let loss_inputs = LossInputs {
        camera,
        pose,
        matrix: None,
        background: &[[0.5; 3]],
        has_sky: true,
        leave_out: LeaveOut::Residual(Residuals { before: &[], share: 0.3 }),
        lambda_ssim: 0.2,
        sky_weight,
    };
    let target = || photo(7, camera.width as usize, camera.height as usize);
    let options = ProjectOptions::default();
    let step = TrainingStep {
        options: &options,
        light,
        networks,
        loss_inputs,
        key: [0, key, 0],
        target: &target,
        rules,
    };
    Ok(on_device.step(&step)?.0)
}

/// The optimiser's usual rules at one rate.
pub fn rules(rate: f32) -> OptimiserRules {
    OptimiserRules::all(Rule { beta1: 0.9, beta2: 0.999, rate, epsilon: 1e-8 })
}

/// The adapter with a piece of a kernel's text replaced.
pub fn broken(
    choice: &AdapterChoice,
    kernel: &'static str,
    text: &'static str,
    fault: &'static str,
) -> GpuEngine {
    broken_with(true, choice, kernel, text, fault)
}

/// The same with `subgroups`, if the adapter has some, or without.
pub fn broken_with(
    subgroups: bool,
    choice: &AdapterChoice,
    kernel: &'static str,
    text: &'static str,
    fault: &'static str,
) -> GpuEngine {
    let edit = move |built: &Kernel, whole: String| {
        if built.name != kernel {
            return whole;
        }
        assert!(whole.contains(text), "{kernel}.wgsl no longer holds `{text}`");
        whole.replace(text, fault)
    };
    GpuEngine::with_edit(choice, subgroups, edit).expect("the adapter opens again")
}

/// The message where `stages` do not attribute the fault to the kernel that has it. Stages end with the one that finds
/// it, because compiling further kernels takes a driver long.
pub fn misled(stages: &[Stage], broken: &GpuEngine, kernel: &str, fault: &str) -> Option<String> {
    for stage in stages {
        let checked = match stage(broken) {
            Ok(checked) => checked,
            Err(error) => return Some(format!("{kernel}: `{fault}` does not run: {error}")),
        };
        match checked.iter().find(|step| step.off.is_some()) {
            None => {}
            Some(first) if first.kernels.contains(&kernel) => return None,
            Some(first) => return Some(format!("{kernel}: `{fault}` was taken for {first:?}")),
        }
    }
    Some(format!("{kernel}: `{fault}` was not found"))
}

/// A kernel, a piece of its text, and what that is replaced with.
pub type KernelFault = (&'static str, &'static str, &'static str);

/// The faults that are planted: all, or, on an adapter that is software, the first of each kernel, for such an adapter takes
/// seconds to compile a kernel. `SEGWILD_GPU_FAULTS=all` plants all there, too.
fn planted(gpu: &GpuEngine, faults: &[KernelFault]) -> Vec<KernelFault> {
    let all = std::env::var("SEGWILD_GPU_FAULTS").is_ok_and(|v| v == "all");
    let mut kernels = std::collections::BTreeSet::new();
    faults
        .iter()
        .copied()
        .filter(|fault| kernels.insert(fault.0) || all || !gpu.adapter().is_software())
        .collect()
}

/// Asserts that `stages` attribute each fault to the kernel that has it.
pub fn are_laid_to(stages: &[Stage], gpu: &GpuEngine, faults: &[KernelFault]) {
    let choice = &AdapterChoice::Named(gpu.adapter().name.clone());
    let planted = planted(gpu, faults);
    println!("{} of {} faults are planted", planted.len(), faults.len());
    let missed = planted.into_iter().filter_map(|(kernel, text, fault)| {
        misled(stages, &broken(choice, kernel, text, fault), kernel, fault)
    });
    let missed: Vec<String> = missed.collect();
    assert!(missed.is_empty(), "{}", missed.join("\n"));
}
