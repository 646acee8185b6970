//! What overlapping is worth, and what it costs.

use super::row::{FlowError, FlowOptions, Row, io};
use super::scene::{fresh, settings, write_scene};
use super::waiting::{Waits, waiting};
use crate::counted::counted;
use segwild_flow::{Event, Events, cpu, files};
use segwild_pipeline::{RunFolder, RunOptions, Settings, Until, run};
use segwild_vision::Providers;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

/// Pairs that are timed. Each gives one ratio of two runs back to back, which whatever else the machine does slows
/// alike; the median of the ratios counts. Every other pair is in the other order.
pub(super) const PAIRS: usize = 5;

/// One run, timed.
pub(super) struct TimedRun {
    pub(super) wall: f64,
    /// Processor seconds of all threads.
    cpu: f64,
    /// Wall seconds per stage.
    stages: BTreeMap<String, f64>,
    /// Seconds that the trainer worked.
    training: f64,
}

impl TimedRun {
    fn stage(&self, name: &str) -> f64 {
        self.stages.get(name).copied().unwrap_or(0.0)
    }
}

/// The stages that follow one another after the training.
const LAST_STAGES: [&str; 4] = ["features", "evaluate", "objects", "report"];

pub(super) fn timed(
    scene: &Path,
    dir: &Path,
    settings: &Settings,
    providers: &Providers,
    until: Option<Until>,
) -> Result<TimedRun, FlowError> {
    let folder = RunFolder::create(dir)?;
    let events = Events::new();
    let listener = events.subscribe();
    let options = RunOptions { events, providers: Some(providers.clone()), until, ..RunOptions::default() };
    let (began, cpu_before) = (Instant::now(), cpu::process_seconds().unwrap_or(0.0));
    run(scene, &folder, settings, &options)?;
    let wall = began.elapsed().as_secs_f64();
    let cpu = cpu::process_seconds().unwrap_or(0.0) - cpu_before;
    drop(options);
    let mut stages = BTreeMap::new();
    while let Some(record) = listener.try_next() {
        if let Event::StageFinished { stage, wall_s, .. } = record.event {
            stages.insert(stage, wall_s);
        }
    }
    let text = io("read the timeline", std::fs::read_to_string(dir.join("timeline.json")))?;
    let report: serde_json::Value = serde_json::from_str(&text).unwrap_or_default();
    let actors = report["actors"].as_array().into_iter().flatten();
    let trainer = actors.filter(|a| a["name"] == "trainer").find_map(|a| a["busy_s"].as_f64());
    Ok(TimedRun { wall, cpu, stages, training: trainer.unwrap_or(0.0) })
}

/// Keeps the timeline of the run that was just timed, for those who examine its waits: the next run takes its folder.
fn keep_trace(dir: &Path, number: usize) -> Result<(), FlowError> {
    let kept = dir.join(format!("run-{number}.trace.json"));
    io(
        "keep the trace",
        std::fs::read(dir.join("run/trace.json")).and_then(|trace| files::write_plain(kept, trace)),
    )
}

/// The stages one after another: sky, embeddings, training to the snapshot and then the masks, the rest.
fn one_after_another(
    scene: &Path,
    dir: &Path,
    settings: &Settings,
    providers: &Providers,
) -> Result<Vec<TimedRun>, FlowError> {
    let dir = fresh(dir)?;
    let snapshot = settings.train.snapshot_step();
    [Until::stage("sky"), Until::stage("embed"), Some(Until::Step(snapshot)), None]
        .into_iter()
        .map(|until| timed(scene, &dir, settings, providers, until))
        .collect()
}

/// The two ways of running, back to back: the dataflow, and its stages one after another.
pub(super) struct RunPair {
    pub(super) whole: TimedRun,
    legs: Vec<TimedRun>,
    /// Seconds that the dataflow's services computed, over the calls that all of them compute at a time; 0 without services.
    pub(super) services: f64,
}

