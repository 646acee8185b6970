//! Splats with an appearance, for programs without appearance models: the scene, a selection, or the scene without it.

use crate::output::foreign_photo::FittedScene;
use crate::output::light::{AppearanceRequest, export};
use crate::output::without::SceneWithout;
use crate::{ExportFormat, RunError, RunFolder, Selected, choose_engine, log_loss};
use segwild_flow::Stopper;
use segwild_objective::Engine;
use segwild_raster::CpuEngine;
use segwild_trainer::{SceneLight, SceneLighting};
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;

/// What to write as splats that any program shows as they are.
#[derive(Clone, Debug)]
pub struct BakeRequest {
    /// The appearance.
    pub appearance: AppearanceRequest,
    /// Another appearance for the selected object.
    pub object_appearance: Option<AppearanceRequest>,
    /// Where to interpolate, if two or more appearances are given: 0 is the first, 1 the last.
    pub interpolate: Option<f32>,
    /// Name of the selection.
    pub selection: Option<String>,
    /// What of the scene is written.
    pub part: ScenePart,
    /// The file; its ending names the format.
    pub out: PathBuf,
}

/// A part of the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScenePart {
    /// All of it.
    Scene,
    /// The selection.
    Only,
    /// All but the selection.
    Without,
}

/// A file that was written.
#[derive(Clone, Debug, Serialize)]
pub struct Baked {
    /// The file.
    pub file: PathBuf,
    /// Splats in it.
    pub splats: usize,
    /// Of a scene without an object: the share of what the object covers in the photos that no photo saw, in [0, 1].
    pub unseen: Option<f32>,
}

/// Writes the scene, or a part of it, with an appearance.
///
/// # Errors
/// When the run is not trained yet, the request does not fit the run, the file's ending names no format, its program is missing or
/// fails, it cannot be written, or `stopper` stops it.
pub fn bake(folder: &RunFolder, request: &BakeRequest, stopper: &Stopper) -> Result<Baked, RunError> {
    let writer = ExportFormat::of(&request.out)?.writer()?;
    let loaded = folder.load()?;
    // Most files need no render: they are written where the run's accelerator is not.
    let engine: Arc<dyn Engine> =
        match request.part == ScenePart::Without || request.appearance.file.is_some() {
            true => choose_engine(&loaded.settings.run, log_loss)?.engine,
            false => Arc::new(CpuEngine::default()),
        };
    let (scene, mut model) = (&loaded.scene, loaded.model.clone());
    let mut whose = vec![false; model.splats.len()];
    match &request.selection {
        Some(name) => {
            let selected = Selected::read(folder, name, model.splats.len())?;
            model.splats = selected.cut_scene(&model.splats).into();
            whose = selected.labels;
        }
        None if request.object_appearance.is_some() || request.part != ScenePart::Scene => {
            let text = "an appearance of the object, or a part of the scene, needs --selection NAME";
            return Err(RunError::Request(text.into()));
        }
        None => {}
    }
    let mut unseen = None;
    if request.part != ScenePart::Scene {
        let keep = if request.part == ScenePart::Only {
            (0..whose.len()).filter(|&i| whose[i]).collect()
        } else {
            let (splats, size) = ((&*model.splats, model.options()), loaded.settings.scene.size);
            let without = SceneWithout::of_run(&*engine, folder, scene, splats, &whose, size)?;
            unseen = Some(without.unseen_share(&*engine, scene, size)?);
            without.keep
        };
        model.select(&keep);
        whose = vec![request.part == ScenePart::Only; keep.len()];
    }
    let fitted = FittedScene::of(&loaded, &*engine);
    let light = |appearance: &AppearanceRequest| -> Result<Option<SceneLight>, RunError> {
        if appearance.count() > 1 && request.interpolate.is_none() {
            return Err(RunError::Request("two appearances need --interpolate T, 0 to 1".into()));
        }
        Ok(fitted.lights(appearance, &model)?.at(request.interpolate.unwrap_or(0.0)))
    };
    let object = match &request.object_appearance {
        Some(appearance) => light(appearance)?.map(|light| (whose, light)),
        None => None,
    };
    let objects = object.into_iter().collect();
    let lighting =
        SceneLighting { scene: light(&request.appearance)?.unwrap_or_else(|| model.light(None)), objects };
    let baked = model.baked(&lighting);
    writer.write(&export(scene, &model), &request.out, &baked, stopper)?;
    Ok(Baked { file: request.out.clone(), splats: baked.len(), unseen })
}
