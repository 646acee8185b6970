//! Trains a scene folder and scores its held-out photos.
//!
//! `train_scene SCENE [--out DIR] [--preset draft|standard|best] [--sky DIR] [--SETTING VALUE]...` with the
//! settings of the groups `train` and `scene` as flags. Prints quality, splats and time; writes renders
//! beside photos when `--out` is given. `--sky` names a folder of masks, `STEM.png`, white = sky; `builtin`
//! finds the sky itself.

use segwild_raster::CpuEngine;
use segwild_scene::settings::{Group, Value};
use segwild_scene::{Image, Mask, ReaderError, Scene, SceneSettings};
use segwild_trainer::{Preset, Protocol, TrainPhoto, Trainer, evaluate, render_view};
use segwild_vision::{Builtin, SkyDetector};
use std::path::PathBuf;
use std::sync::Arc;

fn main() -> Result<(), ReaderError> {
    let mut args = std::env::args().skip(1);
    let path = PathBuf::from(args.next().ok_or("usage: train_scene SCENE [--out DIR] [--SETTING VALUE]...")?);
    let (mut out, mut sky_dir) = (None::<PathBuf>, None::<PathBuf>);
    let mut open = SceneSettings { size: 320, ..SceneSettings::default() };
    let mut train = Preset::Standard.settings();
    while let Some(flag) = args.next() {
        let name = flag.trim_start_matches("--").replace('-', "_");
        let value = args.next().ok_or_else(|| format!("{flag} needs a value"))?;
        match name.as_str() {
            "out" => out = Some(value.into()),
            "sky" => sky_dir = Some(value.into()),
            "preset" => train = Preset::read(&value)?.settings(),
            _ if open.get(&name).is_some() => open.set(&name, &value)?,
            _ => train.set(&name, &value)?,
        }
    }
    let started = std::time::Instant::now();
    let mut scene = Scene::open(&path, &open)?;
    if scene.views.iter().all(|v| !v.test) {
        // No split: hold out every eighth photo, as is usual.
        scene.views.iter_mut().step_by(8).for_each(|v| v.test = true);
    }
    let scene = Arc::new(scene);
    let (of, size) = (scene.clone(), open.size);
    let finder = Builtin::new();
    let photos = Arc::new(move |i: usize| -> Result<TrainPhoto, ReaderError> {
        let view = &of.views[i];
        let photo = view.load(size)?;
        let sky = match &sky_dir {
            Some(dir) if dir.as_os_str() == "builtin" => Some(finder.sky(&photo.image)?),
            Some(dir) => {
                let stem = PathBuf::from(&view.name).file_stem().expect("a file name").to_owned();
                let mask = Mask::read_png(&dir.join(stem).with_extension("png"))?;
                Some(mask.resized(photo.camera.width, photo.camera.height))
            }
            None => None,
        };
        Ok(TrainPhoto { image: photo.image, valid: photo.valid, sky, transients: None })
    });
    let fits = train.appearance_model != segwild_trainer::AppearanceModel::None;
    let engine = Arc::new(CpuEngine::new());
    let mut trainer = Trainer::prepared(engine.clone(), &scene, photos.clone(), train, &|_| false)?;
    for warning in trainer.warnings() {
        println!("warning: {warning}");
    }
    let every = (trainer.settings().steps / 20).max(1);
    let (mut sum, mut count, mut left_out) = (0.0, 0.0, 0.0);
    while !trainer.is_done() {
        let report = trainer.step()?;
        sum += report.psnr;
        left_out += report.left_out;
        count += 1.0;
        if let Some(note) = report.change.and_then(|c| c.note) {
            println!("{note}");
        }
        if report.step % every == 0 {
            println!(
                "{:6} {:3}x{:3} {:6} splats  train {:.2} dB  {:.1} % left out  {:.1} s",
                report.step,
                report.size.0,
                report.size.1,
                report.splats,
                sum / count,
                100.0 * left_out / count,
                started.elapsed().as_secs_f32()
            );
            (sum, count, left_out) = (0.0, 0.0, 0.0);
        }
    }
    for skipped in trainer.skipped() {
        println!("skipped {}: {}", skipped.name, skipped.reason);
    }
    let model = trainer.snapshot()?;
    let held_out: Vec<usize> = (0..scene.views.len()).filter(|&i| scene.views[i].test).collect();
    let protocol = if fits { Protocol::Halves } else { Protocol::Plain };
    let score = evaluate(&model, engine.as_ref(), &scene, photos.clone(), &held_out, protocol, None)?;
    for view in &score.views {
        println!("held out {}: {:.2} dB, SSIM {:.3}", view.name, view.psnr, view.ssim);
    }
    println!(
        "mean {:.3} dB, SSIM {:.4}, {} splats, {:.1} s",
        score.psnr,
        score.ssim,
        model.splats.len(),
        started.elapsed().as_secs_f32()
    );
    if let Some(dir) = out {
        std::fs::create_dir_all(&dir)?;
        segwild_scene::ply::write(&dir.join("splats.ply"), &model.splats)?;
        for (i, view) in scene.views.iter().enumerate() {
            let photo = (*photos)(i)?;
            let camera = view.camera.resized(photo.image.width as u32, photo.image.height as u32);
            let own = match held_out.iter().position(|&h| h == i) {
                Some(k) => score.renders[k].clone(),
                None => render_view(&model, engine.as_ref(), &camera, &view.pose, Some(i))?,
            };
            let mean = render_view(&model, engine.as_ref(), &camera, &view.pose, None)?;
            let name = format!("{i:02}{}.png", if view.test { "_held_out" } else { "" });
            beside(&[&photo.image, &own, &mean]).write_png(&dir.join(name))?;
        }
    }
    Ok(())
}

/// Images of one size side by side.
fn beside(images: &[&Image]) -> Image {
    let (w, h) = (images[0].width, images[0].height);
    let mut out = Image::zeros(w * images.len(), h, 3);
    for (k, image) in images.iter().enumerate() {
        for c in 0..3 {
            for y in 0..h {
                let from = &image.plane(c)[y * w..(y + 1) * w];
                let start = y * w * images.len() + k * w;
                out.plane_mut(c)[start..start + w].copy_from_slice(from);
            }
        }
    }
    out
}
