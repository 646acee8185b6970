//! Why poses cannot be computed, with messages for a person.

use segwild_flow::{FileError, ProgramError};
use segwild_scene::SceneError;
use std::path::PathBuf;

/// Why poses cannot be computed.
#[derive(Debug, thiserror::Error)]
pub enum PosesError {
    /// The photos have no poses, and there is no COLMAP.
    #[error(
        "{path} holds photos without poses, and COLMAP, which computes them, is not found on the PATH: install it (Debian, Ubuntu: \
         `apt-get install colmap`; macOS: `brew install colmap`; others: https://colmap.github.io/install.html) and run again",
        path = path.display()
    )]
    NoColmap {
        /// The photos.
        path: PathBuf,
    },
    /// GLOMAP is named by a setting, and there is none.
    #[error(
        "`mapper` is glomap, and there is none for the photos in {path}: COLMAP has no `global_mapper` here, and the \
         program `glomap` is not found on the PATH; install a newer COLMAP or GLOMAP (https://github.com/colmap/glomap), \
         or run again with `--mapper colmap`",
        path = path.display()
    )]
    NoGlomap {
        /// The photos.
        path: PathBuf,
    },
    /// GLOMAP would map photos that are gone.
    #[error(
        "{mapper} maps all photos that {path} holds, and {photos} of them are gone: remove that folder and run again, or run \
         again with `--mapper colmap`",
        path = path.display()
    )]
    GonePhotos {
        /// GLOMAP, as it names itself.
        mapper: String,
        /// The folder of the poses.
        path: PathBuf,
        /// How many photos are gone.
        photos: usize,
    },
    /// The frames of a video cannot be taken without ffmpeg.
    #[error(
        "{path} is a video, and ffmpeg, which takes photos out of it, is not found on the PATH: install it (Debian, Ubuntu: \
         `apt-get install ffmpeg`; macOS: `brew install ffmpeg`) and run again",
        path = path.display()
    )]
    NoFfmpeg {
        /// The video.
        path: PathBuf,
    },
    /// Poses need several photos.
    #[error("{path}: poses cannot be computed of {usable} usable photos: it takes at least 3 that show the same{first}", path = path.display())]
    TooFew {
        /// The photos.
        path: PathBuf,
        /// Photos that can be used.
        usable: usize,
        /// Why the first of the others cannot be used, or empty.
        first: String,
    },
    /// COLMAP found no poses.
    #[error("COLMAP found no poses of the {photos} photos in {path}: {reason}", path = path.display())]
    NoModel {
        /// The photos.
        path: PathBuf,
        /// How many there are.
        photos: usize,
        /// What is missing, and what to do.
        reason: String,
    },
    /// The video has no frames that can be used.
    #[error("{path}: no photo can be taken out of the video: {reason}", path = path.display())]
    Video {
        /// The video.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A program failed, or cannot be started.
    #[error(transparent)]
    Program(ProgramError),
    /// COLMAP's database cannot be read.
    #[error("{path}: {source}; remove the folder and run again", path = path.display())]
    Database {
        /// The database.
        path: PathBuf,
        /// What is wrong.
        source: rusqlite::Error,
    },
    /// The record of what was computed is damaged.
    #[error("{path}: {reason}; remove the folder and run again", path = path.display())]
    Record {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The photos or a model cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A file cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Stopped by the user.
    #[error("stopped; the same command goes on from here")]
    Stopped,
}

impl PosesError {
    /// Whether another mapper may find poses all the same.
    pub(crate) fn is_of_one_mapper(&self) -> bool {
        matches!(self, PosesError::Program(_) | PosesError::Scene(_) | PosesError::GonePhotos { .. })
    }
}

impl From<ProgramError> for PosesError {
    fn from(error: ProgramError) -> PosesError {
        match error {
            ProgramError::Stopped => PosesError::Stopped,
            ProgramError::Log(error) => PosesError::File(error),
            error => PosesError::Program(error),
        }
    }
}
