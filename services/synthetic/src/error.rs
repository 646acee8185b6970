//! Why a set cannot be made or written.

use segwild_scene::SceneError;

/// Why a set cannot be made or written.
#[derive(Debug, thiserror::Error)]
pub enum SyntheticError {
    /// An option is out of its range.
    #[error("{0}")]
    Options(String),
    /// No camera position shows enough of the scene.
    #[error("seed {seed}: no camera position was found for photo {index}; choose another seed")]
    NoViewpoint {
        /// The seed.
        seed: u64,
        /// The photo within its split.
        index: usize,
    },
    /// Who follows the writing stopped it.
    #[error("stopped after {written} of {photos} photos; the same command goes on from there")]
    Stopped {
        /// Photos that were written.
        written: usize,
        /// Photos of the set.
        photos: usize,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
}
