//! Cost of the appearance models on a scene: wall and CPU time of a training step, and of a render in a photo's light that is
//! computed once, against a render without an appearance model.
//!
//! `appearance_cost SCENE [--steps N] [--size PX]`. The trainings take turns step by step, so that whatever else the machine does
//! falls on all of them. CPU time is read from Linux's /proc.

use segwild_raster::{Channels, CpuEngine, Rasterizer};
use segwild_scene::{Scene, SceneError, SceneSettings};
use segwild_trainer::{AppearanceModel, TrainPhoto, TrainSettings, Trainer, render_lit};
use std::error::Error;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

/// CPU time of this process in ms, all threads.
fn cpu() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("Linux");
    let fields: Vec<&str> = stat.rsplit(')').next().expect("a name").split_whitespace().collect();
    let ticks = |i: usize| fields[i].parse::<f64>().expect("a number");
    10.0 * (ticks(11) + ticks(12))
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let path = PathBuf::from(args.next().ok_or("usage: appearance_cost SCENE [--steps N] [--size PX]")?);
    let (mut steps, mut open) = (200u32, SceneSettings { size: 320, ..SceneSettings::default() });
    while let (Some(flag), Some(value)) = (args.next(), args.next()) {
        match flag.as_str() {
            "--steps" => steps = value.parse()?,
            "--size" => open.size = value.parse()?,
            _ => return Err(format!("unknown flag {flag}").into()),
        }
    }
    let scene = Arc::new(Scene::open(&path, &open)?);
    let (of, size) = (scene.clone(), open.size);
    let photos = Arc::new(move |i: usize| -> Result<TrainPhoto, SceneError> {
        let photo = of.views[i].load(size)?;
        Ok(TrainPhoto { image: photo.image, valid: photo.valid, sky: None, transients: None })
    });
    let engine = Arc::new(CpuEngine::new());
    let appearances =
        [AppearanceModel::None, AppearanceModel::Affine, AppearanceModel::Embed, AppearanceModel::Gsw];
    let mut trainers = Vec::new();
    for appearance in appearances {
        let settings = TrainSettings { appearance_model: appearance, steps, ..TrainSettings::default() };
        let trainer = Trainer::new(engine.clone(), &scene, photos.clone(), settings)?;
        trainers.push((appearance, trainer, [0.0; 2], 0));
    }
    for step in 0..steps {
        for (_, trainer, spent, splats) in &mut trainers {
            let (began, clock) = (cpu(), Instant::now());
            let report = trainer.step()?;
            // At full size, as most of the time goes there.
            if step >= steps / 2 {
                spent[0] += 1e3 * clock.elapsed().as_secs_f64();
                spent[1] += cpu() - began;
                *splats = report.splats;
            }
        }
    }
    for (appearance, _, spent, splats) in &trainers {
        let [wall, cpu] = spent.map(|ms| ms / f64::from(steps - steps / 2));
        println!("{appearance}: {wall:.1} ms a step, {cpu:.1} ms CPU, {splats} splats");
    }
    const RENDERS: usize = 200;
    for (appearance, trainer, ..) in &mut trainers {
        let model = trainer.snapshot()?;
        let view = *model.trained_on.first().ok_or("no photo was trained on")? as usize;
        let (camera, pose) = (scene.views[view].camera.scaled_to(size), scene.views[view].pose);
        let began = cpu();
        let lighting = model.light(Some(view)).into();
        let made = cpu() - began;
        let began = cpu();
        for _ in 0..RENDERS {
            let projected = engine.project(&model.splats, &camera, &pose, &model.options())?;
            projected.blend(&Channels { count: 3, values: &projected.shade() }).unwrap();
        }
        let plain = (cpu() - began) / RENDERS as f64;
        let began = cpu();
        for _ in 0..RENDERS {
            render_lit(&model, &*engine, &camera, &pose, &lighting)?;
        }
        let lit = (cpu() - began) / RENDERS as f64;
        println!(
            "{appearance}: a photo's light is computed in {made:.0} ms CPU; plain render {plain:.2} ms, in that light {lit:.2} ms"
        );
    }
    Ok(())
}
