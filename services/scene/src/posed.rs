//! What is known of photos whose poses another program computed.

use crate::Skipped;
use std::path::PathBuf;

/// Photos with poses that another program computed.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedPhotos {
    /// The scene's folder, in which splits and masks are searched.
    pub scene: PathBuf,
    /// The folder of the photos.
    pub photos: PathBuf,
    /// The folder of the reconstruction, in COLMAP's form.
    pub model: PathBuf,
    /// Photos without a pose, and why they have none.
    pub unposed: Vec<Skipped>,
    /// What else is odd about the reconstruction, in words.
    pub notes: Vec<String>,
}
