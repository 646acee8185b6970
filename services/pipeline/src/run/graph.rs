//! Runs the stages of one scene, from its photos to its report.

use crate::accelerator::leased;
use crate::artifacts::cache;
use crate::artifacts::folder::Intake;
use crate::artifacts::images::ImageFiles;
use crate::artifacts::keys::{Digests, End, Keys};
use crate::artifacts::recompute::Recompute;
use crate::artifacts::region_cache::InCache;
use crate::artifacts::traces::Traces;
use crate::code;
use crate::output::evaluate::{HeldOut, held_out};
use crate::output::report;
use crate::run::choice::Chooser;
use crate::run::continued::ContinuedTraining;
use crate::run::coordinator::{Coordinator, CoordinatorState};
use crate::run::diagnostics;
use crate::run::memory;
use crate::run::skies::Skies;
use crate::run::view_slots::ViewSlots;
use crate::transients::authorship;
use crate::transients::{Corrections, KnownTransients, TrainFit};
use crate::{ChosenEngine, RunError, RunFolder, Settings, Until, choose_engine};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{ActorFailure, Cache, Event, Events, Ledger, Phase, Recorder, Stopper, cpu, files, trace};
use segwild_masks::{MaskMaker, sasm};
use segwild_scene::{Scene, Skipped};
use segwild_vision::Providers;
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

/// The stages, in the order in which they end.
pub const STAGES: [&str; 8] =
    ["sky", "embed", "masks", "geometry", "features", "evaluate", "objects", "report"];

/// Name under which the ledger keeps the step that a run is to stop at.
pub(crate) const UNTIL_STEP: &str = "until step";

/// What a stage waits for: whole stages, but for `masks`, which waits for the snapshot that `geometry` takes on its way.
/// `features` may start while the last masks are being made.
///
/// ```
/// assert_eq!(segwild_pipeline::needs("features"), ["sky", "embed", "masks", "geometry"]);
/// ```
pub fn needs(stage: &str) -> &'static [&'static str] {
    match stage {
        "masks" => &["geometry"],
        "features" => &["sky", "embed", "masks", "geometry"],
        "evaluate" => &["features"],
        "objects" => &["geometry"],
        "report" => &["evaluate", "objects"],
        _ => &[],
    }
}

/// The position of a stage in [`STAGES`].
pub(crate) fn position_of(stage: &str) -> usize {
    STAGES.iter().position(|s| *s == stage).unwrap_or(STAGES.len())
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
        "visibility" => &["features", "objects"],
        _ => &[],
    }
}

/// What a run is given beside its settings.
#[derive(Clone)]
pub struct RunOptions {
    /// Receives progress, messages and warnings.
    pub events: Events,
    /// Says when to stop.
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
    /// Photos that do not take part, and why.
    pub skipped: Vec<Skipped>,
    /// Who makes the masks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// Splats of the trained scene.
    pub splats: usize,
    /// The step that the training stands at, when it was to stop before its end.
    pub paused_at: Option<u32>,
    /// How the scene fits the photos that it was trained on; `None` where the run ended before they were compared.
    pub train_fit: Option<TrainFit>,
    /// Held-out scores, if photos were held out.
    pub held_out: Option<HeldOut>,
    /// Per-photo artefacts that were made.
    pub made: usize,
    /// Per-photo artefacts that were in the cache.
    pub cached: usize,
    /// Wall time in seconds.
    pub wall_s: f64,
    /// Peak memory of the process in bytes, if the system reports it.
    pub peak_bytes: Option<u64>,
    /// How each actor spent its time, a line each.
    pub actors: String,
}

