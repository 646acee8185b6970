//! One scene from its photos to its report.

use crate::accelerator::leased;
use crate::artefacts::Keys;
use crate::board::Board;
use crate::coordinator::{Coordinator, State};
use crate::evaluate::{HeldOut, held_out};
use crate::folder::Intake;
use crate::skies::Skies;
use crate::{RunError, RunFolder, Settings, Until, keep, memory, report};
use segwild_flow::{Event, Events, Ledger, Phase, Recorder, Stopper, cpu, files, trace};
use segwild_raster::{CpuEngine, Engine};
use segwild_scene::{Scene, Skipped};
use segwild_vision::Providers;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// The stages, in the order in which they end.
pub const STAGES: [&str; 7] = ["sky", "embed", "masks", "geometry", "features", "evaluate", "report"];

/// What the ledger keeps the step under at which a run was asked to stop.
pub(crate) const UNTIL_STEP: &str = "until step";

/// What a stage waits for: whole stages, but for `masks`, which waits for the snapshot that `geometry` takes on its way.
/// `features` may begin while the last masks are being made.
///
/// ```
/// assert_eq!(segwild_pipeline::needs("features"), ["sky", "embed", "masks", "geometry"]);
/// ```
pub fn needs(stage: &str) -> &'static [&'static str] {
    match stage {
        "masks" => &["geometry"],
        "features" => &["sky", "embed", "masks", "geometry"],
        "evaluate" => &["features"],
        "report" => &["evaluate"],
        _ => &[],
    }
}

/// The stages that an actor works on, in the order in which it comes to them.
pub fn stages_of(actor: &str) -> &'static [&'static str] {
    match actor {
        "masks" => &["sky", "masks"],
        "features" => &["embed", "features"],
        "trainer" => &["geometry"],
        "ingest" => &["sky"],
        "photos" => &["embed"],
        "intrinsic renders" => &["masks"],
        "visibility" => &["features"],
        _ => &[],
    }
}

/// What a run is given beside its settings.
#[derive(Clone)]
pub struct RunOptions {
    /// Told what happens.
    pub events: Events,
    /// Asked whether to stop.
    pub stopper: Stopper,
    /// Providers to use instead of those the settings name.
    pub providers: Option<Providers>,
    /// Where to stop; `None` goes to the end.
    pub until: Option<Until>,
}

impl Default for RunOptions {
    fn default() -> Self {
        RunOptions { events: Events::new(), stopper: Stopper::new(), providers: None, until: None }
    }
}

/// What a run did.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Photos that take part.
    pub photos: usize,
    /// Photos that do not, and why.
    pub skipped: Vec<Skipped>,
    /// Splats of the trained scene.
    pub splats: usize,
    /// The step that the training stands at, when it was asked to stop before its end.
    pub paused_at: Option<u32>,
    /// PSNR on the training photos at the end, in dB.
    pub train_psnr: Option<f32>,
    /// Held-out scores, if photos were held out.
    pub held_out: Option<HeldOut>,
    /// Per-photo artefacts that were made, and that were there.
    pub made: usize,
    /// Per-photo artefacts that were in the cache.
    pub cached: usize,
    /// Wall time in seconds.
    pub wall_s: f64,
    /// Most memory that the process held, in bytes, if the system tells.
    pub peak_bytes: Option<u64>,
    /// Where each actor's time went, a line each.
    pub actors: String,
}

