//! What comes before a training: poses by points, the search for initial transients, and stereo initialisation. It lies above `trainer.rs`:
//! the search makes trainers of its own.

use crate::colours::coloured;
use crate::initial_transients::initial_transients;
use crate::photos::Photos;
use crate::poses_by_points::PosesByPoints;
use crate::preparation_progress::{PreparationPart, PreparationProgress};
use crate::refined_pose::with_poses;
use crate::stereo_points;
use crate::trainer::{Trainer, photo_cache};
use crate::{TrainError, TrainSettings};
use segwild_objective::Engine;
use segwild_objective::transients::ResidualHistograms;
use segwild_scene::Scene;
use std::sync::Arc;

impl Trainer {
    /// As [`Trainer::new`], after a search for initial transients by [`TrainSettings::cross_checks`] other trainings, and after stereo
    /// initialisation ([`TrainSettings::stereo`]). `follow` receives how far these are, and returns whether to stop.
    pub fn prepared(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        settings: TrainSettings,
        follow: &dyn Fn(PreparationProgress) -> bool,
    ) -> Result<Trainer, TrainError> {
        settings.check()?;
        let requested = settings.blocks;
        let settings = settings.decided(scene);
        let poses = PosesByPoints::of(scene, &settings);
        let mut cache = photo_cache(scene, photos, &settings);
        let refined = with_poses(scene, &poses.refined);
        let part = |part| move |done, total| follow(PreparationProgress { part, done, total });
        let start = &*coloured(&refined, &mut cache, &part(PreparationPart::PointColours))?;
        let found = initial_transients(&engine, start, &mut cache, &settings, follow)?;
        let stereo = stereo_points::points(
            start,
            &mut cache,
            &settings,
            &found.masks,
            &part(PreparationPart::Stereo),
        )?;
        let robust = ResidualHistograms::new(found.robust_shares(&settings), found.shares.clone());
        let mut trainer = Trainer::start(engine, start, cache, settings, 0, &stereo)?
            .with_poses(scene, poses)
            .divided(requested, scene, &start.points);
        trainer.initial_transient_share = found.mean_share();
        trainer.state.initial_transients = found.masks;
        trainer.state.robust = robust;
        trainer.stereo_count = stereo.len();
        Ok(trainer)
    }
}
