//! Looks as they are asked for: by photo, between photos, stronger or weaker, on the scene and on one object.

use crate::{RunError, RunFolder, Selected};
use segwild_scene::ply::Export;
use segwild_scene::{Scene, Splats};
use segwild_trainer::{Light, Lighting, Model};
use serde::Serialize;
use std::path::PathBuf;

/// The name that stands for the scene's own look: the mean of its photos' looks.
pub const OWN: &str = "none";

/// A look, or several one after the other.
#[derive(Clone, Debug, PartialEq)]
pub struct AppearanceRequest {
    /// Names of the photos whose looks they are; `none` is the scene's own.
    pub photos: Vec<String>,
    /// 0 is the scene's own look, 1 the photo's, 2 twice as far from the scene's own.
    pub strength: f32,
}

impl Default for AppearanceRequest {
    fn default() -> Self {
        AppearanceRequest { photos: Vec::new(), strength: 1.0 }
    }
}

impl AppearanceRequest {
    /// One photo's look.
    pub fn of(photo: &str) -> AppearanceRequest {
        AppearanceRequest { photos: vec![photo.to_owned()], ..AppearanceRequest::default() }
    }

    /// Whether it is one look, and not a way from one to another.
    pub(crate) fn is_one(&self) -> bool {
        self.photos.len() == 1
    }

    /// The lights that are meant; none when no photo is named.
    pub(crate) fn lights(&self, scene: &Scene, model: &Model) -> Result<Lights, RunError> {
        if !(0.0..=2.0).contains(&self.strength) {
            return Err(RunError::Request(format!("a strength of {} is not from 0 to 2", self.strength)));
        }
        let light = |name: &String| -> Result<Light, RunError> {
            if name == OWN {
                return Ok(model.light(None));
            }
            let view = find(scene, name)?;
            if model.appearance_index(Some(view)) != view {
                let reason = "it took no part in the training, so that its look is not known";
                return Err(RunError::Request(format!("photo `{name}` has no look: {reason}")));
            }
            Ok(model.strengthened(&model.light(Some(view)), self.strength))
        };
        Ok(Lights(self.photos.iter().map(light).collect::<Result<_, _>>()?))
    }
}

/// The index of a photo by its name.
pub(crate) fn find(scene: &Scene, name: &str) -> Result<usize, RunError> {
    scene.view_named(name).ok_or_else(|| {
        let near: Vec<&str> = scene.views.iter().take(5).map(|v| v.name.as_str()).collect();
        let count = scene.views.len();
        RunError::Request(format!(
            "this run has no photo `{name}`; it has {count} photos: {}, ...",
            near.join(", ")
        ))
    })
}

/// Lights one after the other.
pub(crate) struct Lights(Vec<Light>);

impl Lights {
    /// The light at a share of the whole way, 0 to 1; `None` if there are none.
    pub(crate) fn at(&self, share: f32) -> Option<Light> {
        let last = self.0.len().checked_sub(1)?;
        let at = share.clamp(0.0, 1.0) * last as f32;
        let k = (at as usize).min(last.saturating_sub(1));
        let next = self.0.get(k + 1).unwrap_or(&self.0[k]);
        Some(self.0[k].towards(next, at - k as f32))
    }
}

/// What to write as splats that any program shows as they are.
#[derive(Clone, Debug)]
pub struct BakeRequest {
    /// The look.
    pub appearance: AppearanceRequest,
    /// Another look for the selected object.
    pub object_appearance: Option<AppearanceRequest>,
    /// Where between the looks, if two or more are given: 0 is the first, 1 the last.
    pub between: Option<f32>,
    /// The selection that is meant, by name.
    pub selection: Option<String>,
    /// What of the scene is written.
    pub part: Part,
    /// The file.
    pub out: PathBuf,
}

/// A part of the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
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
}

/// Writes the scene, or a part of it, under a look.
pub fn bake(folder: &RunFolder, request: &BakeRequest) -> Result<Baked, RunError> {
    let loaded = folder.load()?;
    let (scene, mut model) = (&loaded.scene, loaded.model);
    let mut whose = vec![false; model.splats.len()];
    match &request.selection {
        Some(name) => {
            let selected = Selected::read(folder, name, model.splats.len())?;
            model.splats = selected.cut_scene(&model.splats);
            whose = selected.labels;
        }
        None if request.object_appearance.is_some() || request.part != Part::Scene => {
            let text = "an object's own look, or a part of the scene, needs --selection NAME";
            return Err(RunError::Request(text.into()));
        }
        None => {}
    }
    if request.part != Part::Scene {
        let wanted = request.part == Part::Only;
        let keep: Vec<usize> = (0..whose.len()).filter(|&i| whose[i] == wanted).collect();
        model.select(&keep);
        whose = vec![wanted; keep.len()];
    }
    let light = |appearance: &AppearanceRequest| -> Result<Option<Light>, RunError> {
        if appearance.photos.len() > 1 && request.between.is_none() {
            return Err(RunError::Request("two looks need --between T, 0 to 1".into()));
        }
        Ok(appearance.lights(scene, &model)?.at(request.between.unwrap_or(0.0)))
    };
    let object = match &request.object_appearance {
        Some(appearance) => light(appearance)?.map(|light| (whose, light)),
        None => None,
    };
    let lighting =
        Lighting { scene: light(&request.appearance)?.unwrap_or_else(|| model.light(None)), object };
    let baked = model.baked(&lighting);
    export(scene, &model).write(&request.out, &baked)?;
    Ok(Baked { file: request.out.clone(), splats: baked.len() })
}

/// How splats of a trained scene are written for other programs.
pub(crate) fn export<'a>(scene: &'a Scene, model: &Model) -> Export<'a> {
    Export { frame: &scene.frame, antialias: model.antialias, extra: &[] }
}

/// The splats as their file shows them: in the scene's own look, or in that of the photo named.
pub(crate) fn shown(scene: &Scene, model: &Model, appearance: &str) -> Result<Splats, RunError> {
    let name = if appearance.is_empty() { OWN } else { appearance };
    let light = AppearanceRequest::of(name).lights(scene, model)?.at(0.0);
    Ok(model.baked(&light.unwrap_or_else(|| model.light(None)).into()))
}
