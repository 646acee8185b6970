//! Times each pass, and computes the least time that it must take on this device.
//!
//! The floor of a pass is the longer of two times: its arrays, each read or written once, at the bandwidth of a copy; and
//! its operations at the rate of a kernel that does nothing else. Operations are those of every pair of a splat and a tile
//! at every pixel of the tile, as if no light ran out.

use super::timing::{CLOCKED, Floor, LEAST, PassTime, Reach, repeated, slowest, timed};
use segwild_gpu::probe::{
    AdamPasses, FieldPasses, LightingPasses, LossPasses, RatePasses, SimilarityPasses, UploadedNetworks,
    ViewPasses, networks_floor, start_clock, stop_clock, wait,
};
use segwild_gpu::{GpuEngine, GpuError};
use segwild_objective::compare::{LeaveOut, LossInputs, PhotoTarget};
use segwild_objective::field::{FieldWeights, Queries};
use segwild_objective::transients::Residuals;
use segwild_objective::{
    Appearance, GswWidth, NetworksStep, OptimiserRules, Rule, TrainingBackend, TrainingSplats, TrainingStep,
};
use segwild_raster::{Channels, Frame, ProjectOptions, RasterError};
use segwild_scene::{Camera, Image, Pose, Random, Splats};
use segwild_selftest::{FeatureCase, some_appearance};
use std::time::Instant;

/// Operations of one splat at one pixel: footprint and blending, and the additions of a vec4 of channels and of the
/// backward pass.
const TOUCH: f64 = 14.0;
const PER_BLOCK: f64 = 8.0;
const BACK: f64 = 40.0;
/// How splats are projected.
const OPTIONS: ProjectOptions =
    ProjectOptions { low_pass: 0.3, antialias: true, near: segwild_scene::NEAR, jacobian_limits: None };

/// Measures the peak rates of the device.
pub fn reach(engine: &GpuEngine) -> Result<Reach, GpuError> {
    let mut passes = RatePasses::new(engine)?;
    let ms = repeated(&mut passes, RatePasses::copy)?;
    let rate = repeated(&mut passes, RatePasses::multiply_add)?;
    Ok(Reach { bytes: passes.moved() * 1e3 / ms, operations: RatePasses::OPERATIONS * 1e3 / rate })
}

/// Times every pass over a view, of `channels` channels where these matter, and a step of training at last.
pub fn speed(
    engine: &GpuEngine,
    reach: Reach,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
    channels: usize,
) -> Result<Vec<PassTime>, RasterError> {
    let mut rows = view(engine, reach, splats, camera, pose, channels)?;
    rows.push(networks(engine, reach, splats, camera, pose)?);
    rows.push(losses(engine, reach, some_feature_case(camera, channels))?);
    rows.push(similarity(engine, reach, splats.len(), channels)?);
    rows.extend(training(engine, reach, splats, camera, pose)?);
    let of_step = |row: &&PassTime| OF_STEP.contains(&row.pass);
    let floor_bytes = rows.iter().filter(of_step).map(|row| row.floor_bytes).sum();
    rows.iter_mut().filter(|row| row.pass == STEP).for_each(|row| row.floor_bytes = floor_bytes);
    Ok(rows)
}

/// Passes that a step without an appearance model consists of.
const OF_STEP: [&str; 6] = ["project, sort, bin", "shade", "blend", "backward", "adam", "compare"];

/// Times the passes over a view.
fn view(
    engine: &GpuEngine,
    reach: Reach,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
    channels: usize,
) -> Result<Vec<PassTime>, GpuError> {
    let mut passes = ViewPasses::upload(engine, splats, (camera, pose), &OPTIONS, channels)?;
    let counts = passes.counts();
    let (n, pairs, pixels) = (splats.len() as f64, counts.pairs as f64, counts.pixels as f64);
    let (blocks, stride) = (channels.div_ceil(4).max(1) as f64, splats.sh_stride() as f64);
    // Pairs at pixels, and what every pass over the pairs reads.
    let (touched, read) = (pairs * counts.tile_pixels as f64, pairs * 40.0);
    let wide = 16.0 * blocks;
    let kept = (counts.buckets * counts.tile_pixels * 4) as f64;
    let per_block = PER_BLOCK * blocks;
    type ViewPass<'e> = fn(&mut ViewPasses<'e>) -> Result<(), GpuError>;
    // Each with the bytes that it moves at the least, and its operations.
    let all: [(&'static str, ViewPass<'_>, f64, f64); 6] = [
        // A splat's twelve numbers in, its footprint, depth and centre out; a pair's tile, splat and slot.
        ("project, sort, bin", ViewPasses::project, n * (48.0 + 48.0) + pairs * 16.0, n * 200.0),
        ("sort", ViewPasses::sort, n * 16.0, 0.0),
        ("shade", ViewPasses::shade, n * (48.0 + 4.0 * stride), n * 8.0 * stride),
        (
            "blend",
            ViewPasses::blend,
            read + n * wide + pixels * (wide + 4.0) + kept,
            touched * (TOUCH + per_block),
        ),
        ("gather", ViewPasses::gather, read + n * wide + pixels * wide + kept, touched * (TOUCH + per_block)),
        // The gradients of values and of shapes. The remaining contribution per pixel is stored at the buckets in
        // between.
        (
            "backward",
            ViewPasses::backward,
            3.0 * read + n * (2.0 * wide + 112.0) + 2.0 * pixels * wide + 5.0 * kept,
            touched * (3.0 * (TOUCH + per_block) + BACK),
        ),
    ];
    let one = |(name, pass, bytes, operations)| -> Result<PassTime, GpuError> {
        Ok(timed(engine, &mut passes, pass)?.row(name, reach, Floor { bytes, operations }))
    };
    all.into_iter().map(one).collect()
}

