//! One scene from its photos to its report.

use crate::artefacts::Keys;
use crate::board::Board;
use crate::coordinator::{Coordinator, State};
use crate::evaluate::{HeldOut, held_out};
use crate::folder::Intake;
use crate::{RunError, RunFolder, Settings, report};
use segwild_flow::{Events, Key, Ledger, Phase, Stopper, files};
use segwild_raster::{CpuEngine, Engine};
use segwild_scene::{Scene, Skipped};
use segwild_vision::Providers;
use serde::Serialize;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// The stages, in the order in which they end.
pub const STAGES: [&str; 7] = ["sky", "embed", "masks", "geometry", "features", "evaluate", "report"];

/// What a run is given beside its settings.
#[derive(Clone)]
pub struct RunOptions {
    /// Told what happens.
    pub events: Events,
    /// Asked whether to stop.
    pub stopper: Stopper,
    /// Providers to use instead of those the settings name.
    pub providers: Option<Providers>,
    /// Stop after this stage of [`STAGES`].
    pub until: Option<String>,
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
    folder.write("segwild.toml", settings.to_toml().as_bytes())?;
    let named: Vec<(&str, String)> = Settings::catalogue()
        .iter()
        .flat_map(|(_, _, fields)| fields.iter())
        .map(|f| (f.name, settings.get(f.name).unwrap_or_default()))
        .collect();
    ledger.set_settings(named.iter().map(|(n, v)| (*n, v.as_str())))?;

    let providers = match &options.providers {
        Some(providers) => providers.clone(),
        None => Providers::from_settings(&settings.vision)?,
    };
    for note in &providers.notes {
        options.events.info(None, note.clone());
    }
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

    let engine: Arc<dyn Engine> = Arc::new(CpuEngine::default());
    let keys = Keys::new(&scene, settings, &providers, engine.name())?;
    let cache = folder.cache()?;
    let last =
        options.until.as_deref().and_then(|u| STAGES.iter().position(|s| *s == u)).unwrap_or(STAGES.len());
    let mut coordinator = Coordinator {
        folder,
        settings,
        options,
        ledger: &ledger,
        scene: scene.clone(),
        engine,
        keys,
        cache,
        last,
        board: Arc::new(Board::new()),
        state: State::default(),
    };
    let (report, outcome) = coordinator.flow(&providers)?;
    let mut state = std::mem::take(&mut coordinator.state);
    folder.write("timeline.json", serde_json::to_string(&report).unwrap_or_default().as_bytes())?;
    outcome?;
    if options.stopper.phase() != Phase::Running {
        return Err(RunError::Interrupted);
    }
    intake.skipped.append(&mut state.skipped);
    folder.write_json("scene.json", &intake)?;

    let model = state.model.clone();
    let mut scores = None;
    if let Some(model) = &model
        && last >= 5
    {
        let key = Key::of("evaluate").key("geometry", &coordinator.keys.geometry).finish();
        ledger.begin_stage("evaluate", &key)?;
        let progress = options.events.stage("evaluate", None);
        scores = held_out(folder, &scene, model, &*coordinator.engine, settings, &coordinator.board)?;
        progress.finish();
        ledger.finish_stage("evaluate", &key, None)?;
    }
    if last >= 6 && model.is_some() {
        let key = Key::of("report").key("features", &coordinator.keys.features).finish();
        ledger.begin_stage("report", &key)?;
        let progress = options.events.stage("report", None);
        report::write_report(folder)?;
        progress.finish();
        ledger.finish_stage("report", &key, None)?;
    }
    Ok(Summary {
        photos: intake.photos.len(),
        skipped: intake.skipped,
        splats: model.as_ref().map_or(0, |m| m.splats.len()),
        train_psnr: model.as_ref().and_then(|m| m.stats.psnr),
        held_out: scores,
        made: state.made,
        cached: state.cached,
        wall_s: began.elapsed().as_secs_f64(),
    })
}
