//! Times each pass, and computes the least time that it must take on this device.
//!
//! The floor of a pass is the longer of two times: its arrays, each read or written once, at the bandwidth of a copy; and
//! its operations at the rate of a kernel that does nothing else. Operations are those of every pair of a splat and a tile
//! at every pixel of the tile, as if no light ran out.

use crate::check::{FeatureCase, OPTIONS};
use crate::compare::{ComparisonInputs, GpuPhoto, compare};
use crate::device::DeviceWork;
use crate::engine::{Cloud, GROUP, bin, sort};
use crate::field::{GpuFeatureTarget, GpuField};
use crate::kept::GpuChannels;
use crate::nets::{GpuNetworks, NetworkLighting, PIECE, floor};
use crate::passes::PIXELS;
use crate::shaders::{RATE, SHADE};
use crate::training::GpuTraining;
use crate::view::{at_once, gathered_at_once, pack_image, parts_of};
use crate::{GpuEngine, GpuError};
use segwild_objective::compare::{LeaveOut, LossInputs, PhotoTarget};
use segwild_objective::field::{FieldRule, Queries};
use segwild_objective::transients::Residuals;
use segwild_objective::{
    Appearance, GswAppearance, GswWidth, Held, NetworksStep, OptimiserRules, Resident, Rule, TrainingStep,
    gsw,
};
use segwild_raster::{Channels, RasterError};
use segwild_scene::{Camera, Pose, Random, Splats};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

/// Least seconds over which a pass is repeated, and most repetitions.
const LEAST: f64 = 0.25;
const MOST: usize = 200;
/// Operations of one splat at one pixel: footprint and blending, and the additions of a vec4 of channels and of the
/// backward pass.
const TOUCH: f64 = 14.0;
const PER_BLOCK: f64 = 8.0;
const BACK: f64 = 40.0;

/// Peak rates of the device.
#[derive(Clone, Copy, Debug)]
pub struct Reach {
    /// Bytes read and written in a second by a copy.
    pub bytes: f64,
    /// Operations in a second.
    pub operations: f64,
}

impl Reach {
    /// Least milliseconds for so many bytes and operations.
    fn floor_ms(&self, bytes: f64, operations: f64) -> f64 {
        1e3 * (bytes / self.bytes).max(operations / self.operations)
    }
}