impl RunPair {
    fn measure(
        number: usize,
        scene: &Path,
        dir: &Path,
        settings: &Settings,
        providers: &Providers,
        services: impl Fn() -> f64,
    ) -> Result<RunPair, FlowError> {
        let whole = || -> Result<(TimedRun, f64), FlowError> {
            let before = services();
            let timed = timed(scene, &fresh(&dir.join("run"))?, settings, providers, None)?;
            keep_trace(dir, number)?;
            Ok((timed, services() - before))
        };
        let legs = || one_after_another(scene, &dir.join("legs"), settings, providers);
        if number.is_multiple_of(2) {
            let legs = legs()?;
            let (whole, services) = whole()?;
            Ok(RunPair { whole, legs, services })
        } else {
            let (whole, services) = whole()?;
            Ok(RunPair { whole, legs: legs()?, services })
        }
    }

    /// `services` returns the seconds that vision services have computed so far, over the calls that they compute at a time.
    pub(super) fn measure_all(
        scene: &Path,
        dir: &Path,
        settings: &Settings,
        providers: &Providers,
        services: impl Fn() -> f64,
    ) -> Result<Vec<RunPair>, FlowError> {
        (0..PAIRS).map(|n| RunPair::measure(n, scene, dir, settings, providers, &services)).collect()
    }

    /// Seconds of the stages one after another.
    fn sum(&self, seconds: impl Fn(&TimedRun) -> f64) -> f64 {
        self.legs.iter().map(seconds).sum()
    }

    /// Seconds of the longest chain of work that cannot overlap, and in words what it is made of.
    pub(super) fn chain(&self) -> (f64, String) {
        let [sky, embed, early, rest] = &self.legs[..] else { unreachable!("there are four legs") };
        // Training needs every sky before its first step (transients are searched in all photos, which then are compared
        // with each other), masks need the snapshot, the field needs all.
        let (s, e, t1, m) = (sky.stage("sky"), embed.stage("embed"), early.training, early.stage("masks"));
        let t2 = rest.training;
        let end = LAST_STAGES.iter().map(|n| rest.stage(n)).sum::<f64>();
        // Services that skies, embeddings and masks share compute them one after another, whatever waits for them.
        let chain = (s + t1 + t2.max(m)).max(e).max(self.services) + end;
        let services =
            if self.services > 0.0 { format!(", or services {:.2}", self.services) } else { String::new() };
        let words = format!(
            "{chain:.2} s (sky {s:.2}, then training {t1:.2}, then training {t2:.2} or masks {m:.2}, or embeddings {e:.2}{services}; \
             then {end:.2})"
        );
        (chain, words)
    }
}

/// The pair with the median ratio, that ratio, and the spread of all in words.
pub(super) fn median(pairs: &[RunPair], ratio: impl Fn(&RunPair) -> f64) -> (&RunPair, f64, String) {
    let mut sorted: Vec<(f64, &RunPair)> = pairs.iter().map(|p| (ratio(p), p)).collect();
    sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (value, pair) = sorted[sorted.len() / 2];
    let ratios: Vec<String> = sorted.iter().map(|(r, _)| format!("{r:.3}")).collect();
    (pair, value, format!("median of the pairs {}", ratios.join(" ")))
}

/// With providers that wait: the wall time over the longest chain of work that cannot overlap; and how many calls a
/// second run makes.
pub fn overlap(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("overlap"))?;
    let scene = dir.join("scene");
    write_scene(&scene, 30, 96)?;
    let settings =
        settings(&[("size", "96"), ("steps", "1000"), ("refine_steps", "40"), ("prompt_budget", "24")])?;
    let builtin = Providers::from_settings(&settings.vision).map_err(segwild_pipeline::RunError::from)?;
    let ms = Duration::from_millis;
    let providers =
        waiting(&builtin, Waits { sky: ms(40), embed: ms(120), masks: ms(120), accelerator: false });
    let pairs = RunPair::measure_all(&scene, &dir, &settings, &providers, || 0.0)?;
    let (pair, value, spread) = median(&pairs, |p| p.whole.wall / p.chain().0);
    let from = format!(
        "{spread}; that one: wall {:.2} s, processor {:.2} s, chain {}, one after another wall {:.2} s, processor {:.2} s",
        pair.whole.wall,
        pair.whole.cpu,
        pair.chain().1,
        pair.sum(|t| t.wall),
        pair.sum(|t| t.cpu)
    );
    let (providers, calls) = counted(&providers);
    let second = timed(&scene, &dir.join("run"), &settings, &providers, None)?;
    Ok(vec![
        Row {
            name: "overlap".into(),
            what: "wall time over the longest chain, with providers that wait".into(),
            value,
            bar: 1.10,
            from,
            load: None,
        },
        Row {
            name: "cache".into(),
            what: "provider calls of a second run".into(),
            value: calls.count() as f64,
            bar: 0.0,
            from: format!("{:.2} s", second.wall),
            load: None,
        },
    ])
}

