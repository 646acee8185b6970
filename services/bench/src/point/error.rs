//! Why a point cannot be measured.

use segwild_eval::protocols::ProtocolError;
use segwild_eval::trial::TrialError;
use segwild_pipeline::RunError;
use segwild_scene::SceneError;
use std::path::PathBuf;

/// Why a point cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum PointError {
    /// Training or scoring failed.
    #[error(transparent)]
    Trial(#[from] TrialError),
    /// A folder has no true mask that can be shown to the program.
    #[error(
        "{0} has no mask in `truth/` that covers a tenth of a percent of its photo: there is nothing to score"
    )]
    NoTruth(PathBuf),
    /// The folder of true masks cannot be read.
    #[error(transparent)]
    Truth(Box<ProtocolError>),
    /// A process of its own could not be started, or did not answer.
    #[error("a point was not measured: {0}")]
    Child(String),
}

impl From<RunError> for PointError {
    fn from(error: RunError) -> PointError {
        TrialError::from(error).into()
    }
}

impl From<ProtocolError> for PointError {
    fn from(error: ProtocolError) -> PointError {
        PointError::Truth(Box::new(error))
    }
}

impl From<SceneError> for PointError {
    fn from(error: SceneError) -> PointError {
        TrialError::from(error).into()
    }
}
