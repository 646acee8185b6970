//! Prepares a run: opens its ledger, its scene, the providers and the engine, and examines the photos.

use super::diagnostics;
use super::examine::examine_photos;
use super::memory;
use super::options::RunOptions;
use super::poses::{self, OpenedScene};
use super::time::fits_time;
use super::until::Until;
use crate::accelerator::leased;
use crate::artifacts::blocks;
use crate::artifacts::cameras;
use crate::artifacts::digests::Digests;
use crate::artifacts::folder::Intake;
use crate::artifacts::images::ImageFiles;
use crate::artifacts::keys::End;
use crate::artifacts::lpips::LpipsFile;
use crate::artifacts::photo_cache::RunPhotoCache;
use crate::artifacts::region_cache::InCache;
use crate::code;
use crate::engine::{ChosenEngine, choose_engine};
use crate::transients::Corrections;
use crate::transients::authorship;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::{Ledger, Phase, Recorder, Sink, files};
use segwild_objective::Engine;
use segwild_poses::PoseSpan;
use segwild_scene::{Scene, SceneError, Skipped};
use segwild_trainer::AppearanceModel;
use segwild_vision::Providers;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Name under which the ledger keeps the step that a run is to stop at.
pub const UNTIL_STEP: &str = "until step";

/// The opened inputs of a run.
pub struct PreparedRun {
    pub began: Instant,
    /// When this process computed poses.
    pub pose_spans: Vec<PoseSpan>,
    pub recorder: Recorder,
    /// Records events in the ledger until it is dropped.
    _sink: Sink,
    pub ledger: Ledger,
    pub scene: Arc<Scene>,
    /// Its photos in the run's cache.
    pub photos: Arc<RunPhotoCache>,
    pub intake: Intake,
    /// The settings, with what the scene and the memory budget decide.
    pub settings: Settings,
    /// Whether the number of steps was left to the scene.
    pub steps_open: bool,
    pub providers: Providers,
    pub engine: Arc<dyn Engine>,
    pub end: End,
    pub corrections: Corrections,
    pub digests: Digests,
}

/// Opens the inputs of a run and writes down what it was given.
///
/// # Errors
/// When an input cannot be used, the disk fails, another process uses the run, or the run is stopped.
pub fn prepare(
    scene: &Path,
    folder: &RunFolder,
    settings: &Settings,
    options: &RunOptions,
) -> Result<PreparedRun, RunError> {
    let settings = &settings.anchored();
    let (began, events) = (Instant::now(), &options.events);
    let lost = lost_ledger(folder);
    let ledger = Ledger::open(folder.ledger())?;
    let record = ledger.clone();
    let sink = events
        .sink("ledger", move |event| {
            if let Err(error) = record.record_event(event) {
                tracing::warn!("an event could not be recorded: {error}");
            }
        })
        .map_err(|e| files::FileError::new("start the event recorder of", folder.path(), e))?;
    if let Some(words) = lost {
        events.warn(None, words);
    }
    folder.remove_litter();
    let recorder = Recorder::start(&ledger, events)
        .map_err(|e| files::FileError::new("start the live view of", folder.path(), e))?;
    let path = std::path::absolute(scene).unwrap_or_else(|_| scene.to_owned());
    let OpenedScene { scene, posed, spans } = poses::open(&path, folder, settings, &ledger, options)?;
    let scene = Arc::new(scene);
    ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()))
        .fit(&folder.path().join(authorship::FOLDER))?;
    folder.belongs_to(&path, &scene)?;
    fits_import(&scene, settings, options.until)?;
    let recorded = blocks::of(folder);
    fits_time(&scene, settings, recorded)?;
    LpipsFile::needed(settings)?;
    // Written only now: a setting that the scene refuses must not come back with the next run.
    folder.write("segwild.toml", settings.to_toml().as_bytes())?;
    record_settings(&ledger, settings, options.until)?;
    for words in Skipped::in_words(&scene.skipped).into_iter().chain(scene.notes.iter().cloned()) {
        events.warn(Some("ingest"), words);
    }
    let mut intake = Intake { posed, ..intake_of(&path, &scene) };
    folder.write_intake(&intake)?;
    // A trained scene has written those that it was trained with.
    if !folder.path().join("model.bin").is_file() {
        cameras::write(folder, &scene)?;
    }
    events.info(
        Some("ingest"),
        format!(
            "{} photos ({} held out), {} points",
            intake.photos.len(),
            intake.held_out.len(),
            intake.points
        ),
    );

    let steps_open = settings.steps_open(&scene);
    let blocks_open = settings.train.blocks == 0 && scene.imported.is_none();
    let divided = memory::with_blocks(settings, &scene, recorded);
    let decided = divided.decided(&scene);
    if decided.train.blocks < divided.train.blocks {
        let words = "the scene is trained as a whole and not in --blocks: its cameras and points are too few, or lie \
                     at one position";
        events.warn(Some("geometry"), words);
    }
    memory::fits_records(&decided, &scene)?;
    let mut settings = memory::within_budget(&decided, &scene)?;
    if blocks_open {
        if let Some(words) = memory::blocks_in_words(recorded, settings.train.blocks) {
            events.info(Some("geometry"), words);
        }
        blocks::write(folder, settings.train.blocks)?;
    }
    let providers = providers_of(folder, &settings, options)?;
    settings.allow_remote_calls(providers.remote_calls);
    intake.provider.clone_from(&providers.name);
    for note in &providers.notes {
        events.info(None, note.clone());
    }
    let engine = engine_of(&settings, &scene, options)?;
    let corrections = Corrections::find(&scene, folder, &settings.scene.transient_masks)?;
    for words in corrections.put_damaged_aside()? {
        events.warn(Some("ingest"), words);
    }
    if let Some(words) = corrections.in_words(&scene) {
        events.info(Some("ingest"), words);
    }
    let photos = Arc::new(RunPhotoCache::new(folder.cache()?, &scene, settings.scene.size));
    photos.warn_of_damage(events);
    let digests = examine(&path, &scene, &photos, &settings, &corrections, options)?;
    let end = Until::end(options.until);
    Ok(PreparedRun {
        began,
        pose_spans: spans,
        recorder,
        _sink: sink,
        ledger,
        scene,
        photos,
        intake,
        settings,
        steps_open,
        providers,
        engine,
        end,
        corrections,
        digests,
    })
}

