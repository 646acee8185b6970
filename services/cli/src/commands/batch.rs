//! `segwild batch`

use crate::args::{flag, path, path_of};
use crate::exit;
use crate::failure::{Failure, plain};
use crate::farm::{ReachedFarm, farm_args, reach, shown};
use crate::operators::{have_files_to_open, listen, metrics_listen};
use crate::output::{print_json, print_line, print_note};
use crate::progress::{duration, on_ctrl_c};
use clap::{Arg, ArgMatches, Command, value_parser};
use segwild_farm::{
    BatchEvent, BatchOptions, BatchSummary, FarmBatch, JobState, JobStatus, StopBatch, StopLevel, batch,
};
use segwild_pipeline::Until;
use std::path::{Path, PathBuf};

/// The command's arguments.
pub fn command() -> Command {
    let command = Command::new("batch").about("Run many scenes on this machine or a farm, unattended");
    let command = farm_args(command, "Hand the scenes to this farm and watch: nats://HOST:PORT/NAME");
    command
        .after_help(crate::args::examples(
            "segwild batch scenes.toml --out runs/night",
            "segwild batch scenes.toml --out runs/night --farm nats://queue:4222/night",
        ))
        .arg(metrics_listen())
        .arg(
            Arg::new("manifest")
                .required(true)
                .value_name("MANIFEST")
                .value_parser(value_parser!(PathBuf))
                .help("TOML file of the scenes, their settings and priorities, and the budget"),
        )
        .arg(path("out", "Batch folder [default: runs/NAME of the manifest]"))
        .arg(crate::args::until(
            "Every scene stops after this stage, or after training step N, whatever the manifest says",
        ))
        .arg(flag("retry-dead", "Let scenes that were given up try again"))
        .arg(flag("metrics-per-scene", "Label metrics with the scene: a time series each"))
        .arg(flag("no-wait", "Hand the scenes to the farm, and do not watch").requires("farm"))
        .arg(crate::args::json())
}

/// Runs the scenes of a manifest, or what is left of them.
pub fn batch(matches: &ArgMatches) -> Result<(), Failure> {
    have_files_to_open()?;
    let manifest = path_of(matches, "manifest").expect("clap requires it");
    let out = path_of(matches, "out")
        .unwrap_or_else(|| Path::new("runs").join(manifest.file_stem().unwrap_or(manifest.as_os_str())));
    let json = matches.get_flag("json");
    if let Some(farm) = reach(matches, "batch")? {
        return on_farm(matches, &farm, &manifest, &out);
    }
    let _server = listen(matches, out.clone(), matches.get_flag("metrics-per-scene"))?;
    let stop = stop_on_presses("stopping the scenes where they can continue; once more to stop at once")?;
    let program = std::env::current_exe()?;
    let options = BatchOptions {
        program,
        classify: exit::class,
        stop,
        retry_dead: matches.get_flag("retry-dead"),
        until: matches.get_one::<Until>("until").copied(),
    };
    let mut shown = BatchOutput::new(json);
    let summary = batch::run(&manifest, &out, &options, &mut |event| shown.show(event))?;
    if summary.interrupted {
        shown.summary(&summary, &out)?;
        let message = "stopped; the same command goes on from here".into();
        return Err(Failure { message, code: exit::INTERRUPTED });
    }
    shown.ended(&summary, &out)
}

/// Stops scenes by Ctrl-C (or SIGTERM): at the first one, of which a note tells, where they can continue; at the second at once.
pub fn stop_on_presses(note: &'static str) -> std::io::Result<StopBatch> {
    let stop = StopBatch::default();
    let flags = stop.clone();
    on_ctrl_c(move |press| match press {
        1 => {
            print_note(note);
            flags.raise(StopLevel::Stop);
        }
        2 => flags.raise(StopLevel::AtOnce),
        // Scenes end with their standard input: nobody is left behind.
        _ => std::process::exit(exit::INTERRUPTED.into()),
    })?;
    Ok(stop)
}

/// Hands the scenes to a farm and watches them.
fn on_farm(matches: &ArgMatches, farm: &ReachedFarm, manifest: &Path, out: &Path) -> Result<(), Failure> {
    let _server = listen(matches, shown(&farm.engine), matches.get_flag("metrics-per-scene"))?;
    let stop = StopBatch::default();
    let flags = stop.clone();
    on_ctrl_c(move |press| match press {
        1 => flags.raise(StopLevel::Stop),
        _ => std::process::exit(exit::INTERRUPTED.into()),
    })?;
    let name = out.file_name().map_or_else(|| "batch".into(), |name| name.to_string_lossy().into_owned());
    let batch = FarmBatch {
        engine: &*farm.engine,
        artefacts: &farm.artefacts,
        name,
        out: Some(out.to_owned()),
        stop,
    };
    let until = matches.get_one::<Until>("until").copied();
    let mut events = BatchOutput::new(matches.get_flag("json"));
    batch.submit(manifest, until, matches.get_flag("retry-dead"), &mut |event| events.show(event))?;
    if matches.get_flag("no-wait") {
        return Ok(());
    }
    let summary = batch.watch(&mut |event| events.show(event))?;
    if summary.interrupted {
        events.summary(&summary, out)?;
        let message = "not watched any more; the farm works on, and the same command watches again".into();
        return Err(Failure { message, code: exit::INTERRUPTED });
    }
    events.ended(&summary, out)
}

