//! The kernels alone: a frame full of small splats.

use super::axes::PROTOCOL;
use crate::page::PageError;
use glam::Vec3;
use segwild_eval::record::Record;
use segwild_flow::cpu;
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, Pose, Splats};
use segwild_synthetic::random::Rng;
use std::collections::BTreeMap;
use std::time::Instant;

/// Least seconds over which a pass is repeated: processor time is counted in steps of 10 ms.
const LEAST: f64 = 0.3;

/// How fast this machine is now: CPU milliseconds to render and differentiate a frame. What else runs on the host makes
/// the same work take up to twice as long from one minute to the next.
pub(crate) fn pace() -> Result<f64, PageError> {
    let (splats, colours) = frame(20_000, 3);
    let (camera, pose, options) = (camera(400), pose(), ProjectOptions::default());
    let engine = CpuEngine::new();
    let channels = Channels { count: 3, values: &colours };
    let step = || -> Result<(), PageError> {
        let projected = engine.project(&splats, &camera, &pose, &options)?;
        let frame = projected.blend(&channels)?;
        drop(projected.backward(
            &channels,
            &frame,
            &FrameGrad { image: &frame.image, alpha: Some(&frame.alpha) },
        )?);
        Ok(())
    };
    step()?;
    Ok(timed(|| step().unwrap_or_default()))
}

fn camera(width: u32) -> Camera {
    let height = width * 3 / 4;
    let (w, h) = (width as f32, height as f32);
    Camera { width, height, fx: w, fy: w, cx: w / 2.0, cy: h / 2.0 }
}

fn pose() -> Pose {
    Pose::look_at(Vec3::ZERO, Vec3::Z, Vec3::NEG_Y)
}

/// CPU milliseconds of each pass over `splats` splats of 0.5 to 3 px (at a width of 400) that fill a frame.
pub(super) fn measure(
    axis: &str,
    size: u32,
    splats: u32,
    width: u32,
    channels: u32,
) -> Result<Record, PageError> {
    let (scene, values) = frame(splats, channels);
    let (camera, pose) = (camera(width), pose());
    let options = ProjectOptions::default();
    let engine = CpuEngine::new();
    let mut numbers = BTreeMap::new();
    let project = timed(|| drop(engine.project(&scene, &camera, &pose, &options)));
    let projected = engine.project(&scene, &camera, &pose, &options)?;
    let channels = Channels { count: channels as usize, values: &values };
    let forward = timed(|| drop(projected.blend(&channels)));
    let frame = projected.blend(&channels)?;
    let grad = FrameGrad { image: &frame.image, alpha: Some(&frame.alpha) };
    let backward = timed(|| drop(projected.backward(&channels, &frame, &grad)));
    let gather = timed(|| drop(projected.gather(&frame.image)));
    for (name, ms) in
        [("project_ms", project), ("forward_ms", forward), ("backward_ms", backward), ("gather_ms", gather)]
    {
        numbers.insert(name.to_owned(), ms);
    }
    Ok(Record {
        protocol: PROTOCOL.into(),
        scene: "kernels".into(),
        setting: axis.into(),
        at: Some(f64::from(size)),
        numbers,
        ..Record::default()
    })
}

fn frame(count: u32, channels: u32) -> (Splats, Vec<f32>) {
    let mut rng = Rng::new(7, 0);
    let splats = filling(&mut rng, count, 0.75, 1.0 / 400.0);
    (splats, (0..count * channels).map(|_| rng.unit()).collect())
}

/// Splats that fill a frame of this height over width, of one colour, with standard deviations of 0.5 to 3 times `pixel`,
/// a share of the frame's width.
pub(crate) fn filling(rng: &mut Rng, count: u32, aspect: f32, pixel: f32) -> Splats {
    let half = aspect / 2.0;
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for _ in 0..count {
        let z = rng.range(1.0, 3.0);
        splats.means.push([rng.range(-0.5, 0.5) * z, rng.range(-half, half) * z, z]);
        splats.log_scales.push([(); 3].map(|()| (rng.range(0.5, 3.0) * z * pixel).ln()));
        splats.rotations.push([(); 4].map(|()| rng.range(-0.5, 0.5)));
        splats.opacities.push(rng.range(-2.0, 2.0));
        splats.sh.extend([0.1, 0.0, -0.1]);
    }
    splats
}

/// Mean CPU milliseconds of a call, on all threads together.
fn timed(mut work: impl FnMut()) -> f64 {
    work();
    let (began, before) = (Instant::now(), cpu::process_seconds());
    let mut calls = 0;
    while calls < 3 || began.elapsed().as_secs_f64() < LEAST {
        work();
        calls += 1;
    }
    let spent = cpu::process_seconds().zip(before).map(|(after, before)| after - before);
    spent.unwrap_or_else(|| began.elapsed().as_secs_f64()).max(1e-4) * 1e3 / f64::from(calls)
}
