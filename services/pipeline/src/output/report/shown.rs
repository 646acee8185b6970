//! What the sections of a report share: the size of its images, and which photos it shows.

use crate::artifacts::folder::Loaded;
use crate::{RunError, RunFolder};
use segwild_flow::{FileError, fault};

/// Long side of the images in a report, in pixels at most.
pub(super) const SHOWN: u32 = 360;

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