/// One pass over one view.
#[derive(Clone, Debug)]
pub struct PassTime {
    /// Its name: that of a kernel of `shaders/`, or of what several do together.
    pub pass: &'static str,
    /// Milliseconds of wall clock.
    pub ms: f64,
    /// The floor of this time; 0 where it is not one pass of the device.
    pub floor_ms: f64,
    /// Milliseconds of its kernels by the device's own clock, the slowest first; none where it has no clock. The rest
    /// of [`PassTime::ms`] is submission and waiting.
    pub kernels: Vec<(&'static str, f64)>,
}

/// Mean milliseconds of work, and of each of its kernels.
struct Spent {
    ms: f64,
    kernels: Vec<(&'static str, f64)>,
}

impl Spent {
    fn row(self, pass: &'static str, floor_ms: f64) -> PassTime {
        PassTime { pass, ms: self.ms, floor_ms, kernels: self.kernels }
    }
}

/// Times that kernels are timed one by one.
const CLOCKED: u32 = 3;

/// Times by the device's clock over so many repetitions, the slowest kernel first.
fn slowest(spent: BTreeMap<&'static str, f64>, repetitions: u32) -> Vec<(&'static str, f64)> {
    let mut kernels: Vec<_> =
        spent.into_iter().map(|(name, ms)| (name, ms / f64::from(repetitions))).collect();
    kernels.sort_by(|a, b| b.1.total_cmp(&a.1));
    kernels
}

/// Times work that is submitted repeatedly and waited for once; then its kernels.
fn timed(
    work: &mut DeviceWork,
    mut pass: impl FnMut(&mut DeviceWork) -> Result<(), GpuError>,
) -> Result<Spent, GpuError> {
    let ms = repeated(work, &mut pass)?;
    work.start_clock();
    for _ in 0..CLOCKED {
        pass(work)?;
    }
    work.wait()?;
    Ok(Spent { ms, kernels: slowest(work.stop_clock(), CLOCKED) })
}

/// Mean milliseconds of work that is submitted repeatedly and waited for once.
fn repeated(
    work: &mut DeviceWork,
    mut pass: impl FnMut(&mut DeviceWork) -> Result<(), GpuError>,
) -> Result<f64, GpuError> {
    // Compiles, and allocates its memory.
    pass(work)?;
    work.wait()?;
    let mut calls = 1;
    loop {
        let began = Instant::now();
        for _ in 0..calls {
            pass(work)?;
        }
        work.wait()?;
        let spent = began.elapsed().as_secs_f64();
        if spent >= LEAST || calls >= MOST {
            return Ok(spent * 1e3 / calls as f64);
        }
        calls = ((1.5 * LEAST / spent.max(1e-6)) as usize * calls).clamp(2 * calls, MOST.max(2 * calls));
    }
}

/// Measures the peak rates of the device.
pub fn reach(engine: &GpuEngine) -> Result<Reach, GpuError> {
    let mut work = engine.device.work();
    let bytes = engine.adapter().binding.min(256 << 20) as usize / 16 * 16;
    let (from, to) = (work.take::<u8>("a copy's source", bytes)?, work.take::<u8>("a copy", bytes)?);
    work.clear(&from);
    let ms = repeated(&mut work, |work| {
        work.copy_to(&from, &to, 0, bytes);
        Ok(())
    })?;
    let threads = 1 << 20;
    let turns = 256;
    let out = work.take::<f32>("sums", threads)?;
    let rate = repeated(&mut work, |work| {
        work.run(&RATE, 1, [threads as u32, turns, 0, 0], &[&out], threads / GROUP);
        Ok(())
    })?;
    let operations = threads as f64 * f64::from(turns) * 16.0;
    Ok(Reach { bytes: 2.0 * bytes as f64 * 1e3 / ms, operations: operations * 1e3 / rate })
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
    let mut rows = {
        let mut bench = Bench { work: engine.device.work(), reach, rows: Vec::new() };
        bench.passes(splats, camera, pose, channels.div_ceil(4).max(1))?;
        bench.rows
    };
    rows.push(networks(engine, reach, splats, camera, pose)?);
    rows.push(losses(engine, reach, some_feature_case(camera, channels))?);
    rows.push(similarity(engine, reach, splats.len(), channels)?);
    rows.extend(training(engine, reach, splats, camera, pose)?);
    Ok(rows)
}

/// Passes that are timed one after the other.
struct Bench<'a> {
    work: DeviceWork<'a>,
    reach: Reach,
    rows: Vec<PassTime>,
}

impl Bench<'_> {
    /// Times a pass that moves so many bytes at the least, and does so many operations.
    fn row(
        &mut self,
        pass: &'static str,
        bytes: f64,
        operations: f64,
        run: impl FnMut(&mut DeviceWork) -> Result<(), GpuError>,
    ) -> Result<(), GpuError> {
        let floor = self.reach.floor_ms(bytes, operations);
        self.rows.push(timed(&mut self.work, run)?.row(pass, floor));
        Ok(())
    }

    fn passes(
        &mut self,
        splats: &Splats,
        camera: &Camera,
        pose: &Pose,
        blocks: usize,
    ) -> Result<(), GpuError> {
        let (count, n) = (splats.len(), splats.len() as f64);
        let cloud = Arc::new(Cloud::upload(&mut self.work, splats)?);
        let sh = self.work.upload("the splats' harmonics", &splats.sh)?;
        let (on, seen) = bin(&mut self.work, cloud.clone(), camera, pose, &OPTIONS, None)?;
        let (pairs, pixels) = (on.pairs as f64, on.pixels as f64);
        // A splat's twelve numbers in, its footprint, depth and centre out; a pair's tile, splat and slot.
        self.row("project, sort, bin", n * (48.0 + 48.0) + pairs * 16.0, n * 200.0, |work| {
            bin(work, cloud.clone(), camera, pose, &OPTIONS, None).map(drop)
        })?;
        let keys: Vec<u32> = (0..count as u32).map(|i| i.wrapping_mul(2_654_435_761)).collect();
        let keys = self.work.upload("keys", &keys)?;
        self.row("sort", n * 16.0, 0.0, |work| {
            let (from, items) = (work.take::<u32>("sort keys", count)?, work.take::<u32>("items", count)?);
            work.copy_to(&keys, &from, 0, 4 * count);
            sort(work, from, items, count, u32::BITS).map(drop)
        })?;
        let colours = self.work.take::<[f32; 4]>("the splats' colours", count)?;
        let stride = splats.sh_stride() as f64;
        self.row("shade", n * (48.0 + 4.0 * stride), n * 8.0 * stride, |work| {
            let buffers = [&on.view, &cloud.means, &seen, &sh, &colours];
            work.run(&SHADE, 1, [count as u32, splats.sh_degree, 0, 0], &buffers, count.div_ceil(GROUP));
            Ok(())
        })?;
        // Pairs at pixels, and what every pass over the pairs reads.
        let (touched, read) = (pairs * PIXELS as f64, pairs * 40.0);
        let wide = 16.0 * blocks as f64;
        let values = self.work.take::<[f32; 4]>("the splats' channels", count * blocks)?;
        let image = self.work.take::<[f32; 4]>("the image", on.pixels * blocks)?;
        self.work.clear(&values);
        self.work.clear(&image);
        let alpha = self.work.take::<f32>("alpha", on.pixels)?;
        let lights = on.lights(&mut self.work)?;
        let kept = (on.bucket_bound * PIXELS * 4) as f64;
        let per_block = PER_BLOCK * blocks as f64;
        let moved = read + n * wide + pixels * (wide + 4.0) + kept;
        self.row("blend", moved, touched * (TOUCH + per_block), |work| {
            let at_once = if blocks == 1 { 1 } else { 4 };
            for first in (0..blocks).step_by(at_once) {
                on.blend(work, at_once, &values, first == 0, &alpha, &lights)?;
            }
            Ok(())
        })?;
        let moved = read + n * wide + pixels * wide + kept;
        let gather = |work: &mut DeviceWork| -> Result<(), GpuError> {
            let at_once = blocks.min(2);
            for _ in (0..blocks).step_by(at_once) {
                on.gather(work, at_once, &image, &lights)?;
            }
            Ok(())
        };
        self.row("gather", moved, touched * (TOUCH + per_block), gather)?;
        // The gradients of values and of shapes. The remaining contribution per pixel is stored at the buckets in
        // between.
        let moved = 3.0 * read + n * (2.0 * wide + 112.0) + 2.0 * pixels * wide + 5.0 * kept;
        let operations = touched * (3.0 * (TOUCH + per_block) + BACK);
        self.row("backward", moved, operations, |work| {
            gather(work)?;
            on.backward(work, blocks, &values, &image).map(drop)
        })
    }
}

