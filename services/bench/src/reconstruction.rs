//! How well scenes are reconstructed: every photo held out is scored whole, and shown beside its render (method, section 10).

use crate::contact_sheet::contact_sheet;
use crate::page::{PageError, io};
use crate::point::{PointError, name_of};
use segwild_eval::metrics::psnr;
use segwild_eval::protocols::folder::objects;
use segwild_eval::record::{LPIPS_COLUMNS, Provenance, Record, Results, means};
use segwild_eval::stamp;
use segwild_eval::trial::TrialError;
use segwild_flow::{cpu, files};
use segwild_pipeline::{HeldOut, RunFolder, RunOptions, Settings, Summary, Until, held_out_render, run};
use segwild_scene::{HoldOut, Image, Mask, PhotoStore, Scene, SceneSettings};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "reconstruction";
/// One photo in so many is held out where neither the scene nor the settings say which.
const HOLD_OUT: u32 = 8;

/// What to measure.
#[derive(Clone, Debug)]
pub struct ReconstructionOptions {
    /// The scenes' folders.
    pub scenes: Vec<PathBuf>,
    /// Long sides of the photos, in pixels.
    pub sizes: Vec<u32>,
    /// Seeds of the trainings.
    pub seeds: Vec<u64>,
    /// Folder for the results, the page and its images, and for runs while they are made.
    pub out: PathBuf,
    /// The command line that makes it again.
    pub command: String,
    /// Settings of the trainings, by name.
    pub settings: Vec<(String, String)>,
}

/// Trains each scene and scores the photos held out; `report` receives each scene as it is done. A scene that cannot be
/// trained is named among what is missing.
///
/// # Errors
/// When settings are refused, a run is stopped, or a file cannot be written.
pub fn reconstruction(
    options: &ReconstructionOptions,
    mut report: impl FnMut(&[Record]),
) -> Result<Results, PageError> {
    io(&options.out, std::fs::create_dir_all(&options.out))?;
    let mut results = Results { made: Provenance::here(options.command.clone()), ..Results::default() };
    for scene in &options.scenes {
        for &size in &options.sizes {
            for &seed in &options.seeds {
                match one(options, scene, size, seed) {
                    Ok(records) => {
                        report(&records);
                        records.into_iter().for_each(|record| results.put(record));
                    }
                    Err(error @ PageError::Settings(_)) => return Err(error),
                    Err(error) => results.missing.push(format!("{} at {size} px: {error}", name_of(scene))),
                }
                results.write(&options.out.join("results.json"))?;
            }
        }
    }
    Ok(results)
}

/// The image of a scene's held-out photos.
fn image_of(scene: &str, size: f64, seed: u64) -> String {
    format!("{scene}-{size}-{seed}.png")
}

