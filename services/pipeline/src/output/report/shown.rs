//! What the sections of a report share: the size of its images, and which photos it shows.

use crate::artifacts::folder::Loaded;
use crate::{RunError, RunFolder};
use segwild_flow::{FileError, fault};
use segwild_scene::{LoadedPhoto, SceneError};

/// Long side of the images in a report, in pixels at most.
pub(super) const SHOWN: u32 = 360;

/// A photo at the size of the images. The run's store has photos at the size of the training, so that this one is decoded again.
///
/// # Errors
/// When it cannot be read any more.
pub(super) fn small_photo(loaded: &Loaded, view: usize) -> Result<LoadedPhoto, SceneError> {
    loaded.scene.views[view].load(loaded.settings.scene.size.min(SHOWN))
}

/// Some views, evenly over the list.
pub(super) fn spread(loaded: &Loaded, count: usize) -> Vec<usize> {
    let n = loaded.scene.views.len();
    let count = count.min(n);
    (0..count).map(|k| k * n / count).collect()
}

/// The fault point after an image of the report.
pub(super) fn pass(folder: &RunFolder) -> Result<(), RunError> {
    Ok(fault::point("report.image").map_err(|e| FileError::new("write", &folder.report(), e))?)
}
