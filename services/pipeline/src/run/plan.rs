//! Plans a run: makes the choices that the settings leave open, computes the keys, and decides where the training
//! starts and where the run stops.

use super::choice::Chooser;
use super::continued::ContinuedTraining;
use super::options::RunOptions;
use super::prepare::PreparedRun;
use super::stage::Stage;
use super::until::Until;
use crate::artifacts::cache::SNAPSHOT;
use crate::artifacts::keys::{End, Keys, TrainingOrigin};
use crate::transients::{Corrections, KnownTransients};
use crate::{RunError, RunFolder, Settings};
use segwild_flow::ledger::ViewOutcome;
use segwild_flow::{Cache, Key, Phase};
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
