//! `segwild run`

use super::serve::{page_of_run, serve_args, stay};
use crate::args::{self, examples, flag, json, path_of, until, with_settings};
use crate::failure::Failure;
use crate::operators::{
    child_args, have_files_to_open, keep_to_cores, listen, metrics_listen, stop_with_parent, use_threads,
};
use crate::output::{print_json, print_line};
use crate::progress::{duration, show, stop_on_ctrl_c};
use clap::builder::PossibleValuesParser;
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_flow::{Events, Stopper};
use segwild_pipeline::{
    Code, DiagramFormat, RunError, RunFolder, RunOptions, Settings, StagePlan, StageVerdict, Summary, Until,
    diagram,
};
use segwild_scene::settings::Value;
use segwild_scene::{SceneError, Skipped};
use std::path::{Path, PathBuf};

/// Seconds between checkpoints where a page follows the training.
const PAGE_CHECKPOINTS: u32 = 4;

/// The command's arguments.
pub fn command() -> Command {
    let scene = Arg::new("scene")
        .value_name("SCENE")
        .required_unless_present("graph")
        .value_parser(value_parser!(PathBuf))
        .help("Folder of photos, COLMAP or Photo Tourism folder, folder with transforms.json, or video");
    child_args(serve_args(with_settings(
        Command::new("run").about("Train a scene: geometry, appearance, masks, features, report"),
    )))
    .arg(scene)
    .arg(metrics_listen().hide_short_help(true))
    .args(args::run_files())
    .arg(until("Stop after this stage or training step; a later one goes on from there"))
    .arg(flag("explain", "Only print which stages would be computed again, and why"))
    .arg(
        Arg::new("graph")
            .long("graph")
            .value_name("FORMAT")
            .num_args(0..=1)
            .default_missing_value("mermaid")
            .value_parser(PossibleValuesParser::new(DiagramFormat::CHOICES))
            .requires("explain")
            .hide_short_help(true)
            .help("With --explain: print the graph of stages"),
    )
    .arg(json())
    .after_help(examples(
        "segwild run photos/trevi --out runs/trevi",
        "segwild run photos/trevi --out runs/trevi --preset draft --hold-out 8",
    ))
}

/// Runs a scene, or what is left of it.
pub fn run(matches: &ArgMatches) -> Result<(), Failure> {
    if let Some(format) = matches.get_one::<String>("graph") {
        let format = DiagramFormat::read(format).expect("clap lets no other value through");
        return print_line(diagram(format).trim_end());
    }
    keep_to_cores(matches)?;
    have_files_to_open()?;
    let scene = path_of(matches, "scene").expect("clap requires it where no graph is to be printed");
    let out = path_of(matches, "out").unwrap_or_else(|| default_folder(&scene));
    let mut settings = settings(matches, &RunFolder::at(&out))?;
    let json = matches.get_flag("json");
    let until = matches.get_one::<Until>("until").copied();
    if matches.get_flag("explain") {
        use_threads(settings.run.threads);
        return tell_plan(&scene, &out, &settings, until, json);
    }
    let _server = listen(matches, out.clone(), false)?;
    let page = page_of_run(matches, &scene, &out, json)?;
    if page.is_some() {
        // The page shows the scene as it was at the last checkpoint.
        settings.run.checkpoint_every = settings.run.checkpoint_every.min(PAGE_CHECKPOINTS);
    }
    let stopper = Stopper::new();
    stop_with_parent(matches, &stopper)?;
    let summary = run_scene(&scene, &out, &settings, until, json, stopper.clone())?;
    if json {
        print_json(&serde_json::json!({ "event": "summary", "folder": out, "summary": summary }))?;
    } else {
        tell(&summary, &out)?;
    }
    stay(page, &stopper);
    Ok(())
}

/// Those of the file that was named, which is the user's own, else those that the run folder remembers; flags over them.
/// Where code is only the user says.
pub fn settings(matches: &ArgMatches, folder: &RunFolder) -> Result<Settings, Failure> {
    let (own, kept, flags) =
        (path_of(matches, "config"), folder.settings_file(), crate::args::given(matches));
    let mut settings = match own {
        // What is no plain file is refused there, in words.
        None if kept.exists() => Settings::recorded(&kept, &flags)?,
        own => Settings::layered(own.as_deref(), &flags)?,
    };
    let code = Code::given(&flags);
    code.tell(&mut settings.vision);
    code.names_networks_of(folder, &settings.vision)?;
    Ok(settings)
}

