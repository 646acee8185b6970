//! Camera poses other than the given ones (method, section 3).

use glam::{Mat3, Vec3};
use segwild_scene::{Pose, Scene};
use std::borrow::Cow;
use wincode::{SchemaRead, SchemaWrite};

/// How a pose was refined.
#[derive(Clone, Copy, Debug, PartialEq, Eq, SchemaRead, SchemaWrite)]
pub enum RefinedBy {
    /// By the points of the reconstruction that the photo saw.
    Points,
    /// By the photo itself, compared with renders of the splats.
    Photo,
}

/// A refined camera pose: world to camera.
#[derive(Clone, Copy, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct RefinedPose {
    /// Rotation, column by column.
    rotation: [f32; 9],
    translation: [f32; 3],
    /// Root mean square of how far what the photo shows moves by the refinement, as a share of its long side.
    pub motion: f32,
    /// What refined it.
    pub by: RefinedBy,
}

impl RefinedPose {
    pub(crate) fn new(pose: &Pose, motion: f32, by: RefinedBy) -> RefinedPose {
        let (rotation, translation) = (pose.rotation.to_cols_array(), pose.translation.to_array());
        RefinedPose { rotation, translation, motion, by }
    }

    /// The pose.
    pub fn pose(&self) -> Pose {
        Pose { rotation: Mat3::from_cols_array(&self.rotation), translation: Vec3::from(self.translation) }
    }

    /// Whether it is a rotation and a finite translation: one that comes out of a file may be damaged.
    pub(crate) fn is_sound(&self) -> bool {
        let Pose { rotation, translation } = self.pose();
        let apart = rotation.transpose() * rotation - Mat3::IDENTITY;
        translation.is_finite() && apart.to_cols_array().iter().all(|v| v.abs() < 1e-3)
    }
}

/// A scene with refined poses.
pub(crate) fn with_poses<'a>(scene: &'a Scene, refined: &[Option<RefinedPose>]) -> Cow<'a, Scene> {
    if refined.iter().all(Option::is_none) {
        return Cow::Borrowed(scene);
    }
    let mut scene = scene.clone();
    for (view, refined) in scene.views.iter_mut().zip(refined) {
        if let Some(refined) = refined {
            view.pose = refined.pose();
        }
    }
    Cow::Owned(scene)
}