/// Runs a scene's stages, or what is left of them.
pub fn run(
    scene: &Path,
    folder: &RunFolder,
    settings: &Settings,
    options: &RunOptions,
) -> Result<Summary, RunError> {
    let settings = &settings.anchored();
    let began = Instant::now();
    let ledger = Ledger::open(folder.ledger())?;
    let record = ledger.clone();
    let _sink = options
        .events
        .sink("ledger", move |event| {
            if let Err(error) = record.record_event(event) {
                tracing::warn!("an event could not be recorded: {error}");
            }
        })
        .map_err(|e| files::FileError::new("start the event recorder of", folder.path(), e))?;
    folder.remove_litter();
    let recorder = Recorder::start(&ledger, &options.events)
        .map_err(|e| files::FileError::new("start the live view of", folder.path(), e))?;
    folder.write("segwild.toml", settings.to_toml().as_bytes())?;
    let mut named: Vec<(&str, String)> = Settings::catalogue()
        .iter()
        .flat_map(|(_, _, fields)| fields.iter())
        .map(|f| (f.name, settings.get(f.name).unwrap_or_default()))
        .collect();
    // Beside the settings, for the names of what is made depend on it.
    if let Some(Until::Step(step)) = options.until {
        named.push((UNTIL_STEP, step.to_string()));
    }
    ledger.set_settings(named.iter().map(|(n, v)| (*n, v.as_str())))?;

    let path = std::path::absolute(scene).unwrap_or_else(|_| scene.to_owned());
    let scene = Arc::new(Scene::open(&path, &settings.scene)?);
    for skipped in &scene.skipped {
        options
            .events
            .warn(Some("ingest"), format!("photo {} is left out: {}", skipped.name, skipped.reason));
    }
    let names =
        |test: bool| scene.views.iter().filter(move |v| !test || v.test).map(|v| v.name.clone()).collect();
    let mut intake = Intake {
        scene: path,
        photos: names(false),
        held_out: names(true),
        skipped: scene.skipped.clone(),
        points: scene.points.len(),
        frame: scene.frame,
    };
    folder.write_json("scene.json", &intake)?;
    options.events.info(
        Some("ingest"),
        format!(
            "{} photos ({} held out), {} points",
            intake.photos.len(),
            intake.held_out.len(),
            intake.points
        ),
    );

    let settings = &memory::within_budget(settings, &scene)?;
    let providers = match &options.providers {
        Some(providers) => providers.clone(),
        None => Providers::from_settings(&settings.vision)?,
    };
    let providers = leased(&providers);
    for note in &providers.notes {
        options.events.info(None, note.clone());
    }
    let engine: Arc<dyn Engine> = Arc::new(CpuEngine::default());
    let steps = match options.until {
        Some(Until::Step(step)) => step,
        _ => settings.train.steps,
    };
    let keys = Keys::new(&scene, settings, &providers, engine.name(), Some(steps));
    let cache = folder.cache()?;
    recorder.cache(&cache);
    let last = match options.until {
        Some(Until::Stage(stage)) => STAGES.iter().position(|s| *s == stage).unwrap_or(STAGES.len()),
        // A training that is not over has nothing to give to the stages after it.
        Some(Until::Step(step)) if step < settings.train.steps => 3,
        _ => STAGES.len(),
    };
    let (size, sky_keys) = (settings.scene.size, keys.sky.clone());
    let skies = Skies::new(
        scene.clone(),
        size,
        cache.clone(),
        sky_keys,
        providers.sky.clone(),
        options.events.clone(),
    );
    let mut coordinator = Coordinator {
        folder,
        settings,
        options,
        ledger: &ledger,
        recorder: &recorder,
        scene: scene.clone(),
        engine,
        full_keys: keys.clone(),
        keys,
        cache,
        last,
        steps,
        skies: Arc::new(skies),
        masks_known: Arc::new(Board::new("masks")),
        tainted: Arc::default(),
        state: State::default(),
    };
    // A stop that comes while actors are still being started is a stop like any other.
    let stopped = |error| match error {
        RunError::Spawn(spawn) if spawn.is_stopping() => RunError::Interrupted,
        other => other,
    };
    let (report, outcome) = coordinator.flow(&providers).map_err(stopped)?;
    let outcome = outcome.map_err(stopped);
    let mut state = std::mem::take(&mut coordinator.state);
    folder.write("timeline.json", serde_json::to_string(&report).unwrap_or_default().as_bytes())?;
    let run = folder.path().file_name().map_or("run".into(), |n| n.to_string_lossy());
    for (name, trace) in
        [("trace.json", trace::chrome(&report, &run)), ("trace.otlp.json", trace::otlp(&report, &run))]
    {
        folder.write(name, trace.as_bytes())?;
    }
    // An actor that gave up has stopped the others; that is not a stop by the user.
    let gave_up = report.failures().next().map(|(actor, error)| (stage_of(actor), error.to_owned()));
    match (outcome, gave_up) {
        (Ok(()) | Err(RunError::Interrupted), Some((stage, reason))) => {
            ledger.fail_stage(stage, &coordinator.keys.stage(stage), &reason)?;
            ledger.leave_stages()?;
            options.events.tell(Event::StageFailed { stage: stage.into(), error: reason.clone() });
            return Err(RunError::Stage { stage, reason });
        }
        (Err(RunError::Interrupted), None) => {
            ledger.leave_stages()?;
            return Err(RunError::Interrupted);
        }
        (Err(error), _) => return Err(error),
        (Ok(()), None) => {}
    }
    if options.stopper.phase() != Phase::Running {
        ledger.leave_stages()?;
        return Err(RunError::Interrupted);
    }
    if state.paused.is_some() {
        ledger.leave_stages()?;
    }
    intake.skipped.append(&mut state.skipped);
    folder.write_json("scene.json", &intake)?;

    let model = state.model.clone();
    let mut scores = None;
    if let Some(model) = &model
        && last >= 5
    {
        let key = coordinator.keys.stage("evaluate");
        let known = folder.read_json::<HeldOut>("evaluation.json").ok();
        if ledger.stage_is_done("evaluate", &key)? && (known.is_some() || intake.held_out.is_empty()) {
            options.events.tell(Event::StageSkipped { stage: "evaluate".into(), key: key.to_string() });
            scores = known.filter(|_| !intake.held_out.is_empty());
        } else {
            ledger.begin_stage("evaluate", &key)?;
            let progress = options.events.stage("evaluate", None);
            let skies = coordinator.skies.clone();
            let sky = move |view: usize| skies.read(view).map_err(|lost| lost.to_string());
            scores = held_out(folder, &scene, model, &*coordinator.engine, settings, sky)?;
            coordinator.intact()?;
            progress.finish();
            ledger.finish_stage("evaluate", &key, None)?;
        }
    }
    let (key, cache) = (coordinator.keys.stage("report"), coordinator.cache.clone());
    let (splats, train_psnr) = model.as_ref().map_or((None, None), |m| (Some(m.splats.len()), m.stats.psnr));
    // The report reads the run folder anew; what the run held for itself goes first.
    drop((coordinator, scene, model));
    if last >= 6 && splats.is_some() {
        ledger.begin_stage("report", &key)?;
        let progress = options.events.stage("report", None);
        report::write_report(folder)?;
        progress.finish();
        ledger.finish_stage("report", &key, None)?;
    }
    if settings.run.cache_limit > 0 {
        let swept = keep::sweep(&ledger, &cache, settings.run.cache_limit << 20, false)?;
        if swept.files > 0 {
            let mib = swept.bytes as f64 / f64::from(1 << 20);
            options.events.info(
                None,
                format!("{} files ({mib:.1} MiB) of earlier settings left the cache", swept.files),
            );
        }
    }
    Ok(Summary {
        photos: intake.photos.len(),
        skipped: intake.skipped,
        splats: splats.unwrap_or(0),
        paused_at: state.paused,
        train_psnr,
        held_out: scores,
        made: state.made,
        cached: state.cached,
        wall_s: began.elapsed().as_secs_f64(),
        peak_bytes: cpu::peak_memory(),
        actors: trace::summary(&report),
    })
}

/// The stage that an actor's failure is booked on.
fn stage_of(actor: &str) -> &'static str {
    match actor {
        "trainer" => "geometry",
        "features" | "visibility" => "features",
        "photos" => "embed",
        "ingest" => "sky",
        _ => "masks",
    }
}
