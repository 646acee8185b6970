//! What is seen where an object was, against the truth: the ray tracer renders the same photos without it.
//!
//! `cargo run -p segwild-eval --example without -- DIR [seed=1] [pixels=320] [photos=40] [SETTING=VALUE ...]`; it measures
//! the objects that have a selection of their name: make them with `segwild segment DIR/seed-1/run --name NAME ..`, then call it again.
//! Prints per object the PSNR in dB within its mask, where photos saw what is there and where none did, and the latter's share.

use segwild_eval::oracle::OracleOptions;
use segwild_eval::trial::{ProviderKind, Trial};
use segwild_flow::Stopper;
use segwild_pipeline::{Mode, RenderRequest, RunOptions, Settings, UNSEEN, render, run};
use segwild_scene::{Image, Mask};
use segwild_synthetic::{ObjectKind, SyntheticOptions};
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut given = std::env::args().skip(1);
    let dir = given.next().ok_or("where to? the first argument is a folder")?;
    let mut options = SyntheticOptions { train: 40, ..SyntheticOptions::default() };
    let mut settings = vec![("preset".to_owned(), "draft".to_owned())];
    for pair in given {
        let (name, value) = pair.split_once('=').ok_or("settings are NAME=VALUE")?;
        match name {
            "seed" => options.seed = value.parse()?,
            "pixels" => options.long_side = value.parse()?,
            "photos" => options.train = value.parse()?,
            _ => settings.push((name.to_owned(), value.to_owned())),
        }
    }
    options.test = 4;
    let settings = Settings::layered(None, &settings)?;
    let dir = Path::new(&dir).join(format!("seed-{}", options.seed));
    let trial = Trial::new(&dir, &options, ProviderKind::Oracle, &OracleOptions::default())?;
    let providers = Some(trial.providers(&settings)?);
    run(&dir.join("scene"), trial.folder(), &settings, &RunOptions { providers, ..RunOptions::default() })?;
    let scene = trial.scene();
    for object in trial.manifest().objects.iter().filter(|o| o.kind == ObjectKind::Object) {
        if !trial.folder().selection(&object.name).join("selection.bin").is_file() {
            continue;
        }
        let instance = scene.instance_named(&object.name).ok_or("an object of the scene")?;
        let shows = |i: usize| {
            let photo = &scene.photos[i];
            !photo.test && photo.mask(instance).minus(&photo.transients).count() > 200
        };
        let truth = scene.without(instance, shows);
        let (mut squares, mut counted, mut unseen, mut covered) = ([0.0f64; 2], [0usize; 2], 0, 0);
        for (photo, truth) in scene.photos.iter().zip(&truth) {
            let Some(truth) = truth else { continue };
            let out = dir.join("without").join(&object.name);
            let request = RenderRequest {
                photos: vec![photo.name.clone()],
                selection: Some((object.name.clone(), Mode::Without)),
                width: Some(options.long_side),
                out: Some(out.clone()),
                ..RenderRequest::default()
            };
            let rendered = render(trial.folder(), &request, &Stopper::new())?;
            let image = Image::read(&rendered[0].file)?;
            let mask = photo.mask(instance).minus(&photo.transients);
            let marked = Mask::read_png(&out.join(UNSEEN).join(&photo.name)).ok();
            for i in 0..image.pixels() {
                if !mask.index(i) {
                    continue;
                }
                covered += 1;
                let no_photo = marked.as_ref().is_some_and(|marked| marked.index(i));
                unseen += usize::from(no_photo);
                let off: f64 = (0..3).map(|c| f64::from(image.plane(c)[i] - truth.plane(c)[i]).powi(2)).sum();
                squares[usize::from(no_photo)] += off / 3.0;
                counted[usize::from(no_photo)] += 1;
            }
        }
        let db = |k: usize| -10.0 * (squares[k] / counted[k].max(1) as f64).log10();
        println!(
            "{:12} covered {covered:6}: seen {:5.2} dB, unseen {:5.2} dB ({:.1} %)",
            object.name,
            db(0),
            db(1),
            100.0 * unseen as f64 / f64::from(covered.max(1) as u32)
        );
    }
    Ok(())
}