/// Name of the pass of the networks of the appearance model `gsw`.
pub const NETWORKS: &str = "networks of gsw";

/// Times the networks of the appearance model `gsw`, forward and backward, with all splats in sight.
fn networks(
    engine: &GpuEngine,
    reach: Reach,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
) -> Result<PassTime, GpuError> {
    let n = splats.len();
    let (appearance, draw) = some_appearance(camera, pose);
    let rules = [Rule { beta1: 0.9, beta2: 0.999, rate: 0.0, epsilon: 1e-8 }; 2];
    let step = NetworksStep { unet_input: appearance.unet_input(0, draw), draw, decides: false, rules };
    let networks = UploadedNetworks::upload(engine, &appearance.training_networks())?;
    let (radii, colours) = (vec![1.0; n], vec![0.0; 3 * n]);
    let embeddings = appearance.first_embeddings(&splats.means);
    let splats = (splats.means.as_slice(), radii.as_slice());
    let eye = pose.centre();
    let mut passes =
        LightingPasses::upload(engine, &networks, &step, eye, splats, (&embeddings, &colours), None)?;
    let spent = timed(engine, &mut passes, |passes| {
        passes.tint()?;
        passes.backward()
    })?;
    let (bytes, operations) = networks_floor(GswWidth::Cpu, n);
    Ok(spent.row(NETWORKS, reach, Floor { bytes, operations }))
}

/// Name of the pass of the feature field's losses, with a learned decoder, and their gradients of the image.
pub const LOSSES: &str = "losses of the field";

/// A feature case of usual size: a usual embedding, as many masks as a photo has, and features rendered at 128 pixels.
pub fn some_feature_case(camera: &Camera, channels: usize) -> FeatureCase {
    let camera = camera.scaled_to(128);
    FeatureCase {
        size: (camera.width, camera.height),
        channels,
        decoded: Some(256),
        grid: [64, 48],
        pixels: 1024,
        masks: 60,
    }
}

/// Weights of the losses.
pub const FIELD_WEIGHTS: FieldWeights = FieldWeights { embedding: 0.7, compact: 0.3, rate: 0.0 };

/// Times the losses of the feature field.
fn losses(engine: &GpuEngine, reach: Reach, case: FeatureCase) -> Result<PassTime, GpuError> {
    let random = &mut Random::new(3);
    let (made, image) = (case.make(random), case.image(random));
    let channels = case.channels;
    let field = case.refinement(vec![0.0; channels], FIELD_WEIGHTS);
    let pixels = (case.size.0 * case.size.1) as usize;
    let mut passes = FieldPasses::upload(engine, &field, &image, &made.feature_target())?;
    let sampled = made.sampled_pixels();
    let spent = timed(engine, &mut passes, |passes| passes.losses(&sampled))?;
    let (c, cells) = (channels as f64, (case.grid[0] * case.grid[1]) as f64);
    let (outputs, sampled_pixels) = (case.decoded.map_or(0.0, |n| n as f64), case.pixels as f64);
    // Image, target and weights; forward and twice backward, and of pairs once.
    let bytes = 4.0 * (2.0 * c * pixels as f64 + outputs * (cells + 6.0 * c) + 2.0 * c * sampled_pixels);
    let operations = 2.0
        * (3.0 * c * outputs * cells + 2.0 * c * sampled_pixels * sampled_pixels + 2.0 * c * pixels as f64);
    Ok(spent.row(LOSSES, reach, Floor { bytes, operations }))
}

/// The pass that compares every splat's features with those of clicks.
pub const SIMILARITY: &str = "similarity to 4 clicks";
/// So many.
pub const CLICKS: usize = 4;

