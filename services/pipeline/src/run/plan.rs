//! Plans a run: makes the choices that the settings leave open, computes the keys, and decides where the training
//! starts and where the run stops.

use super::choice::Chooser;
use super::continued::ContinuedTraining;
use super::options::RunOptions;
use super::prepare::PreparedRun;
use super::stage::Stage;
use super::time::{ANY_ENGINE, TimeMeasurement, decided_once};
use super::until::Until;
use crate::artifacts::auto_choice::AutoChoice;
use crate::artifacts::cache::SNAPSHOT;
use crate::artifacts::keys::{End, Keys, TrainingOrigin};
use crate::transients::{Corrections, KnownTransients};
use crate::{RunError, RunFolder, Settings};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{Cache, Key, Phase};
use segwild_trainer::TimeChoice;
use std::sync::Arc;

/// What a run is going to do.
pub struct RunPlan {
    /// The settings, with every choice made.
    pub settings: Settings,
    pub cache: Cache,
    /// The keys of a run that finds every sky.
    pub keys: Keys,
    /// The keys of this training on other engines.
    pub elsewhere: Vec<(&'static str, Key)>,
    /// Where the training starts, if not at step 0.
    pub origin: Option<TrainingOrigin>,
    /// The step of the training to stop after.
    pub steps: u32,
    /// The last stage to run.
    pub last: Stage,
    /// What is known of transients before anything is trained.
    pub known: KnownTransients,
}

/// Plans a prepared run.
///
/// # Errors
/// When a trial training fails, the disk fails, or the run is stopped.
pub fn plan(prepared: &PreparedRun, folder: &RunFolder, options: &RunOptions) -> Result<RunPlan, RunError> {
    let PreparedRun { scene, settings, providers, engine, end, corrections, digests, ledger, .. } = prepared;
    let named = |settings: &Settings, corrections: &Corrections, engine: &str, end: &End| {
        let corrected = corrections.digests();
        let all = options.all_described;
        Keys::of(scene, digests.clone(), settings, providers, &corrected, engine, end, all)
    };
    let name = |settings: &Settings| named(settings, corrections, engine.name(), end);
    let keys = name(settings);
    let cache = folder.cache()?;
    let known = KnownTransients {
        corrections: Arc::new(corrections.clone()),
        network: providers.transients.clone(),
        cache: cache.clone(),
        keys: Arc::new(keys.known_transients.clone()),
    };
    prepared.recorder.cache(&cache);
    let chooser = Chooser {
        folder,
        cache: &cache,
        scene,
        engine,
        sky: &providers.sky,
        steps_open: prepared.steps_open,
        keys: &name,
        stopping: &|| options.stopper.phase() != Phase::Running,
    };
    let settings = chooser.choose(settings, |kind, key, why| {
        // The ledger names it, so that the cache keeps it.
        ledger.record_view(SNAPSHOT, kind, key, &ViewOutcome::cached())?;
        options.events.info(Some(Stage::Geometry.name()), format!("{kind} {why}"));
        Ok(())
    })?;
    let settings = with_time(prepared, folder, options, &cache, settings, &named)?;
    let mut keys = name(&settings);
    // The same training on another engine: it is continued where this engine has no checkpoint.
    let elsewhere = ["cpu", "gpu"].into_iter().filter(|other| *other != engine.name());
    let elsewhere =
        elsewhere.map(|other| (other, named(&settings, corrections, other, end).training)).collect();
    let mut steps = end.step().unwrap_or(settings.train.steps);
    let mut origin = None;
    if let End::Settings = end {
        let named = |corrections: &Corrections, end: &End| named(&settings, corrections, engine.name(), end);
        let continued = ContinuedTraining::find(folder, ledger, &cache, &settings, corrections, &named)?;
        if let Some(continued) = continued {
            continued.remember(folder)?;
            (steps, keys, origin) = (continued.origin.end, continued.keys, Some(continued.origin));
        }
    }
    let last = match options.until {
        Some(Until::Stage(stage)) => stage,
        // A training that is not over has nothing to give to the stages after it.
        Some(Until::Step(step)) if step < settings.train.steps => Stage::Geometry,
        _ => Stage::Report,
    };
    Ok(RunPlan { settings, cache, keys, elsewhere, origin, steps, last, known })
}

/// The settings with what their time buys, if they have one: as it was decided when the run started, or measured now.
fn with_time(
    prepared: &PreparedRun,
    folder: &RunFolder,
    options: &RunOptions,
    cache: &Cache,
    settings: Settings,
    named: &dyn Fn(&Settings, &Corrections, &str, &End) -> Keys,
) -> Result<Settings, RunError> {
    if !TimeChoice::is_open(&settings) {
        return Ok(settings);
    }
    let PreparedRun { scene, providers, engine, end, corrections, digests, ledger, .. } = prepared;
    let keys = named(&settings, corrections, ANY_ENGINE, end);
    let measure = || {
        let words = format!("the speed of this machine is measured, for --time {}", settings.run.time);
        options.events.info(Some(Stage::Geometry.name()), words);
        let measurement = TimeMeasurement {
            scene,
            engine,
            providers,
            lpips: digests.lpips.as_ref().map(|file| &file.lpips),
            keys: &keys,
            steps_open: prepared.steps_open,
            stopping: &|| options.stopper.phase() != Phase::Running,
        };
        measurement.choose(&settings, &|| prepared.began.elapsed().as_secs_f64())
    };
    let (key, choice) = decided_once(cache, &settings, &keys.choice, measure)?;
    // The ledger names it, so that the cache keeps it.
    ledger.record_view(SNAPSHOT, TimeChoice::KIND, &key, &ViewOutcome::cached())?;
    folder.write_json(TimeChoice::FILE, &choice)?;
    options.events.info(Some(Stage::Geometry.name()), choice.why.clone());
    Ok(choice.decided(&settings, prepared.steps_open))
}
