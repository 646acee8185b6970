//! Poses of a scene compared with its points, before a training (method, section 3).

use crate::TrainSettings;
use crate::refined_pose::{RefinedBy, RefinedPose};
use crate::resection::{resect, seen_points};
use segwild_scene::Scene;

/// Deviation up to which a pose is good, as a share of the photo's long side: 1.3 px of 640. Usual reconstructions have less.
pub(crate) const GOOD: f32 = 0.002;
/// Deviations of the pose by points that the given one is off by, at least: less is noise of where photos saw points.
const SIGNIFICANT: f32 = 3.0;
/// A given pose fits its points up to so many times the residual of the pose by points: false matches among few points move that
/// one, and hardly better it.
const MISFITS: f32 = 2.0;
/// Median residual of the points from which they are no evidence of a pose, likewise.
const MISFIT: f32 = 0.008;

/// What the points say of the poses of a scene.
pub(crate) struct PosesByPoints {
    /// Per view, its pose by the points, where the given one is not as good.
    pub refined: Vec<Option<RefinedPose>>,
    /// Per view, whether the points leave its pose open.
    pub open: Vec<bool>,
}

impl PosesByPoints {
    /// Compares the poses of a scene with its points.
    pub fn of(scene: &Scene, settings: &TrainSettings) -> PosesByPoints {
        let n = scene.views.len();
        let mut poses = PosesByPoints { refined: vec![None; n], open: vec![false; n] };
        if !settings.refine_poses {
            return poses;
        }
        for (view, seen) in seen_points(scene).iter().enumerate() {
            let of = &scene.views[view];
            match resect(&of.camera, &of.pose, seen) {
                Some(found) if found.deviation <= GOOD && found.residual <= MISFIT => {
                    let fits = found.given_residual <= GOOD.max(MISFITS * found.residual);
                    let off = found.motion > GOOD.max(SIGNIFICANT * found.deviation);
                    poses.refined[view] = (off && !fits)
                        .then(|| RefinedPose::new(&found.pose, found.motion, RefinedBy::Points));
                }
                _ => poses.open[view] = true,
            }
        }
        poses
    }
}
