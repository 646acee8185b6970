//! What overlapping is worth, and what it costs.

use super::{FlowError, FlowOptions, Row, Waits, counted, fresh, io, place, settings, waiting};
use segwild_flow::{Event, Events, cpu};
use segwild_pipeline::{RunFolder, RunOptions, Settings, Until, run};
use segwild_vision::Providers;
use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant};

/// How often each way of running is timed; the fastest counts, since other programs only ever add time.
const REPEATS: usize = 3;

/// One run, timed.
struct Timed {
    wall: f64,
    /// Processor seconds of all threads.
    cpu: f64,
    /// Wall seconds per stage.
    stages: BTreeMap<String, f64>,
    /// Seconds that the trainer worked.
    training: f64,
}

impl Timed {
    fn stage(&self, name: &str) -> f64 {
        self.stages.get(name).copied().unwrap_or(0.0)
    }
}

fn timed(
    scene: &Path,
    dir: &Path,
    settings: &Settings,
    providers: &Providers,
    until: Option<Until>,
) -> Result<Timed, FlowError> {
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
    Ok(Timed { wall, cpu, stages, training: trainer.unwrap_or(0.0) })
}

/// The stages one after another: sky, embeddings, training to the snapshot and then the masks, the rest.
fn one_after_another(
    scene: &Path,
    dir: &Path,
    settings: &Settings,
    providers: &Providers,
) -> Result<Vec<Timed>, FlowError> {
    let dir = fresh(dir)?;
    let snapshot = settings.train.snapshot_step();
    [Until::stage("sky"), Until::stage("embed"), Some(Until::Step(snapshot)), None]
        .into_iter()
        .map(|until| timed(scene, &dir, settings, providers, until))
        .collect()
}

/// With providers that wait: the wall time over the longest chain of work that cannot overlap; and how many calls a
/// second run makes.
pub fn overlap(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("overlap"))?;
    let scene = dir.join("scene");
    place(&scene, 30, 96)?;
    let settings =
        settings(&[("size", "96"), ("steps", "1000"), ("refine_steps", "40"), ("prompt_budget", "24")])?;
    let builtin = Providers::from_settings(&settings.vision).map_err(segwild_pipeline::RunError::from)?;
    let ms = Duration::from_millis;
    let providers = waiting(&builtin, Waits { sky: ms(40), embed: ms(120), masks: ms(120) });
    let mut best: Option<(f64, f64, f64, String)> = None;
    let run_dir = dir.join("run");
    for _ in 0..REPEATS {
        let legs = one_after_another(&scene, &dir.join("legs"), &settings, &providers)?;
        let [sky, embed, early, rest] = &legs[..] else { unreachable!("there are four legs") };
        // Training can begin with the first sky, masks with the snapshot, the field when all is there.
        let (s, e, t1, m) = (sky.stage("sky"), embed.stage("embed"), early.training, early.stage("masks"));
        let (t2, end) =
            (rest.training, ["features", "evaluate", "report"].iter().map(|n| rest.stage(n)).sum::<f64>());
        let chain = (s.max(t1) + t2.max(m)).max(e) + end;
        let sum: f64 = legs.iter().map(|l| l.wall).sum();
        fresh(&run_dir)?;
        let whole = timed(&scene, &run_dir, &settings, &providers, None)?;
        let from = format!(
            "wall {:.2} s; chain {chain:.2} s (sky {s:.2} or training {t1:.2}, then training {t2:.2} or masks {m:.2}, or \
             embeddings {e:.2}; then {end:.2}); one after another {sum:.2} s",
            whole.wall
        );
        let ratio = whole.wall / chain;
        if best.as_ref().is_none_or(|b| ratio < b.0) {
            best = Some((ratio, whole.wall, chain, from));
        }
    }
    let (value, _, _, from) = best.expect("at least one repeat");
    let (providers, calls) = counted(&providers);
    let second = timed(&scene, &run_dir, &settings, &providers, None)?;
    Ok(vec![
        Row {
            name: "overlap".into(),
            what: "wall time over the longest chain, with providers that wait",
            value,
            bar: 1.10,
            from,
        },
        Row {
            name: "cache".into(),
            what: "provider calls of a second run",
            value: calls.count() as f64,
            bar: 0.0,
            from: format!("{:.2} s", second.wall),
        },
    ])
}

/// With the built-in providers, which keep the cores busy: the dataflow over the stages one after another.
pub fn cost(options: &FlowOptions) -> Result<Vec<Row>, FlowError> {
    let dir = fresh(&options.dir.join("cost"))?;
    let scene = dir.join("scene");
    place(&scene, 24, 160)?;
    let settings =
        settings(&[("size", "160"), ("steps", "600"), ("refine_steps", "60"), ("prompt_budget", "64")])?;
    let providers = Providers::from_settings(&settings.vision).map_err(segwild_pipeline::RunError::from)?;
    let (mut flow, mut legs) = ([f64::MAX; 2], [f64::MAX; 2]);
    for _ in 0..REPEATS {
        let each = one_after_another(&scene, &dir.join("legs"), &settings, &providers)?;
        let whole = timed(&scene, &fresh(&dir.join("run"))?, &settings, &providers, None)?;
        let sums = [each.iter().map(|l| l.wall).sum::<f64>(), each.iter().map(|l| l.cpu).sum()];
        for (best, now) in flow.iter_mut().zip([whole.wall, whole.cpu]) {
            *best = best.min(now);
        }
        for (best, now) in legs.iter_mut().zip(sums) {
            *best = best.min(now);
        }
    }
    Ok(vec![
        Row {
            name: "cost".into(),
            what: "wall time over that of the stages one after another, all cores busy",
            value: flow[0] / legs[0],
            bar: 1.03,
            from: format!("{:.2} s; one after another {:.2} s", flow[0], legs[0]),
        },
        Row {
            name: "cost, processor".into(),
            what: "processor time over that of the stages one after another",
            value: flow[1] / legs[1],
            bar: 1.03,
            from: format!("{:.2} s; one after another {:.2} s", flow[1], legs[1]),
        },
    ])
}