/// Runs a scene's stages, or those that are not done yet.
///
/// # Errors
/// When an input cannot be used, a stage fails, the disk fails, or the run is stopped ([`RunError`]).
pub fn run(
    scene: &Path,
    folder: &RunFolder,
    settings: &Settings,
    options: &RunOptions,
) -> Result<Summary, RunError> {
    let settings = &settings.anchored();
    let began = Instant::now();
    let lost = lost_ledger(folder);
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
    if let Some(words) = lost {
        options.events.warn(None, words);
    }
    folder.remove_litter();
    let recorder = Recorder::start(&ledger, &options.events)
        .map_err(|e| files::FileError::new("start the live view of", folder.path(), e))?;
    let path = std::path::absolute(scene).unwrap_or_else(|_| scene.to_owned());
    let scene = Arc::new(Scene::open(&path, &settings.scene)?);
    ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()))
        .fit(&folder.path().join(authorship::FOLDER))?;
    folder.belongs_to(&path, &scene)?;
    // Written only now: a setting that the scene refuses must not come back with the next run.
    folder.write("segwild.toml", settings.to_toml().as_bytes())?;
    let mut named: Vec<(&str, String)> = Settings::catalogue()
        .iter()
        .flat_map(|(_, _, fields)| fields.iter())
        .map(|f| (f.name, settings.get(f.name).unwrap_or_default()))
        .collect();
    // Kept beside the settings, since keys depend on it.
    if let Some(Until::Step(step)) = options.until {
        named.push((UNTIL_STEP, step.to_string()));
    }
    ledger.set_settings(named.iter().map(|(n, v)| (*n, v.as_str())))?;
    for words in Skipped::in_words(&scene.skipped).into_iter().chain(scene.notes.iter().cloned()) {
        options.events.warn(Some("ingest"), words);
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
        provider: String::new(),
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

    let steps_open = settings.train.steps == 0;
    let settings = &memory::within_budget(&settings.decided(&scene), &scene)?;
    let providers = match &options.providers {
        Some(providers) => providers.clone(),
        None => Providers::keeping(&settings.vision, Some(Arc::new(InCache(folder.cache()?))))?,
    };
    let providers = leased(&providers);
    for changed in code::record(folder, &providers.networks)? {
        options.events.warn(None, format!("{changed}; what depends on it is made again"));
    }
    intake.provider.clone_from(&providers.name);
    for note in &providers.notes {
        options.events.info(None, note.clone());
    }
    let events = options.events.clone();
    let ChosenEngine { engine, why } = choose_engine(&settings.run, move |lost| events.warn(None, lost))?;
    if engine.name() == "gpu" {
        memory::fits_accelerator(settings, &scene)?;
    }
    options.events.info(None, format!("splats are computed by {why}"));
    let end = End::of(options.until);
    let corrections = Corrections::find(&scene, folder, &settings.scene.transient_masks)?;
    for words in corrections.put_damaged_aside()? {
        options.events.warn(Some("ingest"), words);
    }
    if let Some(words) = corrections.in_words(&scene) {
        options.events.info(Some("ingest"), words);
    }
    let stopping = || options.stopper.phase() != Phase::Running;
    let digests = Digests::read(&scene, settings, &stopping)?.without(&corrections);
    if let Some(first) = digests.nothing_left(&scene) {
        let reason = format!("no photo can be trained on; of the first: {first}");
        return Err(segwild_scene::SceneError::NothingUsable { path: intake.scene, reason }.into());
    }
    for odd in &digests.odd {
        options.events.warn(Some("ingest"), odd.clone());
    }
    for warning in
        diagnostics::diagnose(&scene).into_iter().chain(diagnostics::copies(&scene, &digests.all()))
    {
        options.events.warn(Some("ingest"), warning);
    }
    let named = |settings: &Settings, corrections: &Corrections, engine: &str, end: &End| {
        Keys::of(&scene, digests.clone(), settings, &providers, corrections, engine, end)
    };
    let name = |settings: &Settings| named(settings, &corrections, engine.name(), &end);
    let keys = name(settings);
    let cache = folder.cache()?;
    let known = KnownTransients {
        corrections: Arc::new(corrections.clone()),
        network: providers.transients.clone(),
        cache: cache.clone(),
        keys: Arc::new(keys.known_transients.clone()),
    };
    recorder.cache(&cache);
    let chooser = Chooser {
        folder,
        cache: &cache,
        scene: &scene,
        engine: &engine,
        sky: &providers.sky,
        steps_open,
        keys: &name,
        stopping: &|| options.stopper.phase() != Phase::Running,
    };
    let settings = &chooser.choose(settings, |kind, key, why| {
        // The ledger names it, so that the cache keeps it.
        ledger.record_view(cache::SNAPSHOT, kind, key, &ViewOutcome::cached())?;
        options.events.info(Some("geometry"), format!("{kind} {why}"));
        Ok(())
    })?;
    let mut keys = name(settings);
    // The same training on another engine: it is continued where this engine has no checkpoint.
    let elsewhere = ["cpu", "gpu"].into_iter().filter(|other| *other != engine.name()).map(|other| {
        let keys = named(settings, &corrections, other, &end);
        (other, keys.training)
    });
    let elsewhere = elsewhere.collect();
    let mut steps = end.step().unwrap_or(settings.train.steps);
    let mut origin = None;
    if let End::Settings = end {
        let named = |corrections: &Corrections, end: &End| named(settings, corrections, engine.name(), end);
        let continued = ContinuedTraining::find(folder, &ledger, &cache, settings, &corrections, &named)?;
        if let Some(continued) = continued {
            continued.remember(folder)?;
            (steps, keys, origin) = (continued.origin.end, continued.keys, Some(continued.origin));
        }
    }
    let last = match options.until {
        Some(Until::Stage(stage)) => position_of(stage),
        // A training that is not over has nothing to give to the stages after it.
        Some(Until::Step(step)) if step < settings.train.steps => position_of("geometry"),
        _ => STAGES.len(),
    };
    let names = Arc::new(Mutex::new(keys.clone()));
    warn_of_damage(&cache, &names, &scene, &options.events);
    let size = settings.scene.size;
    let recompute = Recompute { scene: scene.clone(), cache: cache.clone(), events: options.events.clone() };
    let skies = Skies::new(recompute, size, keys.sky.clone(), providers.sky.clone());
    let maker = MaskMaker {
        scene: scene.clone(),
        size,
        proposer: providers.proposer.clone(),
        settings: settings.masks.clone(),
        depths: sasm::SceneDepths::of(&scene),
    };
    let mut coordinator = Coordinator {
        folder,
        settings,
        options,
        ledger: &ledger,
        recorder: &recorder,
        scene: scene.clone(),
        engine,
        full_keys: keys.clone(),
        elsewhere,
        origin,
        keys,
        names,
        cache,
        last,
        steps,
        skies: Arc::new(skies),
        known,
        segmenter: providers.segmenter.clone(),
        embedder: providers.embedder.clone(),
        maker: Arc::new(maker),
        masks_known: Arc::new(ViewSlots::new("masks")),
        tainted: Arc::default(),
        state: CoordinatorState::default(),
    };
    // A stop while actors are still being started is a stop like any other.
    let stopped = |error| match error {
        RunError::Spawn(spawn) if spawn.is_stopping() => RunError::Interrupted,
        other => other,
    };
    let traces = Traces::start(folder)?;
    let (mut report, outcome) = coordinator.flow(&providers).map_err(stopped)?;
    let outcome = outcome.map_err(stopped);
    let mut state = std::mem::take(&mut coordinator.state);
    traces.write(&report)?;
    // An actor that gave up has stopped the others: that is not a stop by the user.
    let failed =
        |(actor, error): (&str, &str), kind: fn(&str) -> ActorFailure| (stage_of(actor), kind(error));
    let gave_up = (coordinator.skies.lost().map(|lost| ("sky", lost)))
        .or_else(|| Some(failed(report.storage_failure()?, |error| ActorFailure::storage(error))))
        .or_else(|| Some(failed(report.failures().next()?, |error| ActorFailure::fatal(error))));
    match (outcome, gave_up) {
        (Ok(()) | Err(RunError::Interrupted), Some((stage, failure))) => {
            let reason = failure.to_string();
            ledger.fail_stage(stage, &coordinator.keys.stage(stage), &reason)?;
            ledger.leave_stages()?;
            options.events.tell(Event::StageFailed { stage: stage.into(), error: reason.clone() });
            return Err(RunError::of_stage(stage, &failure));
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
        && coordinator.wants("evaluate")
    {
        let key = coordinator.keys.stage("evaluate");
        let known = folder.read_json::<HeldOut>("evaluation.json").ok();
        if ledger.stage_is_done("evaluate", &key)? && (known.is_some() || intake.held_out.is_empty()) {
            options.events.tell(Event::StageSkipped { stage: "evaluate".into(), key: key.to_string() });
            scores = known.filter(|_| !intake.held_out.is_empty());
        } else {
            ledger.start_stage("evaluate", &key)?;
            let progress = options.events.stage("evaluate", None);
            let skies = coordinator.skies.clone();
            let sky = move |view: usize| skies.read(view).map_err(|lost| lost.to_string());
            let mut unscored = BTreeSet::new();
            let scored = traces.step(&mut report, "evaluate", || {
                let usable = |view: usize| coordinator.keys.unreadable(view).is_none();
                held_out(
                    folder,
                    &scene,
                    model,
                    &*coordinator.engine,
                    settings,
                    usable,
                    sky,
                    |view, scored| {
                        let name = &scene.views[view].name;
                        let outcome = match scored {
                            Ok(seconds) => ViewOutcome::done(seconds),
                            Err(reason) => {
                                unscored.insert(view);
                                let message = format!("photo {name} is not scored: {reason}");
                                options.events.warn(Some("evaluate"), message);
                                ViewOutcome::failed(1, reason)
                            }
                        };
                        Ok(ledger.record_view("evaluate", name, &key, &outcome)?)
                    },
                )
            });
            if let Some(lost) = coordinator.skies.lost() {
                return Err(RunError::of_stage("sky", &lost));
            }
            scores = scored?;
            coordinator.intact()?;
            progress.finish();
            ledger.finish_stage("evaluate", &coordinator.keys.evaluation_without(&unscored), None)?;
        }
    }
    if let Some(model) = &model
        && coordinator.wants("objects")
    {
        traces.step(&mut report, "objects", || coordinator.list_objects(model))?;
    }
    if let Some(words) = model.as_ref().and_then(|m| m.stats.psnr).and_then(diagnostics::unlike) {
        options.events.warn(Some("geometry"), words);
    }
    let learnt = TrainFit::of(folder).map(|fit| fit.psnr).zip(scores.as_ref().map(|s| s.psnr));
    if let Some(words) = learnt.and_then(|(train, held)| diagnostics::overfitted(train, held)) {
        options.events.warn(Some("evaluate"), words);
    }
    let (key, cache) = (coordinator.keys.stage("report"), coordinator.cache.clone());
    let splats = model.as_ref().map(|m| m.splats.len());
    let reports = coordinator.wants("report");
    // The report reads the run folder again: the run's own data is freed first.
    drop((coordinator, scene, model));
    if reports && splats.is_some() {
        ledger.start_stage("report", &key)?;
        let progress = options.events.stage("report", None);
        for left_out in traces.step(&mut report, "report", || report::write_report(folder))? {
            options.events.warn(
                Some("report"),
                format!("photo {} is not shown whole in the report: {}", left_out.name, left_out.reason),
            );
        }
        traces.write(&report)?;
        progress.finish();
        ledger.finish_stage("report", &key, None)?;
    }
    if settings.run.cache_limit > 0 {
        let swept = cache::sweep(&ledger, &cache, settings.run.cache_limit << 20, false)?;
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
        provider: intake.provider,
        splats: splats.unwrap_or(0),
        paused_at: state.paused,
        train_fit: splats.and_then(|_| TrainFit::of(folder)),
        held_out: scores,
        made: state.made,
        cached: state.cached,
        wall_s: began.elapsed().as_secs_f64(),
        peak_bytes: cpu::peak_memory(),
        actors: trace::summary(&report),
    })
}

/// The warning about a run whose ledger is empty or has gone, if the run has made something before.
fn lost_ledger(folder: &RunFolder) -> Option<String> {
    let ledger = folder.ledger();
    let found = match std::fs::metadata(&ledger) {
        Ok(data) if data.len() > 0 => return None,
        Ok(_) => "is empty",
        Err(_) => "has gone",
    };
    let holds = |path: &Path| std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_some());
    let made = holds(&folder.path().join("cache")) || holds(&folder.checkpoints());
    made.then(|| {
        format!(
            "{} {found}: its record of earlier runs (stages, times, events) is lost; the cache and the checkpoints are \
             kept and used",
            ledger.display()
        )
    })
}

/// Makes the cache warn of each damaged artefact, with its kind and photo.
fn warn_of_damage(cache: &Cache, names: &Arc<Mutex<Keys>>, scene: &Arc<Scene>, events: &Events) {
    let (names, scene, events) = (names.clone(), scene.clone(), events.clone());
    cache.on_damage(move |key, reason| {
        let kind = key.split(':').next().unwrap_or(key);
        let stage = match kind {
            "embedding" => "embed",
            "visibility" => "features",
            "history" | "snapshot" => "geometry",
            other => other,
        };
        let photo = names
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .view_of(key)
            .map_or(String::new(), |view| format!(" of photo {}", scene.views[view].name));
        let message = format!("the cache's {kind} record{photo} was damaged ({reason}): it is made again");
        events.warn(Some(stage), message);
    });
}

/// The stage that an actor's failure counts for.
fn stage_of(actor: &str) -> &'static str {
    match actor {
        "trainer" => "geometry",
        "features" | "visibility" => "features",
        "photos" => "embed",
        "ingest" => "sky",
        _ => "masks",
    }
}
