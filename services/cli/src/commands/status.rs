//! `segwild status`

use crate::args::flag;
use crate::failure::Failure;
use crate::farm::{target, target_args};
use crate::operators::{listen, metrics_listen};
use crate::output::{print_json, print_line};
use crate::progress::{duration, first_ctrl_c};
use clap::{ArgMatches, Command};
use segwild_monitor::view::{BatchView, FarmView, FarmWorkerView, RunView, Runs, SceneState, StageView};
use segwild_monitor::words::{bytes, count};
use segwild_monitor::{MonitorTarget, MonitorView};
use std::sync::mpsc;
use std::time::Duration;

/// Time between two samples of `--follow`.
const EVERY: Duration = Duration::from_secs(1);

/// The command's arguments.
pub fn command() -> Command {
    target_args(Command::new("status"))
        .about("Say what a run, a batch or a farm has done and is doing")
        .after_help(crate::args::examples(
            "segwild status runs/trevi",
            "segwild status --farm nats://queue:4222/night --metrics-listen 127.0.0.1:9464",
        ))
        .arg(flag("once", "One sample, then exit; so it is without --follow as well"))
        .arg(flag("follow", "A sample a second, as long as a process works on it").conflicts_with("once"))
        .arg(crate::args::json())
        .arg(metrics_listen().conflicts_with_all(["once", "follow", "json"]))
}

/// Serves what is shown instead of printing it, until stopped.
fn stay(matches: &ArgMatches, target: MonitorTarget) -> Result<(), Failure> {
    // It writes nothing: an end at any time is as good.
    let stopped = first_ctrl_c()?;
    let _server = listen(matches, target, false)?;
    // The sender lives as long as the process.
    let _ = stopped.recv();
    Ok(())
}

/// Says what a run, a batch or a farm has done and is doing, also while another process runs it.
pub fn status(matches: &ArgMatches) -> Result<(), Failure> {
    let target = target(matches)?;
    if matches.contains_id("metrics-listen") {
        return stay(matches, target);
    }
    // A channel that nobody sends to: waiting on it is waiting for the next sample.
    let (_never, next) = mpsc::channel::<()>();
    let mut runs = Runs::default();
    loop {
        let view = target.read(&mut runs)?;
        match (&view, matches.get_flag("json")) {
            (_, true) => print_json(&view)?,
            (MonitorView::Run(run), _) => tell_run(run, "")?,
            (MonitorView::Batch(batch), _) => tell_batch(batch)?,
        }
        if !matches.get_flag("follow") || !view.is_running() {
            return Ok(());
        }
        if !matches.get_flag("json") {
            print_line("")?;
        }
        let _ = next.recv_timeout(EVERY);
    }
}

fn tell_run(run: &RunView, indent: &str) -> Result<(), Failure> {
    match &run.owner {
        Some(owner) => {
            let left = run.left_s.map_or(String::new(), |s| format!(", {} left", duration(s)));
            let memory = run.rss_bytes.map_or(String::new(), |n| format!(", {}", bytes(n)));
            print_line(&format!("{indent}in use by {owner}{left}{memory}"))?;
        }
        None => print_line(&format!("{indent}no process is working on this run"))?,
    }
    for stage in &run.stages {
        let line = format!("{indent}{:>9}  {:8} {}", stage.name, stage.state, stage_words(stage));
        print_line(line.trim_end())?;
        if let Some(error) = &stage.error {
            print_line(&format!("{indent}{:>9}  {error}", ""))?;
        }
        for photo in run.failures.iter().filter(|f| f.stage == stage.name) {
            print_line(&format!("{indent}{:>9}  {}: {}", "", photo.photo, photo.error))?;
        }
    }
    for actor in run.actors.iter().filter(|_| run.running) {
        for worker in &actor.workers {
            if let Some(why) = &worker.why {
                print_line(&format!("{indent}{:>9}  {why}", actor.name))?;
            }
        }
    }
    for selection in &run.selections {
        let took = selection.answered_s.map_or(String::new(), |s| format!(" (in {})", duration(s)));
        print_line(&format!("{indent}selection  {}{took}", selection.name))?;
    }
    Ok(())
}

fn stage_words(stage: &StageView) -> String {
    let mut words = Vec::new();
    match stage.state.as_str() {
        "running" => {
            words.extend(stage.part.clone());
            words.extend(stage.total.map(|total| format!("{} of {total}", stage.done)));
            words.extend(stage.eta_s.map(|s| format!("{} left", duration(s))));
        }
        _ => words.extend(stage.wall_s.map(|s| format!("in {}", duration(s)))),
    }
    let photos = stage.made + stage.cached + stage.failed;
    if photos > 0 {
        words.push(format!("{photos} photos"));
    }
    if stage.failed > 0 {
        words.push(format!("{} failed", stage.failed));
    }
    words.extend(stage.why.clone());
    words.join(", ")
}

/// What a worker of a farm has, how much of that its scenes need, when it was last seen, and why it takes no scenes.
fn worker_words(worker: &FarmWorkerView) -> String {
    let mut words = vec![count(worker.held as u32, "scene")];
    if let Some(whole) = &worker.whole {
        words.push(format!("{} of {}", worker.used.cores, count(whole.cores, "core")));
        words.push(format!("{} of {}", bytes(worker.used.memory_bytes), bytes(whole.memory_bytes)));
        if whole.accelerators > 0 {
            words.push(format!(
                "{} of {}",
                worker.used.accelerators,
                count(whole.accelerators, "accelerator")
            ));
        }
    }
    words.extend(worker.accelerator.clone());
    words.push(format!("{} done, {} failed", worker.done, worker.failed));
    words.push(format!("seen {} ago", duration(worker.seen_s)));
    words.extend(worker.paused.as_ref().map(|reason| format!("takes no scene: {reason}")));
    words.join(", ")
}

fn tell_batch(batch: &BatchView) -> Result<(), Failure> {
    let is_empty = |farm: &FarmView| farm.workers.is_empty() && batch.scenes.is_empty();
    match &batch.owner {
        _ if batch.farm.as_ref().is_some_and(is_empty) => {
            print_line("this farm has no scenes and no workers")?;
        }
        Some(owner) => print_line(&format!("run by {owner}"))?,
        None => print_line("no process is running this batch")?,
    }
    for worker in batch.farm.iter().flat_map(|farm| &farm.workers) {
        print_line(&format!("worker {}: {}", worker.name, worker_words(worker)))?;
    }
    for scene in &batch.scenes {
        // A kill or a stop of the batch ended the others, and they do not count.
        let now = u32::from(matches!(scene.state, SceneState::Running | SceneState::Done));
        let attempt = (scene.failures + now).max(1);
        let time = scene.wall_s.map_or(String::new(), |s| format!("attempt {attempt}, {}", duration(s)));
        let until = scene.until.as_deref().map_or(String::new(), |until| format!(" (until {until})"));
        let why = scene.why.as_deref().map_or(String::new(), |w| format!("  {w}"));
        print_line(&format!("{}: {}{until} {time}{why}", scene.name, scene.state.word()))?;
        if let Some(run) = scene.run.as_ref().filter(|run| run.running) {
            tell_run(run, "    ")?;
        }
    }
    Ok(())
}