/// Where events and the summary go.
pub struct BatchOutput {
    json: bool,
    report: Result<(), Failure>,
}

impl BatchOutput {
    /// To standard output as JSON, or as notes to standard error.
    pub fn new(json: bool) -> Self {
        Self { json, report: Ok(()) }
    }

    /// Prints an event.
    pub fn show(&mut self, event: &BatchEvent) {
        if !self.json {
            print_note(&plain(&in_words(event)));
        } else if self.report.is_ok() {
            // Nobody listening is no reason to stop working.
            self.report = print_json(event);
        }
    }

    fn summary(&self, summary: &BatchSummary, out: &Path) -> Result<(), Failure> {
        match self.json {
            true => print_json(&serde_json::json!({ "event": "summary", "folder": out, "summary": summary })),
            false => table(summary),
        }
    }

    /// A batch that has come to its end.
    fn ended(&self, summary: &BatchSummary, out: &Path) -> Result<(), Failure> {
        self.summary(summary, out)?;
        match summary.count(JobState::Dead) {
            0 => Ok(()),
            dead => {
                let message = format!(
                    "{dead} of {} scenes were given up; mend what they say and run again with --retry-dead (logs: {})",
                    summary.scenes.len(),
                    out.join("logs").display()
                );
                Err(Failure { message, code: exit::INCOMPLETE })
            }
        }
    }
}

/// An event as a line.
fn in_words(event: &BatchEvent) -> String {
    match event {
        BatchEvent::SceneFetches { scene, resumes: true } => {
            format!("{scene} is fetched, to continue what another attempt stored")
        }
        BatchEvent::SceneFetches { scene, resumes: false } => format!("{scene} is fetched"),
        BatchEvent::SceneStored { scene, seconds } => format!("{scene} is stored, in {}", duration(*seconds)),
        BatchEvent::SceneTaken { scene, worker, attempt } => {
            let again = if *attempt > 1 { format!(" (taken {attempt} times)") } else { String::new() };
            format!("{scene} is taken by {worker}{again}")
        }
        BatchEvent::SceneFetched { scene, seconds } => {
            format!("{scene}: the result is here, fetched in {}", duration(*seconds))
        }
        BatchEvent::EngineSilent { reason } => {
            format!("the farm does not answer, the work goes on: {reason}")
        }
        BatchEvent::EngineBack => "the farm answers again".into(),
        BatchEvent::WorkerPaused { reason } => format!("takes no scene: {reason}"),
        BatchEvent::WorkerResumed => "takes scenes again".into(),
        BatchEvent::SceneStarted { scene, pid, attempt, cores } => {
            let again = if *attempt > 1 { format!(", attempt {attempt}") } else { String::new() };
            let s = if *cores == 1 { "" } else { "s" };
            format!("{scene} begins (process {pid}, {cores} core{s}{again})")
        }
        BatchEvent::SceneWaits { scene, reason } => format!("{scene} waits: {reason}"),
        BatchEvent::SceneDone { scene, seconds } => format!("{scene} done in {}", duration(*seconds)),
        BatchEvent::SceneRetries { scene, error, delay_s } => {
            format!("{scene} failed, tries again in {}: {error}", duration(*delay_s))
        }
        BatchEvent::SceneDied { scene, error } => format!("{scene} was given up: {error}"),
        BatchEvent::SceneStopped { scene } => format!("{scene} stopped; it can go on"),
        BatchEvent::ClockJumped { seconds } if *seconds < 0.0 => {
            format!("the clock was set back by {}; rests last as long as they should", duration(-seconds))
        }
        BatchEvent::ClockJumped { seconds } => format!(
            "the clock went ahead by {}: it was set, or the machine slept; rests last as long as they should",
            duration(*seconds)
        ),
    }
}

/// The attempts that count: a kill or a stop of the batch ended the others, and is none of the scene's doing.
fn attempts(scene: &JobStatus) -> u32 {
    scene.failures + u32::from(scene.state == JobState::Done)
}

fn table(summary: &BatchSummary) -> Result<(), Failure> {
    let width = summary.scenes.iter().map(|s| s.job.id.chars().count()).max().unwrap_or(0).max(5);
    print_line(&format!("{:width$}  {:8} {:>8} {:>12}", "scene", "state", "attempts", "last took"))?;
    for scene in &summary.scenes {
        let state = match scene.state {
            JobState::Pending | JobState::Leased => "waiting",
            other => other.word(),
        };
        let time = scene.started.zip(scene.ended).map_or("-".into(), |(a, b)| duration((b - a).max(0.0)));
        let error = scene.error.as_deref().map_or(String::new(), |e| format!("  {e}"));
        print_line(&format!("{:width$}  {state:8} {:>8} {time:>12}{error}", scene.job.id, attempts(scene)))?;
    }
    print_line(&format!(
        "{} done, {} given up, {} waiting, {}",
        summary.count(JobState::Done),
        summary.count(JobState::Dead),
        summary.scenes.len() - summary.count(JobState::Done) - summary.count(JobState::Dead),
        duration(summary.wall_s)
    ))
}
