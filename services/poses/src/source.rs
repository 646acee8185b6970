//! What poses are computed of: a folder of photos, or a video.

use segwild_scene::{SceneError, SceneSettings, UnposedPhotos};
use std::path::{Path, PathBuf};

/// Endings of videos, in small letters.
const VIDEOS: [&str; 9] = ["mp4", "mov", "m4v", "mkv", "webm", "avi", "mts", "m2ts", "3gp"];

/// What poses are computed of.
#[derive(Clone, Debug, PartialEq)]
pub enum PoseSource {
    /// Photos.
    Photos {
        /// The scene's folder.
        scene: PathBuf,
        /// Its photos.
        photos: UnposedPhotos,
    },
    /// A video.
    Video(PathBuf),
}

impl PoseSource {
    /// What stands at a path that is no scene; `None` where it is neither a folder with photos nor a video.
    ///
    /// # Errors
    /// The folder cannot be read.
    pub fn of(path: &Path, settings: &SceneSettings) -> Result<Option<PoseSource>, SceneError> {
        if path.is_dir() {
            let found = UnposedPhotos::find(path, settings)?;
            return Ok(found.map(|photos| PoseSource::Photos { scene: path.to_owned(), photos }));
        }
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let is_video = path.is_file() && VIDEOS.contains(&ending.as_str());
        Ok(is_video.then(|| PoseSource::Video(path.to_owned())))
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        match self {
            PoseSource::Photos { photos, .. } => &photos.folder,
            PoseSource::Video(path) => path,
        }
    }
}