fn one(options: &ReconstructionOptions, path: &Path, size: u32, seed: u64) -> Result<Vec<Record>, PageError> {
    let failed =
        |error: segwild_pipeline::RunError| PageError::Point(PointError::Trial(TrialError::Run(error)));
    let mut changes = options.settings.clone();
    changes.push(("size".into(), size.to_string()));
    changes.push(("seed".into(), seed.to_string()));
    let mut settings = Settings::layered(None, &changes)?;
    let given = changes.iter().any(|(name, _)| name == "hold_out" || name == "split");
    if !given && !has_held_out(path, &settings) {
        settings.set("hold_out", &HOLD_OUT.to_string()).map_err(segwild_pipeline::SettingsError::from)?;
    }
    let run_path = options.out.join("runs").join(format!("{}-{size}-{seed}", name_of(path)));
    if run_path.exists() {
        io(&run_path, std::fs::remove_dir_all(&run_path))?;
    }
    let folder = RunFolder::create(&run_path).map_err(failed)?;
    let run_options = RunOptions { until: Until::stage("evaluate"), ..RunOptions::default() };
    let (before, began) = (cpu::process_seconds(), Instant::now());
    let Summary { photos, held_out, train_fit, splats, provider, .. } =
        run(path, &folder, &settings, &run_options).map_err(failed)?;
    let cpu_s = cpu::process_seconds().zip(before).map(|(after, before)| after - before);
    let loaded = folder.load().map_err(failed)?;
    let held_out = held_out.unwrap_or_else(|| HeldOut {
        protocol: String::new(),
        psnr: f32::NAN,
        ssim: f32::NAN,
        lpips: None,
        lpips_net: None,
        kept_psnr: f32::NAN,
        left_out: f32::NAN,
        photos: Vec::new(),
    });
    let record = |target: &str, numbers: &[(&str, f64)]| Record {
        protocol: PROTOCOL.into(),
        scene: name_of(path),
        setting: "default".into(),
        // Masks of transients and of the sky take part.
        provider: provider.clone(),
        at: Some(f64::from(size)),
        target: target.into(),
        seed,
        numbers: numbers.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect(),
        ..Record::default()
    };
    let fit =
        |of: fn(&segwild_pipeline::TrainFit) -> f32| train_fit.as_ref().map_or(f64::NAN, |f| of(f).into());
    let mut whole = record(
        "",
        &[
            ("kept_psnr", held_out.kept_psnr.into()),
            ("left_out", held_out.left_out.into()),
            ("train_psnr", fit(|f| f.psnr)),
            ("transient", fit(|f| f.transient)),
            ("photos", photos as f64),
            ("held_out", held_out.photos.len() as f64),
            ("splats", splats as f64),
            ("steps", f64::from(loaded.model.stats.step)),
            ("wall_s", began.elapsed().as_secs_f64()),
            ("cpu_s", cpu_s.unwrap_or(f64::NAN)),
        ],
    );
    // PSNR and SSIM, and LPIPS where its weights are given, of the photos at the size of the run.
    whole.numbers.extend(held_out.numbers());
    whole.notes.push(held_out.protocol.clone());
    let mut records = vec![whole];
    // Each photo is read once: none is kept.
    let store = PhotoStore::new(Arc::new(loaded.scene), loaded.settings.scene.size, 0);
    let shown = shown(&folder, &store, &held_out);
    for (object, score) in in_boxes(path, store.scene(), &shown) {
        records.push(record(&object, &[("psnr", score)]));
    }
    let image = options.out.join(image_of(&name_of(path), f64::from(size), seed));
    if !shown.is_empty() {
        let pairs: Vec<[&Image; 2]> = shown.iter().map(|s| [&s.photo, &s.render]).collect();
        contact_sheet(&pairs)
            .write_png(&image)
            .map_err(|e| PageError::Io { path: image.clone(), source: std::io::Error::other(e) })?;
    }
    drop(folder);
    io(&run_path, std::fs::remove_dir_all(&run_path))?;
    Ok(records)
}

/// Whether the scene says itself which photos are held out.
fn has_held_out(path: &Path, settings: &Settings) -> bool {
    let settings = SceneSettings { hold_out: HoldOut::None, ..settings.scene.clone() };
    Scene::open(path, &settings).is_ok_and(|scene| scene.views.iter().any(|v| v.test))
}

/// A held-out photo with its render.
struct Shown {
    view: usize,
    photo: Image,
    render: Image,
}

fn shown(folder: &RunFolder, store: &PhotoStore, held_out: &HeldOut) -> Vec<Shown> {
    let mut all = Vec::new();
    for score in &held_out.photos {
        let Some(view) = store.scene().views.iter().position(|v| v.name == score.photo) else { continue };
        let Ok(file) = held_out_render(folder, &score.photo) else { continue };
        if let (Ok(photo), Ok(render)) = (store.read(view), Image::read(&file)) {
            all.push(Shown { view, photo: Arc::unwrap_or_clone(photo).image, render });
        }
    }
    all
}

