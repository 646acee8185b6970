//! Requested appearances: a photo's, interpolated between photos, stronger or weaker, for the scene and for one object.

use crate::RunError;
use segwild_scene::{Export, Scene, Splats};
use segwild_trainer::{Model, SceneLight};
use serde::Serialize;
use std::path::PathBuf;

/// The name of the scene's own appearance, which is the mean over its photos.
pub const OWN: &str = "none";

/// An appearance, or a sequence of them.
#[derive(Clone, Debug, PartialEq)]
pub struct AppearanceRequest {
    /// Names of the photos whose appearances they are; `none` is the scene's own.
    pub photos: Vec<String>,
    /// A photo that is not in the scene, whose appearance follows theirs.
    pub file: Option<PathBuf>,
    /// 0 is the scene's own appearance, 1 the photo's, 2 twice as far from the scene's own.
    pub strength: f32,
}

impl Default for AppearanceRequest {
    fn default() -> Self {
        AppearanceRequest { photos: Vec::new(), file: None, strength: 1.0 }
    }
}

impl AppearanceRequest {
    /// The appearance of one photo.
    pub fn of(photo: &str) -> AppearanceRequest {
        AppearanceRequest { photos: vec![photo.to_owned()], ..AppearanceRequest::default() }
    }

    /// How many appearances it names: several are a sequence.
    pub(crate) fn count(&self) -> usize {
        self.photos.len() + usize::from(self.file.is_some())
    }

    /// The lights of the named photos; none when no photo is named.
    ///
    /// # Errors
    /// When the strength is out of range, a photo is unknown, or a photo took no part in the training.
    pub(crate) fn lights(&self, scene: &Scene, model: &Model) -> Result<Lights, RunError> {
        if !(0.0..=2.0).contains(&self.strength) {
            return Err(RunError::Request(format!("a strength of {} is not from 0 to 2", self.strength)));
        }
        let light = |name: &String| -> Result<SceneLight, RunError> {
            if name == OWN {
                return Ok(model.light(None));
            }
            let view = find(scene, name)?;
            if model.appearance_index(Some(view)) != view {
                let reason = "it took no part in the training";
                return Err(RunError::Request(format!("photo `{name}` has no appearance: {reason}")));
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

/// A sequence of lights.
pub(crate) struct Lights(Vec<SceneLight>);

impl Lights {
    /// Adds a light to the end.
    pub(crate) fn add(&mut self, light: SceneLight) {
        self.0.push(light);
    }

    /// The light at a share of the whole sequence, 0 to 1, interpolated between neighbours; `None` if the sequence is
    /// empty.
    pub(crate) fn at(&self, share: f32) -> Option<SceneLight> {
        let last = self.0.len().checked_sub(1)?;
        let at = share.clamp(0.0, 1.0) * last as f32;
        let k = (at as usize).min(last.saturating_sub(1));
        let next = self.0.get(k + 1).unwrap_or(&self.0[k]);
        Some(self.0[k].towards(next, at - k as f32))
    }
}

/// One appearance between two.
#[derive(Clone, Debug, Default, PartialEq, Serialize, serde::Deserialize)]
pub struct BlendedAppearance {
    /// Photo whose appearance it is; empty for the scene's own.
    pub photo: String,
    /// Photo towards whose appearance it goes; empty for the scene's own.
    #[serde(default)]
    pub towards: String,
    /// How far it goes, 0 to 1.
    #[serde(default)]
    pub share: f32,
}

impl BlendedAppearance {
    /// Its light.
    ///
    /// # Errors
    /// When a photo is unknown or took no part in the training, or the share is out of range.
    pub(crate) fn light(&self, scene: &Scene, model: &Model) -> Result<SceneLight, RunError> {
        if !(0.0..=1.0).contains(&self.share) {
            return Err(RunError::Request(format!("a share of {} is not from 0 to 1", self.share)));
        }
        let named = |photo: &String| if photo.is_empty() { OWN.to_owned() } else { photo.clone() };
        let photos = [&self.photo, &self.towards].map(named).to_vec();
        let lights = AppearanceRequest { photos, ..AppearanceRequest::default() }.lights(scene, model)?;
        Ok(lights.at(self.share).unwrap_or_else(|| model.light(None)))
    }
}

/// The export of a trained scene's splats for other programs.
pub(crate) fn export<'a>(scene: &'a Scene, model: &Model) -> Export<'a> {
    Export { frame: &scene.frame, antialias: model.antialias, extra: &[], provenance: None }
}

/// The appearance of the photo of this name, or the scene's own if it is empty.
pub(crate) fn requested(appearance: &str) -> AppearanceRequest {
    AppearanceRequest::of(if appearance.is_empty() { OWN } else { appearance })
}

/// The splats with colours for other programs: with the appearance of the photo of this name, or the scene's own if it
/// is empty.
pub(crate) fn shown(scene: &Scene, model: &Model, appearance: &str) -> Result<Splats, RunError> {
    let light = requested(appearance).lights(scene, model)?.at(0.0);
    Ok(model.baked(&light.unwrap_or_else(|| model.light(None)).into()))
}