/// Says what a run would do, and why.
fn tell_plan(
    scene: &Path,
    out: &Path,
    settings: &Settings,
    until: Option<Until>,
    json: bool,
) -> Result<(), Failure> {
    let folder = RunFolder::at(out);
    let plans = segwild_pipeline::explain(scene, &folder, settings, until)?;
    if json {
        plans.iter().try_for_each(print_json)?;
        return match segwild_pipeline::explain_time(scene, &folder, settings)? {
            Some(bought) => print_json(&serde_json::json!({ "time": bought })),
            None => Ok(()),
        };
    }
    for StagePlan { stage, verdict, why } in plans {
        let what = match verdict {
            StageVerdict::Reused => "reused".to_owned(),
            StageVerdict::Partly { made, of } => format!("made for {made} of {of} photos"),
            StageVerdict::GoesOn { step } => format!("goes on from step {step}"),
            StageVerdict::Stands { step } => format!("stands at step {step}"),
            StageVerdict::SnapshotAgain { from, to } => format!("again from step {from} to {to}"),
            StageVerdict::NotReached => "waits for the snapshot".to_owned(),
            StageVerdict::Made => "made".to_owned(),
        };
        print_line(format!("{stage:>9}  {what:24} {}", why.join("; ")).trim_end())?;
    }
    match segwild_pipeline::explain_time(scene, &folder, settings)? {
        Some(bought) => print_line(&format!("{:>9}  {bought}", "time")),
        None => Ok(()),
    }
}

/// `runs/NAME` for a scene folder of that name.
fn default_folder(scene: &Path) -> PathBuf {
    let whole = std::path::absolute(scene).unwrap_or_else(|_| scene.to_owned());
    let name = whole.file_stem().map_or("scene".into(), |n| n.to_string_lossy().into_owned());
    Path::new("runs").join(name)
}

/// Runs a scene with progress, until it is done, Ctrl-C, or the stopper.
pub fn run_scene(
    scene: &Path,
    out: &Path,
    settings: &Settings,
    until: Option<Until>,
    json: bool,
    stopper: Stopper,
) -> Result<Summary, Failure> {
    use_threads(settings.run.threads);
    crate::allocator::keep_images(settings.scene.size, settings.run.memory_budget);
    let events = Events::new();
    stop_on_ctrl_c(&stopper)?;
    let sink = show(&events, json)?;
    // A scene that is not there is no reason to make a folder.
    std::fs::metadata(scene).map_err(SceneError::io(scene)).map_err(RunError::from)?;
    let folder = RunFolder::create(out)?;
    let options = RunOptions { events, stopper, until, ..RunOptions::default() };
    let done = segwild_pipeline::run(scene, &folder, settings, &options);
    drop(options);
    drop(sink); // everything that happened is shown before the last word
    Ok(done?)
}

/// Says how it went.
pub fn tell(summary: &Summary, out: &Path) -> Result<(), Failure> {
    let memory = summary.peak_bytes.map_or(String::new(), |b| format!(", peak memory {} MiB", b >> 20));
    // A run that ended before any splat was there has nothing to say of them.
    let splats = if summary.splats > 0 { format!(", {} splats", summary.splats) } else { String::new() };
    print_line(&format!("{} photos{splats}; {}{memory}", summary.photos, duration(summary.wall_s)))?;
    if let Some(step) = summary.paused_at {
        print_line(&format!(
            "stopped at step {step} of the training, as --until says; the same command with a later --until, or \
             without it, goes on from there"
        ))?;
    }
    for words in Skipped::in_words(&summary.skipped) {
        print_line(&words)?;
    }
    print_line(&format!("masks and clicks by: {}", summary.provider))?;
    if let Some(fit) = &summary.train_fit {
        print_line(&format!("training photos: {}", fit.in_words()))?;
    }
    if let Some(seams) = &summary.seams {
        print_line(&format!("seams: {}", seams.in_words()))?;
    }
    if let Some(held) = &summary.held_out {
        print_line(&format!("held-out photos: {} ({})", held.in_words(), held.protocol))?;
    }
    if !summary.actors.is_empty() {
        print_line("where the time went, by actor (they work at the same time):")?;
        print_line(summary.actors.trim_end())?;
    }
    let report = out.join("report.html");
    if report.is_file() {
        print_line(&format!("report: {}", report.display()))?;
    }
    Ok(())
}
