//! Compares the sky providers on a scene's photos with each other, with its points and with the truth.
//!
//! `compare_sky SCENE [--models DIR] [--size PX] [--truth DIR] [--object DIR] [--out DIR]`: `--truth` holds true skies,
//! `--object` masks of something that is no sky, one PNG per photo. With `--out` an image per photo: the photo, then
//! each provider's sky in blue.

use segwild_scene::{Image, Mask, Scene, SceneSettings};
use segwild_vision::{Providers, SkyChoice, VisionSettings};
use std::error::Error;
use std::path::{Path, PathBuf};

/// What one provider made of the photos.
#[derive(Default)]
struct SkyTally {
    share: f64,
    seen: (usize, usize),
    object: (usize, usize),
    truth: Vec<f64>,
    seconds: f64,
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let path = PathBuf::from(
        args.next().ok_or("usage: compare_sky SCENE [--models DIR] [--truth DIR] [--out DIR]")?,
    );
    let (mut models, mut truth, mut object, mut out) = (String::new(), None, None, None::<PathBuf>);
    let mut size = 320;
    while let Some(flag) = args.next() {
        let value = args.next().ok_or_else(|| format!("{flag} needs a value"))?;
        match flag.as_str() {
            "--models" => models = value,
            "--size" => size = value.parse()?,
            "--truth" => truth = Some(PathBuf::from(value)),
            "--object" => object = Some(PathBuf::from(value)),
            "--out" => out = Some(value.into()),
            other => return Err(format!("there is no flag {other}").into()),
        }
    }
    let scene = Scene::open(&path, &SceneSettings { size, ..SceneSettings::default() })?;
    let mut choices = vec![SkyChoice::Builtin, SkyChoice::Geometry];
    if !models.is_empty() {
        choices.extend([SkyChoice::Network, SkyChoice::Both, SkyChoice::Deeplab]);
    }
    let providers = choices
        .iter()
        .map(|&sky| {
            Providers::from_settings(&VisionSettings {
                sky,
                models: models.clone(),
                ..VisionSettings::default()
            })
        })
        .collect::<Result<Vec<_>, _>>()?;
    let mut tallies: Vec<SkyTally> = choices.iter().map(|_| SkyTally::default()).collect();
    let mut agreement = vec![vec![0.0; choices.len()]; choices.len()];
    for (index, view) in scene.views.iter().enumerate() {
        let photo = view.load(size)?;
        let (w, h) = (photo.camera.width, photo.camera.height);
        let stem = Path::new(&view.name).with_extension("png");
        let read = |dir: &Option<PathBuf>| -> Option<Mask> {
            let mask = Mask::read_png(&dir.as_ref()?.join(&stem)).ok()?;
            Some(mask.resized(w, h))
        };
        let (truth, object) = (read(&truth), read(&object));
        let mut skies = Vec::new();
        for (provider, tally) in providers.iter().zip(&mut tallies) {
            let began = std::time::Instant::now();
            // Half of the points are shown to who asks, and the others counted.
            let seen = scene.points_in(index, w as usize, h as usize);
            let shown: Vec<[f32; 2]> = seen.iter().copied().step_by(2).collect();
            let sky = provider.sky.sky_above(&photo.image, &shown)?;
            tally.seconds += began.elapsed().as_secs_f64();
            tally.share += sky.count() as f64 / f64::from(w * h);
            for at in seen.iter().skip(1).step_by(2) {
                tally.seen.1 += 1;
                tally.seen.0 += usize::from(sky.at(at[0], at[1]));
            }
            if let Some(object) = &object {
                tally.object.0 += sky.overlap(object);
                tally.object.1 += object.count();
            }
            tally.truth.extend(truth.as_ref().map(|truth| iou(&sky, truth)));
            skies.push(sky);
        }
        for a in 0..skies.len() {
            for b in 0..skies.len() {
                agreement[a][b] += iou(&skies[a], &skies[b]) / scene.views.len() as f64;
            }
        }
        if let Some(out) = &out {
            std::fs::create_dir_all(out)?;
            let mut sheet = Image::zeros(w as usize * (1 + skies.len()), h as usize, 3);
            for (k, sky) in std::iter::once(None).chain(skies.iter().map(Some)).enumerate() {
                for (x, y) in Mask::full(w, h).pixels() {
                    for c in 0..3 {
                        let v = photo.image.at(c, x as usize, y as usize);
                        let blue = sky.is_some_and(|sky| sky.get(x, y));
                        let shown = if !blue {
                            v
                        } else if c == 2 {
                            0.5 + 0.5 * v
                        } else {
                            0.3 * v
                        };
                        let at = y as usize * sheet.width + k * w as usize + x as usize;
                        sheet.plane_mut(c)[at] = shown;
                    }
                }
            }
            sheet.write_png(&out.join(stem))?;
        }
    }
    let n = scene.views.len() as f64;
    for (k, (choice, t)) in choices.iter().zip(&tallies).enumerate() {
        let percent = |(part, all): (usize, usize)| 100.0 * part as f64 / all.max(1) as f64;
        let truth = match t.truth.len() {
            0 => "-".to_owned(),
            m => format!("{:.3}", t.truth.iter().sum::<f64>() / m as f64),
        };
        let agrees: Vec<String> = agreement[k].iter().map(|a| format!("{a:.3}")).collect();
        println!(
            "{choice:8} sky {:4.1} % of the frame, {:.2} % of the points in it, {:.2} % of the object in it, IoU with the \
             truth {truth}, with [{}] {}; {:.0} ms a photo",
            100.0 * t.share / n,
            percent(t.seen),
            percent(t.object),
            choices.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "),
            agrees.join(" "),
            1e3 * t.seconds / n
        );
    }
    Ok(())
}

/// Intersection over union; two empty masks agree.
fn iou(a: &Mask, b: &Mask) -> f64 {
    if a.is_empty() && b.is_empty() { 1.0 } else { a.iou(b) }
}
