//! Measures every pass, on the device and on the CPU.

use super::goal::{Goal, train};
use super::record::{KERNEL, record};
use super::speed::{CLICKS, FIELD_WEIGHTS, LOSSES, NETWORKS, SIMILARITY, reach, some_feature_case, speed};
use super::timing::{PassTime, Reach};
use crate::page::PageError;
use crate::scale::kernels::filling;
use glam::Vec3;
use rayon::prelude::*;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_gpu::{AdapterChoice, GpuEngine, WorkCounts};
use segwild_objective::field::{Queries, score};
use segwild_objective::{Appearance, VisibleSplats};
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, RasterError, Rasterizer};
use segwild_scene::{Camera, Pose, Random, Splats};
use segwild_selftest::some_appearance;
use segwild_synthetic::random::Rng;
use std::collections::BTreeMap;
use std::time::Instant;

/// What is measured.
#[derive(Clone, Debug)]
pub struct EngineOptions {
    /// The command line, for the page.
    pub command: String,
    /// Which accelerator.
    pub choice: AdapterChoice,
    /// Numbers of splats.
    pub splats: Vec<u32>,
    /// Frames, width and height.
    pub sizes: Vec<(u32, u32)>,
    /// Channels, each on the smallest frame and with the fewest splats, after three on all.
    pub channels: Vec<u32>,
    /// Whether the CPU engine does the same beside it.
    pub cpu: bool,
    /// Whether kernels go by subgroups where the accelerator has some.
    pub subgroups: bool,
    /// What a training is to reach, if one is timed.
    pub goal: Option<Goal>,
}

/// Measures every combination; `report` receives each record.
pub fn engine(options: &EngineOptions, mut report: impl FnMut(&Record)) -> Result<Results, PageError> {
    let open = if options.subgroups { GpuEngine::new } else { GpuEngine::without_subgroups };
    let gpu = open(&options.choice)?;
    let mut made = Provenance::here(options.command.clone());
    let adapter = gpu.adapter();
    made.machine =
        format!("{} ({}, {}) beside {}", adapter.name, adapter.backend, adapter.driver, made.machine);
    let reach = reach(&gpu)?;
    let mut results = Results { made, ..Results::default() };
    let mut put = |record: Record| {
        report(&record);
        results.records.push(record);
    };
    let numbers =
        [("bytes_per_s".to_owned(), reach.bytes), ("operations_per_s".to_owned(), reach.operations)];
    let mut reached = record("reach", "", BTreeMap::from(numbers));
    if gpu.adapter().is_software() {
        reached.notes.push("This adapter is a program on the CPU: these are no figures of a GPU".into());
    }
    put(reached);
    let mut work: Vec<(u32, (u32, u32), u32)> = Vec::new();
    for &size in &options.sizes {
        work.extend(options.splats.iter().map(|&splats| (splats, size, 3)));
    }
    if let (Some(&size), Some(&splats)) = (options.sizes.first(), options.splats.first()) {
        work.extend(options.channels.iter().filter(|&&c| c != 3).map(|&c| (splats, size, c)));
    }
    for (splats, size, channels) in work {
        let target = format!("{splats} splats, {} x {}, {channels} channels", size.0, size.1);
        match measure(&gpu, reach, splats, size, channels, options.cpu) {
            Ok(rows) => rows.into_iter().for_each(|(pass, numbers)| put(record(pass, &target, numbers))),
            // What does not fit on this device is a result too.
            Err(error) => {
                put(Record { notes: vec![error.to_string()], ..record("refused", &target, BTreeMap::new()) });
            }
        }
    }
    if let Some(goal) = &options.goal {
        let name = gpu.adapter().name.clone();
        drop(gpu);
        put(train(goal, "gpu", &name)?);
        if options.cpu {
            put(train(goal, "cpu", "")?);
        }
    }
    Ok(results)
}

type KernelTimes = (&'static str, BTreeMap<String, f64>);

fn measure(
    gpu: &GpuEngine,
    reach: Reach,
    splats: u32,
    (width, height): (u32, u32),
    channels: u32,
    with_cpu: bool,
) -> Result<Vec<KernelTimes>, RasterError> {
    let scene = frame(splats, width, height);
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: w, fy: w, cx: w / 2.0, cy: h / 2.0 };
    let pose = Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y);
    let timed = speed(gpu, reach, &scene, &camera, &pose, channels as usize)?;
    let beside =
        if with_cpu { on_the_cpu(&scene, &camera, &pose, channels as usize)? } else { BTreeMap::new() };
    Ok(timed
        .into_iter()
        .map(|row| {
            let mut numbers = BTreeMap::from([("ms".to_owned(), row.ms)]);
            if row.floor_ms > 0.0 {
                numbers.insert("floor_ms".into(), row.floor_ms);
                numbers.insert("share".into(), row.floor_ms / row.ms);
            }
            if let Some(cpu) = beside.get(row.pass) {
                numbers.insert("cpu_ms".into(), *cpu);
                numbers.insert("ratio".into(), cpu / row.ms);
            }
            numbers.extend(counted(&row));
            numbers.extend(row.kernels.iter().map(|(kernel, ms)| (format!("{KERNEL}{kernel}"), *ms)));
            (row.pass, numbers)
        })
        .collect())
}

