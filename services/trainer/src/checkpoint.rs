//! What a training hands over: checkpoints, to continue from, and the scene.

use crate::appearances;
use crate::colours::coloured;
use crate::model::{Model, Stats};
use crate::photos::Photos;
use crate::posed::posed;
use crate::poses_by_points::PosesByPoints;
use crate::refined_pose::with_poses;
use crate::schedule::Schedule;
use crate::state::{TrainState, mean_quality};
use crate::trainer::{Trainer, photo_cache};
use crate::{TrainError, TrainSettings};
use segwild_objective::{AnyAppearance, Engine};
use segwild_scene::Scene;
use std::borrow::Cow;
use std::sync::Arc;
use wincode::{SchemaRead, SchemaWrite};

/// A training that can be continued: with the same scene, photos and settings it ends in the same bytes as
/// one that never stopped.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Checkpoint {
    /// The settings, name and value.
    settings: Vec<(String, String)>,
    /// Names of the scene's views.
    names: Vec<String>,
    state: TrainState,
}

impl Checkpoint {
    /// Steps done.
    pub fn step(&self) -> u32 {
        self.state.step
    }

    /// The scene as it was then, if the checkpoint is whole.
    ///
    /// # Errors
    /// When it does not fit itself: it may come from elsewhere.
    pub fn model(&self) -> Result<Model, TrainError> {
        self.state.check(self.names.len())?;
        let settings = settings_of(&self.settings)?;
        Ok(model_of(&self.state, self.names.clone(), &settings))
    }
}

/// The settings of a checkpoint.
fn settings_of(named: &[(String, String)]) -> Result<TrainSettings, TrainError> {
    use segwild_scene::settings::Group;
    let mut settings = TrainSettings::default();
    for (name, value) in named {
        settings.set(name, value).map_err(|e| TrainError::Checkpoint(e.to_string()))?;
    }
    settings.check()?;
    Ok(settings)
}

/// The scene of a training's state. Views are named by `names`.
fn model_of(state: &TrainState, names: Vec<String>, settings: &TrainSettings) -> Model {
    let views = state.trained_views(settings.blocks, |view| names[view].as_str());
    let mut appearance = state.appearance.clone();
    let known = (0..names.len()).filter(|&v| state.backgrounds[v].is_some());
    appearances::set_mean(&mut appearance, names.len(), known);
    if let AnyAppearance::Gsw(appearance) = &mut appearance {
        appearance.forget_training();
    }
    Model {
        splats: Arc::new(state.params.splats.clone()),
        splat_embeddings: state.params.splat_embeddings.clone(),
        appearance,
        backgrounds: state.backgrounds.clone(),
        names,
        trained_on: views.iter().map(|&v| v as u32).collect(),
        transient_shares: state.robust.shares().to_vec(),
        transient_evidence: state.robust.evidence().to_vec(),
        refined_poses: state.refined.clone(),
        antialias: settings.antialias,
        stats: Stats { step: state.step, psnr: mean_quality(&views, &state.quality) },
    }
}

impl Trainer {
    /// Continues from a checkpoint of the same scene, with the settings it was made with.
    pub fn resume(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        checkpoint: Checkpoint,
    ) -> Result<Trainer, TrainError> {
        Trainer::resume_unless(engine, scene, photos, checkpoint, &|| false)
    }

    /// The same; `stopping` ends the search for the colours of points, which reads photos.
    pub(crate) fn resume_unless(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        checkpoint: Checkpoint,
        stopping: &dyn Fn() -> bool,
    ) -> Result<Trainer, TrainError> {
        let settings = settings_of(&checkpoint.settings)?;
        let names: Vec<String> = scene.views.iter().map(|v| v.name.clone()).collect();
        if names != checkpoint.names {
            let odd = names.iter().zip(&checkpoint.names).find(|(a, b)| a != b);
            let reason = match odd {
                Some((here, there)) => format!("it has photo `{there}` where the scene has `{here}`"),
                None => format!("it has {} photos, the scene {}", checkpoint.names.len(), names.len()),
            };
            return Err(TrainError::Checkpoint(reason));
        }
        checkpoint.state.check(scene.views.len())?;
        let mut photos = photo_cache(scene, photos, &settings);
        let schedule = Schedule::new(&settings);
        let state = checkpoint.state;
        // Points' colours are needed at the first step of a photo, and where a block starts. They are those of the start of
        // the training, which found them by the poses that its points refined.
        let unseen = state.sampler.views().iter().any(|&view| state.backgrounds[view].is_none());
        let shown = if (unseen || settings.blocks > 1) && scene.colourless().is_some() {
            let refined = PosesByPoints::of(scene, &settings).refined;
            let points =
                coloured(&with_poses(scene, &refined), &mut photos, &|_, _| stopping())?.points.clone();
            Cow::Owned(Scene { points, ..scene.clone() })
        } else {
            Cow::Borrowed(scene)
        };
        let requested = settings.blocks;
        let trainer = Trainer::of_state(engine, settings, schedule, posed(&shown), photos, state);
        Ok(trainer.divided(requested, scene, &shown.points))
    }

    /// Everything needed to continue later.
    pub fn checkpoint(&mut self) -> Result<Checkpoint, TrainError> {
        self.download()?;
        use segwild_scene::settings::Group;
        let settings = TrainSettings::FIELDS
            .iter()
            .map(|f| (f.name.to_owned(), self.settings.get(f.name).expect("a field of the group")))
            .collect();
        let names = self.views.iter().map(|v| v.name.clone()).collect();
        Ok(Checkpoint { settings, names, state: self.state.clone() })
    }

    /// The scene as it is now.
    pub fn snapshot(&mut self) -> Result<Model, TrainError> {
        self.download()?;
        let names = self.views.iter().map(|v| v.name.clone()).collect();
        Ok(model_of(&self.state, names, &self.settings))
    }

    /// Does the steps that are left, then hands the scene over.
    pub fn finish(mut self) -> Result<Model, TrainError> {
        while !self.is_done() {
            self.step()?;
        }
        self.snapshot()
    }
}
