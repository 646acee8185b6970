//! The normalised frame in which a scene is held.

use glam::DVec3;

/// How the normalised frame lies in the file's: `file = normalised * scale + origin`.
///
/// Computed in f64, so that a scene whose units are 1000 times larger becomes the same normalised scene.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct SceneFrame {
    /// The file's position of the normalised origin (the mean of the camera centres, without those that stand far off).
    pub origin: DVec3,
    /// File units per normalised unit: the scene extent, 1.1 x the largest distance of these cameras from the origin, or less
    /// where the near plane would cut off what photos saw.
    pub scale: f64,
}
