//! `segwild demo`

use super::run::{run_scene, tell};
use super::serve::{page_of_run, serve_args, stay};
use crate::args::{self, examples, flag, json, path_of, photo_count, pixels};
use crate::exit;
use crate::failure::Failure;
use crate::output::{print_json, print_line, print_note};
use crate::progress::{on_ctrl_c, show};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::oracle::OracleOptions;
use segwild_eval::trial::{ProviderKind, Trial};
use segwild_flow::{Events, Phase, Stopper};
use segwild_pipeline::{Mode, PhotoPrompts, Preset, RenderRequest, Settings, render};
use segwild_synthetic::{Manifest, SyntheticError, SyntheticOptions, SyntheticPlan, SyntheticScene};
use std::ops::{ControlFlow, RangeInclusive};
use std::path::{Path, PathBuf};

/// Objects that the demo selects: they stand by themselves.
const OBJECTS: [&str; 4] = ["left_pavilion", "right_pavilion", "statue_left", "statue_right"];

/// Training photos for each one that is held out.
const HELD_OUT: usize = 12;

/// Fewest and most training photos: points need two, and a set has 4000 photos at most, those that are held out included.
const PHOTOS: RangeInclusive<i64> = 2..=3600;

/// Most pixels of all photos of a whole demo. It keeps them and their truth in memory, 32 bytes a pixel, which are 2 GiB; by
/// choice.
const MOST_PIXELS: u64 = 64 << 20;

/// The set of the demo: enough photos to see every object from all sides, in the light of one season, with few visitors.
fn photos(matches: &ArgMatches) -> SyntheticOptions {
    let number = |name: &str| *matches.get_one::<u32>(name).expect("it has a default");
    let train = number("photo-count") as usize;
    SyntheticOptions {
        seed: *matches.get_one::<u64>("scene-seed").expect("it has a default"),
        train,
        test: train.div_ceil(HELD_OUT),
        long_side: number("pixels"),
        occlusion: 0.06,
        appearance_strength: 0.7,
        points: 4000,
        ..SyntheticOptions::small()
    }
}

/// Training steps: more than a draft's, since the photos are small.
const STEPS: u32 = 1500;

/// The command's arguments.
pub fn command() -> Command {
    let command = Command::new("demo")
        .about("Make a synthetic scene, run the whole job on it, leave a report and images")
        .arg(args::path("out", "Folder [default: runs/demo]"))
        .arg(
            Arg::new("scene-seed")
                .long("scene-seed")
                .value_name("N")
                .value_parser(value_parser!(u64))
                .default_value("3")
                .help("Another number makes another scene"),
        )
        .arg(photo_count("48").value_parser(value_parser!(u32).range(PHOTOS)))
        .arg(pixels("240"))
        .arg(flag("photos-only", "Only write the photos and their poses, for `segwild run`"))
        .arg(json())
        .after_help(examples(
            "segwild demo",
            "segwild demo --photos-only --photo-count 1000 --pixels 1600 --out photos/large",
        ));
    serve_args(command)
}

/// Makes a synthetic scene, runs the whole job on it, selects the objects that photos show largest, scores them.
pub fn demo(matches: &ArgMatches) -> Result<(), Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| PathBuf::from("runs/demo"));
    let json = matches.get_flag("json");
    let options = photos(matches);
    let scene_dir = out.join("scene");
    if matches.get_flag("photos-only") {
        return tell_photos(&write_photos(&options, &scene_dir, json)?, &scene_dir, json);
    }
    fits_in_memory(&options)?;
    let scene = take_photos(&options, json)?;
    let trial = Trial::of(&out, scene, ProviderKind::Builtin, &OracleOptions::default())?;
    tell_photos(trial.manifest(), &scene_dir, json)?;
    let mut settings = Settings::preset(Preset::Draft);
    settings.train.steps = STEPS;
    let run_dir = out.join("run");
    let page = page_of_run(matches, &scene_dir, &run_dir, json)?;
    let stopper = Stopper::new();
    let summary = run_scene(&scene_dir, &run_dir, &settings, None, json, stopper.clone())?;
    if !json {
        tell(&summary, &run_dir)?;
    }
    let manifest = trial.manifest();
    let named = OBJECTS.iter().filter_map(|name| manifest.objects.iter().find(|o| o.name == *name));
    let objects: Vec<_> = named.filter_map(|object| Some((object, trial.prompts(object)?))).collect();
    let session = trial.session(&settings)?;
    for (object, prompts) in objects {
        let photo = prompts.photo.clone();
        let message = in_words(&prompts);
        let score = session.score(object, prompts.clone())?;
        if json {
            let by = session.provider();
            let event =
                serde_json::json!({ "event": "object", "provider": by, "prompts": prompts, "score": score });
            print_json(&event)?;
        } else {
            print_line(&format!(
                "{}: {message} -> mean IoU {:.2} on the {} other photos that show it (masks: {})",
                object.name,
                score.iou,
                score.photos,
                session.provider()
            ))?;
        }
        if !trial.folder().selection(&object.name).join("selection.bin").is_file() {
            continue;
        }
        let request = RenderRequest {
            photos: vec![photo],
            selection: Some((object.name.clone(), Mode::Only)),
            out: Some(out.join("images").join(&object.name)),
            ..RenderRequest::default()
        };
        render(trial.folder(), &request, &stopper)?;
    }
    if !json {
        print_line(&format!("open {}", trial.folder().report().display()))?;
    }
    stay(page, &stopper);
    Ok(())
}