/// What a pass gives the device to do.
fn counted(row: &PassTime) -> [(String, f64); 8] {
    let WorkCounts { launches, passes, copies, submissions, waits, .. } = row.counts;
    let WorkCounts { uploaded_bytes, downloaded_bytes, bound_bytes, .. } = row.counts;
    let host_bytes = uploaded_bytes + downloaded_bytes;
    [
        ("launches", launches as f64),
        ("passes", passes as f64),
        ("copies", copies as f64),
        ("submissions", submissions as f64),
        ("waits", waits as f64),
        ("host_bytes", host_bytes as f64),
        ("bound_bytes", bound_bytes as f64),
        ("floor_bytes", row.floor_bytes),
    ]
    .map(|(name, number)| (name.to_owned(), number))
}

/// Milliseconds of the same passes by the CPU engine, the best of three.
fn on_the_cpu(
    splats: &Splats,
    camera: &Camera,
    pose: &Pose,
    channels: usize,
) -> Result<BTreeMap<&'static str, f64>, RasterError> {
    let engine = CpuEngine::new();
    let options = ProjectOptions { antialias: true, ..ProjectOptions::default() };
    let values = vec![0.5; splats.len() * channels];
    let values = Channels { count: channels, values: &values };
    let projected = engine.project(splats, camera, pose, &options)?;
    let rendered = projected.blend(&values)?;
    let grad = FrameGrad { image: &rendered.image, alpha: None };
    let best = |work: &mut dyn FnMut()| {
        let once = |_| {
            let began = Instant::now();
            work();
            began.elapsed().as_secs_f64() * 1e3
        };
        (0..3).map(once).fold(f64::INFINITY, f64::min)
    };
    let (mut appearance, draw) = some_appearance(camera, pose);
    let splat_embeddings = appearance.first_embeddings(&splats.means);
    let radii = vec![1.0; splats.len()];
    let eye = pose.centre().to_array();
    let sight =
        VisibleSplats { means: &splats.means, splat_embeddings: &splat_embeddings, radii: &radii, eye };
    let colours = vec![0.5; 3 * splats.len()];
    let mut networks = || {
        let light = appearance.appearance_maps(0, Some(draw));
        drop(appearance.tint(0, light.as_ref(), &sight, colours.clone()));
        drop(appearance.tint_backward(0, light.as_ref(), &sight, &colours, colours.clone(), &[]));
    };
    let case = some_feature_case(camera, channels);
    let random = &mut Random::new(3);
    let (made, image) = (case.make(random), case.image(random));
    let mut field = case.refinement(vec![0.0; channels], FIELD_WEIGHTS);
    let mut losses = || drop(field.compute_losses(&image, &made.feature_target(), &made.sampled_pixels()));
    let units = vec![vec![0.5; channels]; CLICKS];
    let queries = Queries { channels, units: &units, sharpness: 10.0 };
    let norms = vec![1.0; splats.len()];
    let mut similar = vec![0.0; splats.len()];
    // As the segmenter does it, but in one piece per thread.
    let piece = splats.len().div_ceil(rayon::current_num_threads()).max(1);
    let mut similarity = || {
        let rows = values.values.par_chunks(piece * channels).zip(norms.par_chunks(piece));
        let out = similar.par_chunks_mut(piece).zip(rows);
        out.for_each(|(out, (values, norms))| score(&queries, values, norms, out));
    };
    Ok(BTreeMap::from([
        (NETWORKS, best(&mut networks)),
        (LOSSES, best(&mut losses)),
        (SIMILARITY, best(&mut similarity)),
        ("project, sort, bin", best(&mut || drop(engine.project(splats, camera, pose, &options)))),
        ("shade", best(&mut || drop(projected.shade()))),
        ("blend", best(&mut || drop(projected.blend(&values)))),
        ("gather", best(&mut || drop(projected.gather(&rendered.image)))),
        ("backward", best(&mut || drop(projected.backward(&values, &rendered, &grad)))),
    ]))
}

/// Splats that fill a frame, of standard deviations such that as many lie on a pixel however many there are: 0.5 to 3
/// pixels where there is one for each pixel.
fn frame(count: u32, width: u32, height: u32) -> Splats {
    const DEGREE: u32 = 3;
    let (w, h) = (width as f32, height as f32);
    let mut rng = Rng::new(7, 0);
    let mut splats = filling(&mut rng, count, h / w, (w * h / count.max(1) as f32).sqrt() / w);
    splats.sh_degree = DEGREE;
    splats.sh = (0..splats.len() * splats.sh_stride()).map(|_| 0.1 * rng.range(-1.0, 1.0)).collect();
    splats
}