/// Per object with true masks, the PSNR in dB inside the box around it, over the held-out photos that show it.
fn in_boxes(path: &Path, scene: &Scene, shown: &[Shown]) -> Vec<(String, f64)> {
    let photos: Vec<String> = scene.views.iter().map(|v| v.name.clone()).collect();
    // A scene without true masks has no objects to look at.
    let Ok(objects) = objects(path, &photos) else { return Vec::new() };
    let mut scores = Vec::new();
    for (object, masks) in objects {
        let mut of_object = Vec::new();
        for (photo, file) in masks {
            let Some(s) = shown.iter().find(|s| scene.views[s.view].name == photo) else { continue };
            let Ok(taken) = Mask::read_png(&file) else { continue };
            let (w, h) = (s.photo.width as u32, s.photo.height as u32);
            let mask = scene.views[s.view].mask_from_taken(taken).resized(w, h);
            if let Some(within) = box_around(&mask)
                && let Ok(score) = psnr(&s.render, &s.photo, Some(&within))
            {
                of_object.push(score);
            }
        }
        if !of_object.is_empty() {
            scores.push((object, of_object.iter().sum::<f64>() / of_object.len() as f64));
        }
    }
    scores
}

/// The smallest upright box that holds a mask; `None` for an empty one.
fn box_around(mask: &Mask) -> Option<Mask> {
    let mut pixels = mask.pixels();
    let (x, y) = pixels.next()?;
    let (left, top, right, bottom) = pixels.fold((x, y, x, y), |(left, top, right, bottom), (x, y)| {
        (left.min(x), top.min(y), right.max(x), bottom.max(y))
    });
    Some(Mask::from_fn(mask.width(), mask.height(), |x, y| {
        (left..=right).contains(&x) && (top..=bottom).contains(&y)
    }))
}

/// The page in Markdown; `images` says whether its images lie beside it.
pub fn markdown(results: &Results, images: bool) -> String {
    let by = stamp::providers([results]);
    let mut text = format!(
        "# {}\n\nThis page is generated. {}\n\nPhotos that took no part in the training are rendered and compared. `held out` counts every pixel of \
         them; `kept` leaves out what contradicts the scene, in photos that may show transients, and the share of that is beside it. `training photos` \
         counts every pixel that is not sky; `transient` is the share of them that was taken for transients.\n",
        stamp::title("Reconstruction", &by),
        stamp::stamp(&results.made, &by),
    );
    let measured = |name: &str| results.records.iter().any(|r| r.numbers.contains_key(name));
    let lpips: Vec<(&str, &str)> = LPIPS_COLUMNS.into_iter().filter(|(name, _)| measured(name)).collect();
    let lpips_heads: String = lpips.iter().map(|(_, words)| format!(" {words} |")).collect();
    let lpips_rules = "---:|".repeat(lpips.len());
    if !lpips.is_empty() {
        text += "\nLPIPS scores the same parts of the photos as PSNR, at the size that the heading names; less is better.\n";
    }
    let mut sizes: Vec<f64> = results.records.iter().filter_map(|r| r.at).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.dedup();
    for size in sizes {
        let of_size: Vec<&Record> = results.records.iter().filter(|r| r.at == Some(size)).collect();
        let _ = write!(
            text,
            "\n## {size} px\n\n| scene | photos | held out: dB | SSIM |{lpips_heads} kept: dB | left out % | training photos: dB | transient % | splats | steps | CPU s | scored |\n\
             |---|---:|---:|---:|{lpips_rules}---:|---:|---:|---:|---:|---:|---:|---|\n"
        );
        let mut scenes: Vec<&str> = Vec::new();
        of_size.iter().for_each(|r| {
            if !scenes.contains(&r.scene.as_str()) {
                scenes.push(&r.scene);
            }
        });
        let mean = |scene: &str, target: &str| {
            let some: Vec<&Record> =
                of_size.iter().copied().filter(|r| r.scene == scene && r.target == target).collect();
            (means(&some), some)
        };
        for scene in &scenes {
            let (numbers, some) = mean(scene, "");
            let of = |name: &str| numbers.get(name).copied().unwrap_or(f64::NAN);
            let cell = |name: &str, factor: f64, digits: usize| match numbers.get(name) {
                Some(value) => format!("{:.digits$}", factor * value),
                None => "-".into(),
            };
            let of_lpips: String =
                lpips.iter().map(|(name, _)| format!(" {} |", cell(name, 1.0, 3))).collect();
            let _ = writeln!(
                text,
                "| {scene} | {:.0} + {:.0} | {} | {} |{of_lpips} {} | {} | {} | {} | {} | {} | {} | {} |",
                of("photos") - of("held_out"),
                of("held_out"),
                cell("psnr", 1.0, 2),
                cell("ssim", 1.0, 3),
                cell("kept_psnr", 1.0, 2),
                cell("left_out", 100.0, 1),
                cell("train_psnr", 1.0, 2),
                cell("transient", 100.0, 1),
                cell("splats", 1.0, 0),
                cell("steps", 1.0, 0),
                cell("cpu_s", 1.0, 0),
                some.first().and_then(|r| r.notes.first()).map_or("", String::as_str),
            );
        }
        let objects: Vec<&&Record> = of_size.iter().filter(|r| !r.target.is_empty()).collect();
        if !objects.is_empty() {
            text += "\nInside the box around an object, over the held-out photos that show it:\n\n| scene | object | dB |\n|---|---|---:|\n";
            let mut seen: Vec<(&str, &str)> = Vec::new();
            for r in objects {
                if !seen.contains(&(r.scene.as_str(), r.target.as_str())) {
                    seen.push((&r.scene, &r.target));
                    let score = mean(&r.scene, &r.target).0.get("psnr").copied().unwrap_or(f64::NAN);
                    let _ = writeln!(text, "| {} | {} | {score:.2} |", r.scene, r.target);
                }
            }
        }
        if images {
            for r in of_size.iter().filter(|r| r.target.is_empty()) {
                let _ = write!(
                    text,
                    "\n### {}, seed {}\n\n![photos held out, each beside its render]({})\n",
                    r.scene,
                    r.seed,
                    image_of(&r.scene, size, r.seed)
                );
            }
        }
    }
    for what in &results.missing {
        let _ = writeln!(text, "\nNot measured: {what}.");
    }
    text
}