/// Refuses a whole demo of more pixels than it keeps in memory.
fn fits_in_memory(options: &SyntheticOptions) -> Result<(), Failure> {
    let (photos, side) = ((options.train + options.test) as u64, u64::from(options.long_side));
    // 4:3 is the squarest photo.
    let each = side * side * 3 / 4;
    if photos * each <= MOST_PIXELS {
        return Ok(());
    }
    Err(Failure::usage(format!(
        "{photos} photos of {side} px ({} of them held out) are too many for a whole demo, which keeps all of them in \
         memory: at this size the largest --photo-count is {}; or add --photos-only, and run `segwild run` on the folder",
        options.test,
        most_training_photos(MOST_PIXELS / each)
    )))
}

/// The most training photos that so many photos allow, with those that are held out beside them.
fn most_training_photos(photos: u64) -> u64 {
    let held_out = HELD_OUT as u64;
    // A photo is held out for each `HELD_OUT` training photos that are started.
    photos - photos.div_ceil(held_out + 1)
}

/// Writes the photos one by one, until Ctrl-C: two of them are in memory at a time.
fn write_photos(options: &SyntheticOptions, dir: &Path, json: bool) -> Result<Manifest, Failure> {
    let stopper = Stopper::new();
    let pressed = stopper.clone();
    on_ctrl_c(move |press| {
        if press > 1 {
            std::process::exit(exit::INTERRUPTED.into());
        }
        print_note("stopping after this photo; once more to stop at once");
        pressed.stop();
    })?;
    // Before the cameras of a large scene are sampled, which takes a while.
    std::fs::create_dir_all(dir).map_err(|e| Failure::cannot_write(dir, &e))?;
    let events = Events::new();
    let sink = show(&events, json)?;
    let plan = SyntheticPlan::new(options)?;
    let mut stage = events.stage("photos", Some(plan.photo_count() as u64));
    let mut shown = 0;
    let manifest = write_until(&plan, dir, &stopper, |written| {
        stage.advance(written as u64 - shown);
        shown = written as u64;
    })?;
    stage.finish();
    drop(sink); // everything that happened is shown before the last word
    Ok(manifest)
}

/// Writes a set until it is stopped; after each photo `report` receives how many there are. Where it was stopped before the
/// first, the folder stays as it is: it may hold another set, which [`SyntheticPlan::write`] removes.
fn write_until(
    plan: &SyntheticPlan,
    dir: &Path,
    stopper: &Stopper,
    mut report: impl FnMut(usize),
) -> Result<Manifest, SyntheticError> {
    let running = || stopper.phase() == Phase::Running;
    if !running() {
        return Err(SyntheticError::Stopped { written: 0, photos: plan.photo_count() });
    }
    plan.write(dir, |written| {
        report(written);
        if running() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    })
}

/// Takes all photos into memory.
fn take_photos(options: &SyntheticOptions, json: bool) -> Result<SyntheticScene, Failure> {
    let events = Events::new();
    let sink = show(&events, json)?;
    let plan = SyntheticPlan::new(options)?;
    let mut stage = events.stage("photos", Some(plan.photo_count() as u64));
    let photos = plan.photos().inspect(|_| stage.advance(1)).collect();
    stage.finish();
    drop(sink);
    Ok(plan.with_photos(photos))
}

