//! How fast the accelerator engine is: every pass against its floor on the device, and against the CPU engine.

mod goal;

pub use goal::Goal;

use crate::page::{PageError, io};
use crate::scale::kernels::filling;
use glam::Vec3;
use rayon::prelude::*;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::stamp::{self, providers};
use segwild_flow::files;
use segwild_gpu::{
    AdapterChoice, CLICKS, FIELD_RULE, GpuEngine, LOSSES, NETWORKS, Reach, SIMILARITY, reach,
    some_appearance, some_feature_case, speed,
};
use segwild_objective::field::{Queries, score};
use segwild_objective::{Appearance, VisibleSplats};
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, RasterError, Rasterizer};
use segwild_scene::{Camera, Pose, Random, Splats};
use segwild_synthetic::random::Rng;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;
use std::time::Instant;

/// Name of the benchmark in its records.
pub const PROTOCOL: &str = "engine";

pub use segwild_gpu::STEP;

/// Before the name of a kernel whose milliseconds a record has.
const KERNEL: &str = "kernel ";
/// So many are named on the page, if they take such a share of the pass.
const NAMED: usize = 3;
const WORTH_NAMING: f64 = 0.05;

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
        put(goal::train(goal, "gpu", &name)?);
        if options.cpu {
            put(goal::train(goal, "cpu", "")?);
        }
    }
    Ok(results)
}

fn record(pass: &str, target: &str, numbers: BTreeMap<String, f64>) -> Record {
    Record {
        protocol: PROTOCOL.into(),
        setting: pass.into(),
        target: target.into(),
        numbers,
        ..Record::default()
    }
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
            numbers.extend(row.kernels.iter().map(|(kernel, ms)| (format!("{KERNEL}{kernel}"), *ms)));
            (row.pass, numbers)
        })
        .collect())
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
    let mut field = case.refining(vec![0.0; channels], FIELD_RULE);
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

/// The page in Markdown.
pub fn markdown(results: &Results) -> String {
    let made = &results.made;
    let by = providers([results]);
    let mut text = format!(
        "# The accelerator engine's speed\n\n{} This page is generated. {}\n\nEach pass is repeated and waited \
         for once; its floor is the longer of its arrays, each moved once, at the bandwidth of a copy, and its operations, at \
         every pixel of every tile that a splat touches, at the rate of a kernel that only multiplies and adds (where \
         light runs out early, less is done). The CPU's milliseconds are of wall clock on all its cores; those of kernels are by the device's own clock, all \
         runs of a kernel in the pass together.\n",
        stamp::first_sentence(&by, &[]),
        stamp::stamp(made, &by)
    );
    let number = |record: &Record, name: &str| record.numbers.get(name).copied();
    let mut targets: Vec<&str> = Vec::new();
    for record in &results.records {
        if record.setting == "reach" {
            let giga = |name| number(record, name).unwrap_or(0.0) / 1e9;
            let _ = writeln!(
                text,
                "\nA copy moves {:.1} GB/s, a multiply-add chain does {:.1} GFLOP/s.",
                giga("bytes_per_s"),
                giga("operations_per_s")
            );
            for note in &record.notes {
                let _ = writeln!(text, "\n**{note}.**");
            }
        } else if !targets.contains(&record.target.as_str()) {
            targets.push(&record.target);
        }
    }
    for target in targets {
        let _ = writeln!(text, "\n## {target}\n");
        let rows: Vec<&Record> = results.records.iter().filter(|r| r.target == target).collect();
        if let Some(refused) = rows.iter().find(|r| r.setting == "refused") {
            let _ = writeln!(text, "Refused: {}.", refused.notes.join("; "));
            continue;
        }
        if rows.iter().any(|r| r.setting.starts_with("training")) {
            trained(&mut text, &rows);
            continue;
        }
        text.push_str(
            "| pass | ms | floor, ms | share of the floor | CPU, ms | CPU / this | slowest kernels, ms |\n\
             |---|---:|---:|---:|---:|---:|---|\n",
        );
        for row in &rows {
            let cell = |name: &str, decimals: usize| {
                number(row, name).map_or(String::new(), |v| format!("{v:.decimals$}"))
            };
            let share = number(row, "share").map_or(String::new(), |v| format!("{:.1} %", 100.0 * v));
            let cells = [cell("ms", 3), cell("floor_ms", 3), share, cell("cpu_ms", 2), cell("ratio", 2)];
            let _ = writeln!(text, "| {} | {} | {} |", row.setting, cells.join(" | "), slowest(row));
        }
        let mut far: Vec<(f64, &str)> =
            rows.iter().filter_map(|r| Some((number(r, "share")?, r.setting.as_str()))).collect();
        far.sort_by(|a, b| a.0.total_cmp(&b.0));
        let far: Vec<&str> = far.iter().take(3).map(|f| f.1).collect();
        let _ = writeln!(text, "\nFurthest from their floors: {}.", far.join("; "));
        if let Some(ms) = rows.iter().find(|r| r.setting == STEP).and_then(|r| number(r, "ms")) {
            let splats =
                target.split_once(' ').and_then(|(count, _)| count.parse::<f64>().ok()).unwrap_or(0.0);
            let (steps, millions) = (1e3 / ms, 1e-3 * splats / ms);
            let _ = writeln!(text, "{steps:.1} steps a second: {millions:.3} million splats a second.");
        }
    }
    text
}

/// A pass's slowest kernels.
fn slowest(row: &Record) -> String {
    let least = WORTH_NAMING * row.numbers.get("ms").copied().unwrap_or(0.0);
    let kernels = row.numbers.iter().filter_map(|(name, &ms)| Some((name.strip_prefix(KERNEL)?, ms)));
    let mut kernels: Vec<(&str, f64)> = kernels.filter(|&(_, ms)| ms >= least).collect();
    kernels.sort_by(|a, b| b.1.total_cmp(&a.1));
    let named = kernels.iter().take(NAMED).map(|(name, ms)| format!("{name} {ms:.3}"));
    named.collect::<Vec<_>>().join(", ")
}

/// How long trainings took.
fn trained(text: &mut String, rows: &[&Record]) {
    text.push_str("| engine | seconds | steps | splats at the end | best, dB |\n|---|---:|---:|---:|---:|\n");
    for row in rows {
        let cell = |name: &str, decimals: usize| {
            row.numbers.get(name).map_or("not reached".into(), |v| format!("{v:.decimals$}"))
        };
        let cells = [cell("seconds", 1), cell("steps", 0), cell("splats", 0), cell("db", 2)];
        let engine = row.setting.trim_start_matches("training, ");
        let _ = writeln!(text, "| {engine} | {} |", cells.join(" | "));
    }
    text.push_str(
        "\nThe mean PSNR of the photos over 100 steps; one light, no transients, the default steps.\n",
    );
}

/// Writes the page.
pub fn write(page: &Path, results: &Results) -> Result<(), PageError> {
    io(page, files::write_plain(page, markdown(results)))
}