/// With providers that wait for the one accelerator: the wall time over the time that it is held, and what comes after.
pub fn accelerator(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("accelerator"))?;
    let scene = dir.join("scene");
    write_scene(&scene, 20, 96)?;
    let settings =
        settings(&[("size", "96"), ("steps", "600"), ("refine_steps", "40"), ("prompt_budget", "24")])?;
    let builtin = Providers::from_settings(&settings.vision).map_err(segwild_pipeline::RunError::from)?;
    let ms = Duration::from_millis;
    let providers =
        waiting(&builtin, Waits { sky: ms(60), embed: ms(80), masks: ms(100), accelerator: true });
    let mut runs = Vec::new();
    for number in 0..PAIRS {
        let before = segwild_pipeline::accelerator().stats();
        let run = timed(&scene, &fresh(&dir.join("run"))?, &settings, &providers, None)?;
        keep_trace(&dir, number)?;
        let stats = segwild_pipeline::accelerator().stats();
        let end = LAST_STAGES.iter().map(|name| run.stage(name)).sum::<f64>();
        let held = stats.held_s - before.held_s;
        runs.push((run.wall / (held + end), run.wall, held, end, stats.waited_s - before.waited_s));
    }
    runs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let ratios: Vec<String> = runs.iter().map(|r| format!("{:.3}", r.0)).collect();
    let (value, wall, held, end, waited) = runs[runs.len() / 2];
    Ok(vec![Row {
        name: "accelerator".into(),
        what: "wall time over the time that the one accelerator is held, and what comes after".into(),
        value,
        bar: 1.10,
        from: format!(
            "median of {}; that one: wall {wall:.2} s, held {held:.2} s, then {end:.2} s; actors waited {waited:.2} s for it",
            ratios.join(" ")
        ),
        load: None,
    }])
}

/// With the built-in providers, which keep the cores busy: the dataflow over the stages one after another.
pub fn cost(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("cost"))?;
    let scene = dir.join("scene");
    write_scene(&scene, 24, 160)?;
    let settings =
        settings(&[("size", "160"), ("steps", "600"), ("refine_steps", "60"), ("prompt_budget", "64")])?;
    let providers = Providers::from_settings(&settings.vision).map_err(segwild_pipeline::RunError::from)?;
    let pairs = RunPair::measure_all(&scene, &dir, &settings, &providers, || 0.0)?;
    let row = |name: &str, what: &'static str, seconds: fn(&TimedRun) -> f64| {
        let (pair, value, spread) = median(&pairs, |p| seconds(&p.whole) / p.sum(seconds));
        let (flow, sum) = (seconds(&pair.whole), pair.sum(seconds));
        let from = format!("{spread}; that one: {flow:.2} s, one after another {sum:.2} s");
        Row { name: name.into(), what: what.into(), value, bar: 1.03, from, load: None }
    };
    Ok(vec![
        row("cost", "wall time over that of the stages one after another, all cores busy", |t| t.wall),
        row("cost, processor", "processor time over that of the stages one after another", |t| t.cpu),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pair(whole: f64, legs: f64) -> RunPair {
        let timed = |wall| TimedRun { wall, cpu: wall, stages: BTreeMap::new(), training: 0.0 };
        RunPair { whole: timed(whole), legs: vec![timed(legs)], services: 0.0 }
    }

    #[test]
    fn a_ratio_is_of_one_pair_and_not_of_the_best_of_each_side() {
        // The machine was slow in the second pair, for both sides.
        let pairs = [pair(1.1, 1.0), pair(3.0, 3.0), pair(1.0, 1.25)];
        let (_, value, words) = median(&pairs, |p| p.whole.wall / p.sum(|t| t.wall));
        assert_eq!(value, 1.0);
        assert_eq!(words, "median of the pairs 0.800 1.000 1.100");
    }
}
