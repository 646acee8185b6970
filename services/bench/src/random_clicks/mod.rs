//! What single clicks and boxes find, and how many corrections it takes: random clicks anywhere on the objects of scenes with
//! true masks (method, section 13).

mod answers;
mod images;
mod options;
mod page;
mod prompts;
mod reliability;
mod worst;

pub use options::ClickOptions;
pub use page::write;

use crate::page::{PageError, io};
use crate::point::name_of;
use answers::{TrueObject, failed};
use prompts::{BOX, random_box, random_pixel};
use segwild_eval::protocols::folder::objects;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_pipeline::{PhotoPrompts, RunFolder, RunOptions, Session, SessionOptions, Settings, Until, run};
use segwild_scene::{HoldOut, Mask, Prompts, Random};
use std::path::Path;

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "clicks";

/// A photo is clicked where the object covers at least one pixel in this many.
const LEAST: usize = 200;

/// Trains each scene on all photos and clicks its objects; `report` receives each click as it is scored. A scene that cannot be
/// measured is named among what is missing.
///
/// # Errors
/// When settings are refused, or a file cannot be written.
pub fn random_clicks(options: &ClickOptions, mut report: impl FnMut(&Record)) -> Result<Results, PageError> {
    io(&options.out, std::fs::create_dir_all(&options.out))?;
    let mut results = Results { made: Provenance::here(options.command.clone()), ..Results::default() };
    for scene in &options.scenes {
        for &size in &options.sizes {
            let measured = of_scene(options, scene, size, &mut |record| {
                report(&record);
                results.put(record);
            });
            match measured {
                Ok(missing) => results.missing.extend(missing),
                Err(error @ PageError::Settings(_)) => return Err(error),
                Err(error) => results.missing.push(format!("{} at {size} px: {error}", name_of(scene))),
            }
            results.write(&options.out.join("results.json"))?;
        }
    }
    Ok(results)
}

/// Measures one scene. Returns what is missing of it, in words.
fn of_scene(
    options: &ClickOptions,
    path: &Path,
    size: u32,
    put: &mut dyn FnMut(Record),
) -> Result<Vec<String>, PageError> {
    let mut changes = options.settings.clone();
    changes.push(("size".into(), size.to_string()));
    changes.push(("seed".into(), options.seed.to_string()));
    let mut settings = Settings::layered(None, &changes)?;
    settings.scene.hold_out = HoldOut::None;
    let run_path = options.out.join("runs").join(format!("{}-{size}-{}", name_of(path), options.seed));
    let folder = RunFolder::create(&run_path).map_err(failed)?;
    let run_options = RunOptions { until: Until::stage("objects"), ..RunOptions::default() };
    run(path, &folder, &settings, &run_options).map_err(failed)?;
    let session = Session::open(&folder, SessionOptions::default()).map_err(failed)?;
    let photos: Vec<String> = session.scene().views.iter().map(|v| v.name.clone()).collect();
    let mut missing = Vec::new();
    for (at, (name, truth)) in objects(path, &photos)?.into_iter().enumerate() {
        let shown: Vec<(String, Mask)> = truth
            .iter()
            .filter_map(|(photo, file)| Some((photo.clone(), Mask::read_png(file).ok()?)))
            .filter(|(_, mask)| mask.count() * LEAST >= mask.width() as usize * mask.height() as usize)
            .collect();
        let Some(masks) = truth.first().and_then(|(_, file)| file.parent()).filter(|_| !shown.is_empty())
        else {
            continue;
        };
        let object = TrueObject { masks, shown: &shown };
        let mut random = Random::stream(options.seed, at as u64);
        let mut worst: Option<(f64, PhotoPrompts)> = None;
        for click in 0..options.clicks {
            let (photo, mask) = &shown[random.below(shown.len())];
            let (prompts, note) = if options.boxes {
                let b = random_box(mask, &mut random);
                let note = format!("{photo}, box {:.0},{:.0},{:.0},{:.0}", b.x0, b.y0, b.x1, b.y1);
                (Prompts { boxes: vec![b], ..Prompts::default() }, note)
            } else {
                let [x, y] = random_pixel(mask, &mut random);
                (Prompts::click(x, y), format!("{photo} at ({x}, {y})"))
            };
            let prompts = PhotoPrompts { photo: photo.clone(), prompts };
            let numbers = object.numbers(&session, &settings, prompts.clone(), options)?;
            let iou = numbers.get("iou").copied().unwrap_or(0.0);
            if worst.as_ref().is_none_or(|(least, _)| iou < *least) {
                worst = Some((iou, prompts));
            }
            put(Record {
                protocol: PROTOCOL.into(),
                scene: name_of(path),
                setting: if options.boxes { BOX } else { "default" }.into(),
                provider: session.provider().to_owned(),
                at: Some(f64::from(size)),
                target: name.clone(),
                seed: options.seed,
                prompt: click as u32,
                numbers,
                notes: vec![note],
            });
        }
        if let Some((_, prompts)) = worst {
            let image = options.out.join(worst::image_of(&name_of(path), &name, f64::from(size)));
            // The numbers count without it.
            if let Err(error) = object.draw(&session, &settings, prompts, &image) {
                let of = format!("{} at {size} px: the image of the worst answer of {name}", name_of(path));
                missing.push(format!("{of}: {error}"));
            }
        }
    }
    drop(session);
    io(&run_path, std::fs::remove_dir_all(&run_path))?;
    Ok(missing)
}