/// Says where the photos are.
fn tell_photos(manifest: &Manifest, dir: &Path, json: bool) -> Result<(), Failure> {
    if json {
        return Ok(());
    }
    print_line(&format!("a synthetic scene in {} tourist photos: {}", manifest.photos.len(), dir.display()))
}

/// The prompts as the flags of `segwild segment`.
fn in_words(flags: &PhotoPrompts) -> String {
    let mut words = format!("--photo {}", flags.photo);
    for b in &flags.prompts.boxes {
        words += &format!(" --box {},{},{},{}", b.x0, b.y0, b.x1, b.y1);
    }
    for p in &flags.prompts.points {
        words += &format!(" {} {},{}", if p.inside { "--positive" } else { "--negative" }, p.x, p.y);
    }
    words
}

#[cfg(test)]
mod tests {
    use super::{HELD_OUT, command, fits_in_memory, most_training_photos, photos, write_until};
    use segwild_flow::Stopper;
    use segwild_synthetic::{Manifest, SyntheticError, SyntheticOptions, SyntheticPlan};

    #[test]
    fn the_number_and_size_of_the_photos_change_nothing_else_of_the_scene() {
        let of = |args: &[&str]| photos(&command().get_matches_from([&["demo"][..], args].concat()));
        let usual = SyntheticOptions {
            seed: 3,
            train: 48,
            test: 4,
            long_side: 240,
            occlusion: 0.06,
            appearance_strength: 0.7,
            points: 4000,
            ..SyntheticOptions::default()
        };
        assert_eq!(of(&[]), usual);
        let large = of(&["--photo-count", "1000", "--pixels", "1600"]);
        assert_eq!(large, SyntheticOptions { train: 1000, test: 84, long_side: 1600, ..usual.clone() });
        assert!(fits_in_memory(&usual).is_ok());
        let refused = fits_in_memory(&large).expect_err("60 GiB").message;
        assert!(refused.starts_with("1084 photos of 1600 px (84 of them held out)"), "{refused}");
        assert!(refused.contains("the largest --photo-count is 31;"), "{refused}");
        assert!(refused.contains("--photos-only"), "{refused}");
        // The number that it names is the largest that is accepted.
        let of_count = |count: &str| fits_in_memory(&of(&["--photo-count", count, "--pixels", "1600"]));
        assert_eq!([of_count("31").is_ok(), of_count("32").is_ok()], [true, false]);
        for photos in 2..200 {
            let most = most_training_photos(photos);
            let all = |train: u64| train + train.div_ceil(HELD_OUT as u64);
            assert!(all(most) <= photos && photos < all(most + 1), "{most} of {photos}");
        }
        for bound in ["--photo-count=2", "--photo-count=3600", "--pixels=16", "--pixels=4096"] {
            assert!(command().try_get_matches_from(["demo", bound]).is_ok(), "{bound}");
        }
    }

    #[test]
    fn a_set_that_is_stopped_before_its_first_photo_leaves_the_folder_as_it_is() {
        let of = |seed| {
            let small = SyntheticOptions { seed, long_side: 16, points: 0, ..SyntheticOptions::small() };
            SyntheticPlan::new(&SyntheticOptions { train: 2, test: 0, ..small }).expect("a set")
        };
        let dir = tempfile::tempdir().expect("a folder");
        let stopper = Stopper::new();
        let mut count = 0;
        let old =
            write_until(&of(1), dir.path(), &stopper, |written| count = written).expect("it is written");
        assert_eq!((count, old.photos.len()), (2, 2));
        stopper.stop();
        let stopped = write_until(&of(2), dir.path(), &stopper, |written| count = written);
        assert!(matches!(stopped, Err(SyntheticError::Stopped { written: 0, photos: 2 })), "{stopped:?}");
        let held = std::fs::read(dir.path().join("truth.json")).expect("the manifest stays");
        assert_eq!(serde_json::from_slice::<Manifest>(&held).expect("a manifest"), old);
        assert!(dir.path().join("sparse/0/images.bin").is_file());
        assert_eq!(count, 2);
    }
}