/// Name of the pass of the networks of the appearance model `gsw`.
pub const NETWORKS: &str = "networks of gsw";

/// An appearance model `gsw` with one square photo of a camera, at the size of the UNet's input, and a step that reads
/// its light.
pub fn some_appearance(camera: &Camera, pose: &Pose) -> (GswAppearance, u64) {
    let mut appearance = GswAppearance::new(1, 1, GswWidth::Cpu);
    let side = gsw::Networks::of(GswWidth::Cpu).side;
    let colour = |i: usize| Some([i % side, i / side, 7].map(|n| n as f32 / side as f32));
    let image_conditioning = appearance.image_conditioning((side, side), camera, pose, colour);
    appearance.set_image_conditioning(0, image_conditioning);
    let draw =
        (0..1000).find(|&draw| appearance.unet_input(0, draw).is_some_and(|unet_input| unet_input.whole));
    (appearance, draw.expect("one in a thousand"))
}

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
    let work = &mut engine.device.work();
    let held = GpuNetworks::upload(work, &appearance.held())?;
    let cloud = Cloud::upload(work, splats)?;
    let seen = work.upload("depths and radii", &vec![[1.0f32; 4]; n])?;
    let splat_embeddings =
        work.upload("the splats' embeddings", &appearance.first_embeddings(&splats.means))?;
    let by_embedding = work.take::<f32>("the embeddings' gradients", n * GswAppearance::EMBEDDING_SIZE)?;
    let colours = work.take::<[f32; 4]>("the splats' colours", n)?;
    work.clear(&colours);
    let lighting = NetworkLighting::upload(work, &held, &step, pose.centre(), n, PIECE)?;
    let spent = timed(work, |work| {
        lighting.tint(work, &seen, &cloud.means, &splat_embeddings, &colours)?;
        lighting.backward(work, &colours, (&cloud.means, &splat_embeddings), &by_embedding, None)
    })?;
    let (bytes, operations) = floor(GswWidth::Cpu, n);
    Ok(spent.row(NETWORKS, reach.floor_ms(bytes, operations)))
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
pub const FIELD_RULE: FieldRule = FieldRule { embedding: 0.7, compact: 0.3, rate: 0.0 };

