//! The appearance of a photo that is not in the scene.

use crate::artifacts::folder::Loaded;
use crate::output::light::{AppearanceRequest, Lights};
use crate::{RunError, Settings};
use segwild_raster::Rasterizer;
use segwild_scene::{Scene, load_photo};
use segwild_trainer::{AppearanceModel, ForeignLight, Model, TrainPhoto};
use segwild_vision::{Providers, VisionSettings};

/// What a file's appearance is fitted to.
pub(crate) struct FittedScene<'a> {
    pub engine: &'a dyn Rasterizer,
    pub scene: &'a Scene,
    pub model: &'a Model,
    pub settings: &'a Settings,
}

impl<'a> FittedScene<'a> {
    /// The trained scene of a run.
    pub fn of(loaded: &'a Loaded, engine: &'a dyn Rasterizer) -> FittedScene<'a> {
        let Loaded { scene, model, settings, .. } = loaded;
        FittedScene { engine, scene, model, settings }
    }

    /// The lights of a request for `shown`, which has all of the model's splats or some of them; that of a file comes last.
    ///
    /// # Errors
    /// As [`AppearanceRequest::lights`]; also when the file is no photo, nothing in it resembles the scene, or the photos of the run
    /// have one light.
    pub fn lights(&self, request: &AppearanceRequest, shown: &Model) -> Result<Lights, RunError> {
        let mut lights = request.lights(self.scene, shown)?;
        let Some(file) = &request.file else { return Ok(lights) };
        if self.settings.train.appearance_model == AppearanceModel::None {
            let text = "--appearance-from: the photos of this run have one light (`--appearance-model none`), and so has the scene";
            return Err(RunError::Request(text.into()));
        }
        let image = load_photo(file, self.settings.scene.size)?;
        // Settings in a run folder name no network that may be loaded: the built-in detector finds the sky.
        let sky = Providers::from_settings(&VisionSettings::default())?.sky.sky(&image)?;
        let photo = TrainPhoto { image, valid: None, sky: Some(sky), transients: None };
        let fitted = ForeignLight::of(self.model, self.engine, self.scene, &photo)?;
        lights.add(shown.strengthened(&shown.foreign_light(&fitted), request.strength));
        Ok(lights)
    }
}
