//! What the trained geometry allows: the truth of every photo is lifted to the splats and rendered again, so that
//! only the splats stand between the result and the truth. Prints a line per object.
//!
//! `cargo run -p segwild-eval --example ceiling -- DIR [seed=1] [pixels=320] [photos=60] [occlusion=0.1] [light=mixed] [points=4000] [SETTING=VALUE ...]`;
//! what `segwild bench --out DIR` left there with the same settings is not made again.

use segwild_eval::metrics;
use segwild_eval::oracle::OracleOptions;
use segwild_eval::trial::{ProviderKind, Trial};
use segwild_pipeline::{RunOptions, Settings, run};
use segwild_raster::{Channels, CpuEngine, Rasterizer};
use segwild_scene::{Mask, SceneError};
use segwild_segmenter::coverage::{coverage, soft, unoccluded};
use segwild_segmenter::{Evidence, MaskMode, Vote, owned};
use segwild_synthetic::{ObjectKind, SyntheticOptions};
use segwild_trainer::{Protocol, TrainPhoto, evaluate};
use std::sync::Arc;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut given = std::env::args().skip(1);
    let dir = given.next().ok_or("where to? the first argument is a folder")?;
    let mut options = SyntheticOptions::default();
    let mut settings = vec![("preset".to_owned(), "draft".to_owned())];
    for pair in given {
        let (name, value) = pair.split_once('=').ok_or("settings are NAME=VALUE")?;
        match name {
            "seed" => options.seed = value.parse()?,
            "pixels" => options.long_side = value.parse()?,
            "photos" => options.train = value.parse()?,
            "points" => options.points = value.parse()?,
            "light" => options.photo_light = segwild_scene::settings::Value::read(value)?,
            "occlusion" => options.occlusion = value.parse()?,
            _ => settings.push((name.to_owned(), value.to_owned())),
        }
    }
    options.test = options.train.div_ceil(5);
    let settings = Settings::layered(None, &settings)?;
    let dir = std::path::Path::new(&dir).join(format!("seed-{}", options.seed));
    let trial = Trial::new(&dir, &options, ProviderKind::Oracle, &OracleOptions::default())?;
    let began = std::time::Instant::now();
    // The masks wait for no one here: geometry alone is trained, then its scores on the held-out photos.
    let providers = Some(trial.providers(&settings)?);
    let run_options =
        RunOptions { until: segwild_pipeline::Until::stage("geometry"), providers, ..RunOptions::default() };
    let summary = run(&dir.join("scene"), trial.folder(), &settings, &run_options)?;
    println!("trained in {:.0} s, {:?}", began.elapsed().as_secs_f64(), summary.train_fit);
    let pixels = options.long_side;
    let loaded = trial.folder().load()?;
    let (model, scene) = (&loaded.model, &loaded.scene);
    let engine = CpuEngine::default();
    let options = model.options();
    let objects: Vec<_> = trial.manifest().objects.iter().filter(|o| o.kind == ObjectKind::Object).collect();
    let mut evidence: Vec<Evidence> = objects.iter().map(|_| Evidence::none(model.splats.len())).collect();
    let truth =
        |name: &str| trial.scene().photos.iter().find(|p| p.name == name).expect("a photo of the set");
    for view in scene.views.iter().filter(|v| !v.test) {
        let projected = engine.project(&model.splats, &view.camera, &view.pose, &options)?;
        let whole = unoccluded(&model.splats, &view.camera, &view.pose, &options);
        let (w, h) = (view.camera.width, view.camera.height);
        let ones = vec![1.0; (w * h) as usize];
        for (object, evidence) in objects.iter().zip(&mut evidence) {
            let inside = soft(&truth(&view.name).mask(object.id), w, h);
            evidence.add(&coverage(&*projected, &whole, &inside, &ones, (w, h), Vote::View)?, 1.0);
        }
    }
    let labels = trial.scene().label(&scene.frame, &model.splats.means);
    println!("{} splats, PSNR {:?}", model.splats.len(), model.stats.psnr);
    let source = Arc::new(loaded.scene.clone());
    let skies: Vec<Mask> = scene.views.iter().map(|v| truth(&v.name).sky()).collect();
    let photos = Arc::new(move |view: usize| -> Result<TrainPhoto, SceneError> {
        let loaded = source.views[view].load(pixels)?;
        Ok(TrainPhoto {
            image: loaded.image,
            valid: loaded.valid,
            sky: Some(skies[view].clone()),
            transients: None,
        })
    });
    let test: Vec<usize> = (0..scene.views.len()).filter(|&i| scene.views[i].test).collect();
    let held_out = evaluate(model, &engine, scene, photos, &test, Protocol::Halves, None)?;
    println!("held out, right halves: PSNR {:.2} SSIM {:.3}", held_out.psnr, held_out.ssim);
    println!(
        "object photos | lifted hard | lifted soft | nearest surface | hard by area <300 <1000 <4000 more | 3D"
    );
    let mut means = [0.0; 3];
    for (object, evidence) in objects.iter().zip(&evidence) {
        let rho: Vec<f32> = (0..labels.len()).map(|i| evidence.rho(i).unwrap_or(0.0)).collect();
        let hard: Vec<f32> = rho.iter().map(|r| f32::from(u8::from(*r > 0.5))).collect();
        let surface: Vec<f32> = labels.iter().map(|l| f32::from(u8::from(*l == object.id))).collect();
        let mut sums = [0.0; 3];
        let mut area = [(0.0, 0); 4];
        let mut count = 0;
        for view in &scene.views {
            let photo = truth(&view.name);
            let mask = photo.mask(object.id);
            if mask.count() * 1000 < photo.instances.len() {
                continue;
            }
            count += 1;
            let full = &view.camera;
            let projected =
                engine.project(&model.splats, &full.scaled_to(pixels * 2), &view.pose, &options)?;
            for (k, indicator) in [&hard, &rho, &surface].into_iter().enumerate() {
                let frame = projected.blend(&Channels { count: 1, values: indicator })?;
                let rendered = owned(&frame.image, MaskMode::Visible, (full.width, full.height));
                let iou = metrics::score(&rendered, &mask, None)?.iou;
                sums[k] += iou;
                if k == 0 {
                    let bin =
                        [300, 1000, 4000, usize::MAX].iter().position(|&a| mask.count() < a).unwrap_or(3);
                    area[bin].0 += iou;
                    area[bin].1 += 1;
                }
            }
        }
        let selected: Vec<bool> = hard.iter().map(|h| *h > 0.5).collect();
        let label = metrics::label_iou(&selected, &labels, object.id, |i| f64::from(model.splats.opacity(i)));
        let s = sums.map(|s| s / f64::from(count));
        means.iter_mut().zip(s).for_each(|(m, s)| *m += s / objects.len() as f64);
        let areas: Vec<String> =
            area.iter().map(|(s, n)| format!("{:.2}x{n}", s / f64::from((*n).max(1)))).collect();
        println!(
            "{:>16} {count:3} | {:.3} | {:.3} | {:.3} | {} | {label:.3}",
            object.name,
            s[0],
            s[1],
            s[2],
            areas.join(" ")
        );
    }
    println!("{:>16}     | {:.3} | {:.3} | {:.3}", "mean", means[0], means[1], means[2]);
    Ok(())
}
