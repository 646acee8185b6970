//! Times the passes of both engines on the same splats:
//! `cargo run --release -p segwild-gpu --example bench_engines [-- SPLATS WIDTH CHANNELS [ADAPTER]]`.
//!
//! Prints milliseconds of wall clock (best of several) per pass, with what crosses between host and device at the
//! trait's boundary. Without an adapter's name the best that is not software is taken.

use glam::{Mat3, Vec3};
use segwild_gpu::{Choice, GpuEngine};
use segwild_raster::{Channels, CpuEngine, Engine, FrameGrad, ProjectOptions};
use segwild_scene::{Camera, Image, Pose, Random, Splats};
use std::time::Instant;

/// Splats that fill the frame at depths 1 to 3, with standard deviations of 0.5 to 3 pixels at 400 px width.
fn scene(count: usize) -> Splats {
    let mut random = Random::new(7);
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for _ in 0..count {
        let z = 1.0 + 2.0 * random.uniform();
        splats.means.push([(random.uniform() - 0.5) * z, (random.uniform() - 0.5) * 0.75 * z, z]);
        splats.log_scales.push([(); 3].map(|()| ((0.5 + 2.5 * random.uniform()) * z / 400.0).ln()));
        splats.rotations.push([(); 4].map(|()| random.uniform() - 0.5));
        splats.opacities.push(4.0 * random.uniform() - 2.0);
        splats.sh.extend([(); 3].map(|()| random.uniform() - 0.5));
    }
    splats
}

/// Best of five calls, or of as many as fit into ten seconds, in ms; the first, which compiles kernels, is not counted.
fn best(mut work: impl FnMut()) -> f64 {
    work();
    let (start, mut best) = (Instant::now(), f64::INFINITY);
    for _ in 0..5 {
        let begun = Instant::now();
        work();
        best = best.min(begun.elapsed().as_secs_f64() * 1e3);
        if start.elapsed().as_secs() >= 10 {
            break;
        }
    }
    best
}

/// Milliseconds of project, blend, gather and backward.
fn measure(engine: &dyn Engine, splats: &Splats, width: u32, channels: usize) -> [f64; 4] {
    let height = width * 3 / 4;
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: w, fy: w, cx: 0.5 * w, cy: 0.5 * h };
    let (pose, options) =
        (Pose { rotation: Mat3::IDENTITY, translation: Vec3::ZERO }, ProjectOptions::default());
    let project = || engine.project(splats, &camera, &pose, &options).expect("the engine draws it");
    let mut random = Random::new(9);
    let values: Vec<f32> = (0..splats.len() * channels).map(|_| random.uniform()).collect();
    let channels = Channels { count: channels, values: &values };
    let mut grad = Image::zeros(width as usize, height as usize, channels.count);
    grad.data.fill_with(|| random.uniform() - 0.5);
    let projected = project();
    let frame = projected.blend(&channels).unwrap();
    let grad_of = FrameGrad { image: &grad, alpha: None };
    [
        best(|| drop(project())),
        best(|| drop(projected.blend(&channels).unwrap())),
        best(|| drop(projected.gather(&grad).unwrap())),
        best(|| drop(projected.backward(&channels, &frame, &grad_of).unwrap())),
    ]
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |k: usize, default| arguments.get(k).and_then(|a| a.parse().ok()).unwrap_or(default);
    let (count, width, channels) = (number(0, 50_000), number(1, 400), number(2, 3));
    let choice = arguments.get(3).map_or(Choice::Hardware, |name| Choice::Named(name.clone()));
    let splats = scene(count);
    println!("{count} splats, {width} x {}, {channels} channels; ms", width * 3 / 4);
    println!("{:<40} {:>9} {:>9} {:>9} {:>9}", "engine", "project", "blend", "gather", "backward");
    let row = |name: &str, times: [f64; 4]| {
        println!("{name:<40} {:>9.2} {:>9.2} {:>9.2} {:>9.2}", times[0], times[1], times[2], times[3]);
    };
    let cpu = measure(&CpuEngine::new(), &splats, width as u32, channels);
    row("cpu", cpu);
    match GpuEngine::new(&choice) {
        Ok(engine) => {
            let gpu = measure(&engine, &splats, width as u32, channels);
            row(&engine.adapter().name, gpu);
            row("cpu / gpu", std::array::from_fn(|k| cpu[k] / gpu[k]));
        }
        Err(error) => println!("no accelerator is measured: {error}"),
    }
}
