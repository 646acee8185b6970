//! `segwild demo`

use super::run::{run_scene, tell};
use super::serve::{page_of_run, serve_args, stay};
use crate::args::{self, examples, flag, json, path_of};
use crate::failure::Failure;
use crate::output::{print_json, print_line};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_eval::oracle::OracleOptions;
use segwild_eval::trial::{ProviderKind, Trial};
use segwild_flow::Stopper;
use segwild_pipeline::{Mode, PhotoPrompts, Preset, RenderRequest, Settings, render};
use segwild_synthetic::SyntheticOptions;
use std::path::PathBuf;

/// Objects that the demo selects: they stand by themselves.
const OBJECTS: [&str; 4] = ["left_pavilion", "right_pavilion", "statue_left", "statue_right"];

/// The set of the demo: enough photos to see every object from all sides, in the light of one season, with few visitors.
fn photos(seed: u64) -> SyntheticOptions {
    SyntheticOptions {
        seed,
        train: 48,
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
        .arg(flag("photos-only", "Only write the photos and their poses, for `segwild run`"))
        .arg(json())
        .after_help(examples("segwild demo", "segwild demo --scene-seed 7 --photos-only --out photos/seven"));
    serve_args(command)
}

/// Makes a synthetic scene, runs the whole job on it, selects the objects that photos show largest, scores them.
pub fn demo(matches: &ArgMatches) -> Result<(), Failure> {
    let out = path_of(matches, "out").unwrap_or_else(|| PathBuf::from("runs/demo"));
    let json = matches.get_flag("json");
    let seed = *matches.get_one::<u64>("scene-seed").expect("it has a default");
    let options = photos(seed);
    let trial = Trial::new(&out, &options, ProviderKind::Builtin, &OracleOptions::default())?;
    let scene_dir = out.join("scene");
    if !json {
        print_line(&format!(
            "a synthetic scene in {} tourist photos: {}",
            trial.manifest().photos.len(),
            scene_dir.display()
        ))?;
    }
    if matches.get_flag("photos-only") {
        return Ok(());
    }
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
