//! What comes before a training: the search for initial transients, and stereo initialisation. It lies above `trainer.rs`:
//! the search makes trainers of its own.

use crate::colours::coloured;
use crate::initial_transients::initial_transients;
use crate::photos::Photos;
use crate::stereo_points;
use crate::trainer::{Trainer, photo_cache};
use crate::{TrainError, TrainSettings};
use segwild_objective::Engine;
use segwild_objective::transients::ResidualHistograms;
use segwild_scene::Scene;
use std::sync::Arc;

impl Trainer {
    /// As [`Trainer::new`], after a search for initial transients by [`TrainSettings::cross_checks`] other trainings, and after stereo
    /// initialisation ([`TrainSettings::stereo`]); `stopping` ends these.
    pub fn prepared(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        settings: TrainSettings,
        stopping: &dyn Fn() -> bool,
    ) -> Result<Trainer, TrainError> {
        settings.check()?;
        let settings = settings.decided(scene);
        let mut cache = photo_cache(scene, photos, &settings);
        let scene = &*coloured(scene, &mut cache, stopping)?;
        let found = initial_transients(&engine, scene, &mut cache, &settings, stopping)?;
        let stereo = stereo_points::points(scene, &mut cache, &settings, &found.masks, stopping)?;
        let robust = ResidualHistograms::new(found.robust_shares(&settings), found.shares.clone());
        let mut trainer = Trainer::start(engine, scene, cache, settings, 0, &stereo)?;
        trainer.initial_transient_share = found.mean_share();
        trainer.state.initial_transients = found.masks;
        trainer.state.robust = robust;
        trainer.stereo_count = stereo.len();
        Ok(trainer)
    }
}