fn similarity(
    engine: &GpuEngine,
    reach: Reach,
    splats: usize,
    channels: usize,
) -> Result<PassTime, GpuError> {
    let values = vec![0.5; splats * channels];
    let units = vec![vec![0.5; channels]; CLICKS];
    let queries = Queries { channels, units: &units, sharpness: 10.0 };
    let features = Channels { count: channels, values: &values };
    let Some(mut passes) = SimilarityPasses::upload(engine, &features)? else {
        return Ok(PassTime { pass: SIMILARITY, ..PassTime::default() });
    };
    let spent = timed(engine, &mut passes, |passes| passes.compare(&queries))?;
    let (n, c) = (splats as f64, channels as f64);
    let floor = Floor { bytes: 4.0 * n * (c + 1.0), operations: 2.0 * n * c * (CLICKS + 1) as f64 };
    Ok(spent.row(SIMILARITY, reach, floor))
}

/// The pass that is a whole step of training.
pub const STEP: &str = "a whole step";

/// A photo with some sky above.
fn some_photo(width: usize, height: usize) -> PhotoTarget {
    let pixel = |i: usize| {
        let sky = i < width * height / 4;
        [
            i as u8,
            (i >> 3) as u8,
            (i >> 6) as u8,
            if sky { PhotoTarget::SKY | PhotoTarget::INNER } else { PhotoTarget::COUNTS },
        ]
    };
    let pixels = (0..width * height).map(pixel).collect();
    PhotoTarget { width, height, pixels, trust: vec![0.1; width * height] }
}

/// Times training steps of splats that stay on the device.
fn training(
    engine: &GpuEngine,
    reach: Reach,
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
) -> Result<Vec<PassTime>, RasterError> {
    let n = splats.len();
    let zero = Splats {
        means: vec![[0.0; 3]; n],
        log_scales: vec![[0.0; 3]; n],
        rotations: vec![[0.0; 4]; n],
        opacities: vec![0.0; n],
        sh: vec![0.0; splats.sh.len()],
        sh_degree: splats.sh_degree,
    };
    let state = TrainingSplats {
        splats: splats.clone(),
        first: zero.clone(),
        second: zero,
        sums: vec![[0.0; 4]; n],
        ..TrainingSplats::default()
    };
    // Nothing moves: what is timed stays the same.
    let rule = Rule { beta1: 0.9, beta2: 0.999, rate: 0.0, epsilon: 1e-15 };
    let rules = OptimiserRules::all(rule);
    let numbers = (n * (12 + splats.sh_stride())) as f64;
    let spent = timed(engine, &mut AdamPasses::upload(engine, &state, &rules)?, AdamPasses::step)?;
    let floor = Floor { bytes: numbers * 28.0, operations: numbers * 12.0 };
    let mut rows = vec![spent.row("adam", reach, floor)];
    let (width, height) = (camera.width as usize, camera.height as usize);
    let target = some_photo(width, height);
    let loss_inputs = LossInputs {
        camera,
        pose,
        matrix: Some([1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]),
        background: &[[0.5; 3]],
        has_sky: true,
        leave_out: LeaveOut::Residual(Residuals { before: &[], share: 0.35 }),
        lambda_ssim: 0.2,
        sky_weight: 0.1,
    };
    let frame = Frame { image: Image::zeros(width, height, 3), alpha: Image::zeros(width, height, 1) };
    let mut passes = LossPasses::upload(engine, &frame, &target, &loss_inputs, None)?;
    let spent = timed(engine, &mut passes, |passes| passes.compare(&loss_inputs))?;
    drop(passes);
    let pixels = (width * height) as f64;
    // Numbers that its kernels read and write per pixel: 11 to compose, 18 to find what is left out, 63 for the loss,
    // 12 for its backward pass. A window of eleven by eleven is eleven numbers twice, for four maps forward and three
    // backward.
    let (bytes, operations) = (pixels * 4.0 * 104.0, pixels * 3.0 * 11.0 * 2.0 * 7.0 * 2.0);
    rows.push(spent.row("compare", reach, Floor { bytes, operations }));
    let Some(mut on_device) = engine.upload_training(&mut || state.clone())? else {
        return Err(RasterError::Shape("the splats do not fit where they are trained".into()));
    };
    let step = TrainingStep {
        options: &OPTIONS,
        light: None,
        networks: None,
        loss_inputs,
        // No training has this number.
        key: [u64::MAX, splats.len() as u64, pixels as u64],
        target: &|| some_photo(width, height),
        rules: &rules,
    };
    let (began, mut steps) = (Instant::now(), -1.0);
    let mut started = began;
    while steps < 3.0 || started.elapsed().as_secs_f64() < LEAST {
        if steps == 0.0 {
            started = Instant::now();
        }
        on_device.step(&step)?;
        steps += 1.0;
    }
    wait(engine)?;
    let ms = started.elapsed().as_secs_f64() * 1e3 / steps;
    let before = engine.work_counts();
    on_device.step(&step)?;
    let counts = engine.work_counts() - before;
    start_clock(engine);
    for _ in 0..CLOCKED {
        on_device.step(&step)?;
    }
    wait(engine)?;
    let kernels = slowest(stop_clock(engine), CLOCKED);
    rows.push(PassTime { pass: STEP, ms, counts, kernels, ..PassTime::default() });
    Ok(rows)
}