/// Times the losses of the feature field.
fn losses(engine: &GpuEngine, reach: Reach, case: FeatureCase) -> Result<PassTime, GpuError> {
    let random = &mut Random::new(3);
    let (made, image) = (case.make(random), case.image(random));
    let channels = case.channels;
    let field = case.refining(vec![0.0; channels], FIELD_RULE);
    let field = GpuField::upload(&engine.device, &field)?;
    let pixels = (case.size.0 * case.size.1) as usize;
    let work = &mut engine.device.work();
    let feature_target = GpuFeatureTarget::upload(&engine.device, work, &made.feature_target())?;
    let blocks = at_once(channels);
    let parts = parts_of(channels)
        .map(|first| Ok((first, work.upload("the image", &pack_image(&image, first, blocks, None))?)));
    let parts = parts.collect::<Result<Vec<_>, GpuError>>()?;
    let spent = timed(work, |work| {
        let step = field.start(work, &feature_target, &made.sampled_pixels())?;
        for (first, image) in &parts {
            step.take(work, first / 4, blocks, image);
        }
        step.compute_losses(work)?;
        let blocks = gathered_at_once(channels);
        for first in (0..channels).step_by(4 * blocks) {
            step.gradients(work, first / 4, blocks)?;
        }
        Ok(())
    })?;
    let (c, cells) = (channels as f64, (case.grid[0] * case.grid[1]) as f64);
    let (outputs, sampled_pixels) = (case.decoded.map_or(0.0, |n| n as f64), case.pixels as f64);
    // Image, target and weights; forward and twice backward, and of pairs once.
    let bytes = 4.0 * (2.0 * c * pixels as f64 + outputs * (cells + 6.0 * c) + 2.0 * c * sampled_pixels);
    let operations = 2.0
        * (3.0 * c * outputs * cells + 2.0 * c * sampled_pixels * sampled_pixels + 2.0 * c * pixels as f64);
    Ok(spent.row(LOSSES, reach.floor_ms(bytes, operations)))
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
    let kept = GpuChannels::upload(&engine.device, &Channels { count: channels, values: &values })?;
    let units = vec![vec![0.5; channels]; CLICKS];
    let queries = Queries { channels, units: &units, sharpness: 10.0 };
    let Some(kept) = kept else {
        return Ok(PassTime { pass: SIMILARITY, ms: 0.0, floor_ms: 0.0, kernels: Vec::new() });
    };
    let spent = timed(&mut engine.device.work(), |work| kept.resemblance(work, &queries).map(drop))?;
    let (n, c) = (splats as f64, channels as f64);
    let floor_ms = reach.floor_ms(4.0 * n * (c + 1.0), 2.0 * n * c * (CLICKS + 1) as f64);
    Ok(spent.row(SIMILARITY, floor_ms))
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
    let held = Held {
        splats: splats.clone(),
        first: zero.clone(),
        second: zero,
        sums: vec![[0.0; 4]; n],
        ..Held::default()
    };
    let mut on_device = GpuTraining::new(&engine.device, &engine.photos_on_device, &held)?;
    // Nothing moves: what is timed stays the same.
    let rule = Rule { beta1: 0.9, beta2: 0.999, rate: 0.0, epsilon: 1e-15 };
    let rules = OptimiserRules::all(rule);
    let numbers = (n * (12 + splats.sh_stride())) as f64;
    let grads = on_device.some_gradients()?;
    let mut work = engine.device.work();
    let seen = work.take::<[f32; 4]>("depths and centres", n)?;
    let found = work.upload("how many pairs there are", &[0u32, 1])?;
    let groups = on_device.groups(&mut work, &rules, None)?;
    let spent = timed(&mut work, |work| {
        on_device.adam(work, &grads, None, &seen, &found, &groups);
        Ok(())
    })?;
    let mut rows = vec![spent.row("adam", reach.floor_ms(numbers * 28.0, numbers * 12.0))];
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
    let photo = GpuPhoto::upload(&mut work, &target)?;
    let inputs = ComparisonInputs::upload(&mut work, &loss_inputs)?;
    let cloud = Arc::new(Cloud::upload(&mut work, splats)?);
    let (on, _) = bin(&mut work, cloud, camera, pose, &OPTIONS, None)?;
    let image = work.take::<[f32; 4]>("the image", width * height)?;
    work.clear(&image);
    let spent = timed(&mut work, |work| {
        compare(work, &on.view, &image, &photo, &inputs, &loss_inputs, None).map(drop)
    })?;
    let pixels = (width * height) as f64;
    // Numbers that its kernels read and write per pixel: 11 to compose, 18 to find what is left out, 63 for the loss,
    // 12 for its backward pass. A window of eleven by eleven is eleven numbers twice, for four maps forward and three
    // backward.
    let (bytes, operations) = (pixels * 4.0 * 104.0, pixels * 3.0 * 11.0 * 2.0 * 7.0 * 2.0);
    rows.push(spent.row("compare", reach.floor_ms(bytes, operations)));
    drop((work, on, image, inputs, photo, seen, found, groups));
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
    engine.device.work().wait()?;
    let ms = started.elapsed().as_secs_f64() * 1e3 / steps;
    engine.device.start_clock();
    for _ in 0..CLOCKED {
        on_device.step(&step)?;
    }
    engine.device.work().wait()?;
    let kernels = slowest(engine.device.stop_clock(), CLOCKED);
    rows.push(PassTime { pass: STEP, ms, floor_ms: 0.0, kernels });
    Ok(rows)
}
