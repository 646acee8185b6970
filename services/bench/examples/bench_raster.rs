//! Times the CPU engine: `cargo run -p segwild-bench --example bench_raster [-- quick|splats|pixels|channels]`.
//!
//! Prints milliseconds of wall clock (best of several) and of CPU per forward, backward and gather pass
//! against the number of splats, the pixels and the channels, with the slope of the log-log fit of CPU time:
//! 1 is linear. `one forward` (or another pass) repeats one pass for a profiler.

use glam::Vec3;
use segwild_objective::{Adam, photometric};
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Splats};
use std::time::Instant;

fn random(state: &mut u64) -> f32 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *state;
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((z ^ (z >> 31)) >> 40) as f32 / (1u64 << 24) as f32
}

/// Splats that fill the frame at depths 1 to 3, with standard deviations of `sizes` pixels at 400 px width.
fn scene(count: usize, sizes: (f32, f32)) -> Splats {
    let mut state = 7;
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for _ in 0..count {
        let z = 1.0 + 2.0 * random(&mut state);
        let (x, y) = (random(&mut state) - 0.5, (random(&mut state) - 0.5) * 0.75);
        splats.means.push([x * z, y * z, z]);
        let mut size = || (sizes.0 + (sizes.1 - sizes.0) * random(&mut state)) * z / 400.0;
        splats.log_scales.push([size().ln(), size().ln(), size().ln()]);
        splats.rotations.push([(); 4].map(|()| random(&mut state) - 0.5));
        splats.opacities.push(4.0 * random(&mut state) - 2.0);
        splats.sh.extend([(); 3].map(|()| random(&mut state) - 0.5));
    }
    splats
}

fn cpu_seconds() -> f64 {
    // Fields 14 and 15 of /proc/self/stat, in ticks of 1/100 s.
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks = |k: usize| fields.get(k).and_then(|f| f.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}

/// Best wall clock and mean CPU time of one call, in ms.
fn time(mut work: impl FnMut()) -> (f64, f64) {
    work();
    let (start, cpu) = (Instant::now(), cpu_seconds());
    let (mut best, mut calls) = (f64::INFINITY, 0);
    while calls < 5 || start.elapsed().as_secs_f64() < 0.5 {
        let start = Instant::now();
        work();
        best = best.min(start.elapsed().as_secs_f64() * 1e3);
        calls += 1;
    }
    (best, (cpu_seconds() - cpu) * 1e3 / f64::from(calls))
}

/// CPU milliseconds of project, forward, backward and gather.
fn measure(engine: &CpuEngine, splats: &Splats, width: u32, channels: usize) -> [f64; 4] {
    let height = width * 3 / 4;
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: w, fy: w, cx: w / 2.0, cy: h / 2.0 };
    let pose = Pose { rotation: glam::Mat3::IDENTITY, translation: Vec3::ZERO };
    let options = ProjectOptions::default();
    let mut state = 3;
    let values: Vec<f32> = (0..splats.len() * channels).map(|_| random(&mut state)).collect();
    let data: Vec<f32> =
        (0..(width * height) as usize * channels).map(|_| random(&mut state) - 0.5).collect();
    let grad = Image { width: width as usize, height: height as usize, channels, data };
    let project = || engine.project(splats, &camera, &pose, &options).expect("a scene in order");
    let input = Channels { count: channels, values: &values };
    let times = {
        let projected = project();
        let frame = projected.blend(&input).unwrap();
        if let Some(pass) = std::env::args().nth(2) {
            // One pass alone, for a profiler.
            let (mut calls, start) = (0, Instant::now());
            while start.elapsed().as_secs_f64() < 3.0 {
                match pass.as_str() {
                    "project" => drop(project()),
                    "forward" => drop(projected.blend(&input).unwrap()),
                    "gather" => drop(projected.gather(&grad).unwrap()),
                    _ => drop(
                        projected.backward(&input, &frame, &FrameGrad { image: &grad, alpha: None }).unwrap(),
                    ),
                }
                calls += 1;
            }
            println!("{pass}: {:.2} ms", start.elapsed().as_secs_f64() * 1e3 / f64::from(calls));
        }
        let forward = time(|| drop(projected.blend(&input).unwrap()));
        let backward = time(|| {
            drop(projected.backward(&input, &frame, &FrameGrad { image: &grad, alpha: None }).unwrap())
        });
        let gather = time(|| drop(projected.gather(&grad).unwrap()));
        (forward, backward, gather)
    };
    let bin = time(|| drop(project()));
    let (f, b, g) = times;
    println!(
        "{:>8} {:>6} {:>5} | {:>8.2} {:>8.2} {:>8.2} {:>8.2} | {:>8.2} {:>8.2} {:>8.2} {:>8.2}",
        splats.len(),
        width,
        channels,
        bin.0,
        f.0,
        b.0,
        g.0,
        bin.1,
        f.1,
        b.1,
        g.1
    );
    [bin.1, f.1, b.1, g.1]
}

