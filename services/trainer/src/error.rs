//! Why training cannot go on.

use segwild_raster::RasterError;
use segwild_scene::SceneError;

/// Why training cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A setting is out of range.
    #[error("setting refused: {0}")]
    Setting(String),
    /// No photo can be trained on; each reason is named.
    #[error("no photo to train on: {0}")]
    NoPhotos(String),
    /// One photo cannot be used.
    #[error("photo `{name}`: {reason}")]
    Photo {
        /// Name of the photo.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A checkpoint does not belong to this scene or is damaged.
    #[error("checkpoint refused: {0}")]
    Checkpoint(String),
    /// Imported splats cannot be read.
    #[error(transparent)]
    Splats(Box<SceneError>),
    /// Imported splats do not lie where the poses are.
    #[error("{0}")]
    Frame(String),
    /// A stop was requested.
    #[error("stopped")]
    Stopped,
    /// The rasteriser refused.
    #[error(transparent)]
    Raster(#[from] RasterError),
}

impl From<SceneError> for TrainError {
    fn from(error: SceneError) -> TrainError {
        TrainError::Splats(Box::new(error))
    }
}