/// Refuses what imported splats cannot have.
fn fits_import(scene: &Scene, settings: &Settings, until: Option<Until>) -> Result<(), RunError> {
    if scene.imported.is_none() {
        return Ok(());
    }
    let refused = match (settings.train.appearance_model, until) {
        (model @ (AppearanceModel::Embed | AppearanceModel::Gsw), _) => {
            format!(
                "--appearance-model {model} trains the splats, and imported ones stay as they are: none or affine"
            )
        }
        (_, Some(Until::Step(_))) => "imported splats are not trained: --until takes a stage".to_owned(),
        _ => return Ok(()),
    };
    Err(RunError::Request(refused))
}

/// Records the settings in the ledger, for `--explain`.
fn record_settings(ledger: &Ledger, settings: &Settings, until: Option<Until>) -> Result<(), RunError> {
    let mut named: Vec<(&str, String)> = Settings::catalogue()
        .iter()
        .flat_map(|(_, _, fields)| fields.iter())
        .map(|f| (f.name, settings.get(f.name).unwrap_or_default()))
        .collect();
    // Kept beside the settings, since keys depend on it.
    if let Some(Until::Step(step)) = until {
        named.push((UNTIL_STEP, step.to_string()));
    }
    Ok(ledger.set_settings(named.iter().map(|(n, v)| (*n, v.as_str())))?)
}

fn intake_of(path: &Path, scene: &Scene) -> Intake {
    let names =
        |test: bool| scene.views.iter().filter(move |v| !test || v.test).map(|v| v.name.clone()).collect();
    Intake {
        scene: path.to_owned(),
        posed: false,
        photos: names(false),
        held_out: names(true),
        skipped: scene.skipped.clone(),
        points: scene.points.len(),
        frame: scene.frame,
        provider: String::new(),
        undescribed: 0,
    }
}

/// Opens the 2D models, and records the files of those that are networks.
fn providers_of(
    folder: &RunFolder,
    settings: &Settings,
    options: &RunOptions,
) -> Result<Providers, RunError> {
    let providers = match &options.providers {
        Some(providers) => providers.clone(),
        None => Providers::keeping(&settings.vision, Some(Arc::new(InCache(folder.cache()?))))?,
    };
    let providers = leased(&providers);
    for changed in code::record(folder, &providers.networks)? {
        options.events.warn(None, format!("{changed}; what depends on it is made again"));
    }
    Ok(providers)
}

fn engine_of(settings: &Settings, scene: &Scene, options: &RunOptions) -> Result<Arc<dyn Engine>, RunError> {
    let events = options.events.clone();
    let ChosenEngine { engine, why, longest_array } =
        choose_engine(&settings.run, move |lost| events.warn(None, lost))?;
    if let Some(longest_array) = longest_array {
        memory::fits_accelerator(settings, scene, longest_array)?;
    }
    options.events.info(None, format!("splats are computed by {why}"));
    if engine.name() == "gpu" && settings.train.lambda_lpips > 0.0 {
        let words = "LPIPS is computed on the CPU: with --lambda-lpips each step's render is read back, and the splats learn there";
        options.events.warn(None, words);
    }
    if engine.name() == "gpu" && settings.train.blocks > 1 {
        let words = "blocks are trained from the host: with --blocks each step's gradients are read back, and the \
                     splats learn there";
        options.events.warn(None, words);
    }
    Ok(engine)
}

/// Reads every photo once, and warns of what is odd.
fn examine(
    path: &Path,
    scene: &Scene,
    photos: &Arc<RunPhotoCache>,
    settings: &Settings,
    corrections: &Corrections,
    options: &RunOptions,
) -> Result<Digests, RunError> {
    let stopping = || options.stopper.phase() != Phase::Running;
    let digest = |view: usize| photos.digest(view);
    let digests = examine_photos(&photos.store(0), &digest, settings, corrections, &stopping)?;
    if let Some(first) = digests.nothing_left(scene) {
        let reason = format!("no photo can be trained on; of the first: {first}");
        return Err(SceneError::NothingUsable { path: path.to_owned(), reason }.into());
    }
    for odd in &digests.odd {
        options.events.warn(Some("ingest"), odd.clone());
    }
    for warning in diagnostics::diagnose(scene).into_iter().chain(diagnostics::copies(scene, &digests.all()))
    {
        options.events.warn(Some("ingest"), warning);
    }
    Ok(digests)
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