/// Writes the page with its images into the folder, and without them to `page`, if that is given: images show photos,
/// which may not be passed on.
///
/// # Errors
/// When a file cannot be written.
pub fn write(out: &Path, page: Option<&Path>, results: &Results) -> Result<PathBuf, PageError> {
    let file = out.join("reconstruction.md");
    let put =
        |file: &Path, text: String| io(file, files::write_plain(file, text).map_err(std::io::Error::other));
    put(&file, markdown(results, true))?;
    if let Some(page) = page {
        put(page, markdown(results, false))?;
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_holds_a_mask_and_no_more() {
        let mask = Mask::from_fn(10, 8, |x, y| (x, y) == (2, 3) || (x, y) == (5, 4));
        let within = box_around(&mask).expect("it is not empty");
        assert_eq!(
            (within.count(), within.get(2, 3), within.get(5, 4), within.get(6, 4)),
            (8, true, true, false)
        );
        assert!(box_around(&Mask::empty(10, 8)).is_none());
    }

    #[test]
    fn a_page_says_what_was_left_out_and_what_was_not_measured() {
        let numbers = [("psnr", 20.123), ("left_out", 0.051), ("photos", 20.0), ("held_out", 3.0)];
        let record = |target: &str| Record {
            protocol: PROTOCOL.into(),
            scene: "trevi".into(),
            at: Some(320.0),
            target: target.into(),
            seed: 1,
            numbers: numbers.iter().map(|(n, v)| ((*n).to_owned(), *v)).collect(),
            notes: vec!["whole photo".into()],
            ..Record::default()
        };
        let mut results = Results {
            records: vec![record(""), record("horse")],
            missing: vec!["fern at 320 px: it is not there".into()],
            ..Results::default()
        };
        let unmeasured = markdown(&results, true);
        assert!(
            unmeasured.contains("| trevi | 17 + 3 | 20.12 | - | - | 5.1 |") && !unmeasured.contains("LPIPS")
        );
        results.records[0].numbers.insert("lpips_alex".into(), 0.2134);
        let text = markdown(&results, true);
        for words in [
            "| trevi | 17 + 3 | 20.12 | - | 0.213 | - | 5.1 |",
            "| SSIM | LPIPS (alex) | kept: dB |",
            "| trevi | horse | 20.12 |",
            "trevi-320-1.png",
            "Not measured: fern",
        ] {
            assert!(text.contains(words), "{words}\n{text}");
        }
        assert!(!markdown(&results, false).contains(".png"));
    }
}