/// One training step as a trainer takes it: project, shade, blend, loss, backward, Adam on all groups.
fn step(engine: &CpuEngine, start: &Splats, width: u32) {
    let mut splats = start.clone();
    let (height, n) = (width * 3 / 4, splats.len());
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: w, fy: w, cx: w / 2.0, cy: h / 2.0 };
    let pose = Pose { rotation: glam::Mat3::IDENTITY, translation: Vec3::ZERO };
    let options = ProjectOptions::default();
    let mut state = 5;
    let data = (0..(width * height * 3) as usize).map(|_| random(&mut state)).collect();
    let target = Image { width: width as usize, height: height as usize, channels: 3, data };
    let groups = [3, 3, 4, 1, splats.sh_stride()];
    let mut adam = groups.map(|item| Adam::new(n, item));
    let mut losses = Vec::new();
    let (wall, cpu) = time(|| {
        let projected = engine.project(&splats, &camera, &pose, &options).expect("a scene in order");
        let colours = projected.shade();
        let channels = Channels { count: 3, values: &colours };
        let frame = projected.blend(&channels).unwrap();
        let (loss, grad) = photometric(&frame.image, &target, None, 0.2);
        losses.push(loss);
        let mut grads =
            projected.backward(&channels, &frame, &FrameGrad { image: &grad, alpha: None }).unwrap();
        let by_colour = std::mem::take(&mut grads.values);
        let sh = projected.shade_backward(&by_colour, &mut grads);
        drop(projected);
        adam[0].step(splats.means.as_flattened_mut(), grads.means.as_flattened(), 1e-5);
        adam[1].step(splats.log_scales.as_flattened_mut(), grads.log_scales.as_flattened(), 1e-5);
        adam[2].step(splats.rotations.as_flattened_mut(), grads.rotations.as_flattened(), 1e-5);
        adam[3].step(&mut splats.opacities, &grads.opacities, 1e-5);
        adam[4].step(&mut splats.sh, &sh, 1e-5);
    });
    let (loss_wall, loss_cpu) = time(|| drop(photometric(&target, &target, None, 0.2)));
    println!(
        "training step, {n} splats, {width} px: {wall:.2} ms, CPU {cpu:.2} ms (loss {loss_wall:.2}, CPU {loss_cpu:.2})"
    );
}

/// Slopes of the log-log fits of CPU time, which other programs on the machine disturb less than wall clock.
fn slopes(name: &str, sizes: &[f64], rows: &[[f64; 4]]) {
    let slope = |k: usize| {
        let points: Vec<(f64, f64)> = sizes.iter().zip(rows).map(|(s, r)| (s.ln(), r[k].ln())).collect();
        let n = points.len() as f64;
        let mean = |f: fn(&(f64, f64)) -> f64| points.iter().map(f).sum::<f64>() / n;
        let (mx, my) = (mean(|p| p.0), mean(|p| p.1));
        let top: f64 = points.iter().map(|p| (p.0 - mx) * (p.1 - my)).sum();
        top / points.iter().map(|p| (p.0 - mx).powi(2)).sum::<f64>()
    };
    let [a, b, c, d] = std::array::from_fn(slope);
    println!("slope by {name}: project {a:.2}, forward {b:.2}, backward {c:.2}, gather {d:.2}\n");
}

fn main() {
    let which = std::env::args().nth(1).unwrap_or_default();
    let wanted = |name: &str| which.is_empty() || which == name;
    let engine = CpuEngine::new();
    println!("{:?}, {} threads", engine.isa(), rayon::current_num_threads());
    println!("{:>21} | {:^35} | {:^35}", "", "wall clock, ms (best)", "CPU, ms (mean)");
    println!(
        "{:>8} {:>6} {:>5} | {:>8} {:>8} {:>8} {:>8} | {:>8} {:>8} {:>8} {:>8}",
        "splats",
        "width",
        "chans",
        "project",
        "forward",
        "backward",
        "gather",
        "project",
        "forward",
        "backward",
        "gather"
    );
    let small = (0.5, 3.0);
    if which == "one" {
        measure(&engine, &scene(50_000, small), 400, 3);
        return;
    }
    if wanted("quick") {
        measure(&engine, &scene(50_000, small), 400, 3);
        measure(&engine, &scene(50_000, small), 400, 64);
        // A training step on a small scene: few, large splats.
        measure(&engine, &scene(3_000, (2.0, 12.0)), 320, 3);
        measure(&engine, &scene(20_000, (1.0, 5.0)), 320, 3);
        step(&engine, &scene(3_000, (2.0, 12.0)), 320);
        step(&engine, &scene(20_000, (1.0, 5.0)), 320);
    }
    let sweep = |name: &str, sizes: &[f64], run: &mut dyn FnMut(f64) -> [f64; 4]| {
        if wanted(name) {
            let rows: Vec<[f64; 4]> = sizes.iter().map(|&size| run(size)).collect();
            slopes(name, sizes, &rows);
        }
    };
    sweep("splats", &[1e3, 3e3, 1e4, 5e4, 2e5], &mut |n| measure(&engine, &scene(n as usize, small), 400, 3));
    let middle = scene(20_000, small);
    sweep("pixels", &[160.0, 320.0, 640.0, 1280.0].map(|w: f64| w * w * 0.75), &mut |pixels| {
        measure(&engine, &middle, (pixels / 0.75).sqrt().round() as u32, 3)
    });
    sweep("channels", &[3.0, 16.0, 32.0, 64.0, 128.0], &mut |c| measure(&engine, &middle, 400, c as usize));
}
