//! COLMAP reconstructions: reading and writing `cameras`, `images` and `points3D`, binary and text.
//!
//! The records are as the files hold them, in the file's units, unchecked beyond their form: which photos can be
//! used is decided by [`crate::Scene::open`].

mod binary;
mod text;

pub use crate::lens::Model;
pub use binary::write;
pub use text::write_text;

use crate::SceneError;
use std::path::{Path, PathBuf};

/// One line of `cameras`.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraRecord {
    /// What images refer to.
    pub id: u32,
    /// The camera model.
    pub model: Model,
    /// Width of the photos in pixels.
    pub width: u64,
    /// Height of the photos in pixels.
    pub height: u64,
    /// The model's parameters, in COLMAP's order.
    pub params: Vec<f64>,
}

/// One detected feature of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    /// Position in pixels of the photo as taken.
    pub pixel: [f64; 2],
    /// The 3D point it belongs to, if any.
    pub point: Option<u64>,
}

/// One photo of `images`.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageRecord {
    /// What tracks refer to.
    pub id: u32,
    /// World-to-camera rotation, quaternion (w, x, y, z).
    pub rotation: [f64; 4],
    /// World-to-camera translation.
    pub translation: [f64; 3],
    /// Its camera.
    pub camera_id: u32,
    /// File name relative to the photo folder.
    pub name: String,
    /// Its features.
    pub keypoints: Vec<Keypoint>,
}

/// One point of `points3D`.
#[derive(Clone, Debug, PartialEq)]
pub struct PointRecord {
    /// What keypoints refer to.
    pub id: u64,
    /// Position.
    pub position: [f64; 3],
    /// sRGB.
    pub colour: [u8; 3],
    /// Mean reprojection error in pixels.
    pub error: f64,
    /// Who saw it: image id and index of the keypoint in that image.
    pub track: Vec<(u32, u32)>,
}

/// A whole reconstruction.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Reconstruction {
    /// The cameras.
    pub cameras: Vec<CameraRecord>,
    /// Numbers of cameras whose model is not known here, and its name; their photos cannot be used.
    pub unknown_cameras: Vec<(u32, String)>,
    /// The photos.
    pub images: Vec<ImageRecord>,
    /// The points.
    pub points: Vec<PointRecord>,
}

/// Where a reconstruction is looked for inside a scene folder.
pub const PLACES: [&str; 5] = ["sparse/0", "sparse", "dense/sparse", "dense/sparse/0", "."];

/// The first of [`PLACES`] that holds `cameras` and `images`, both `.bin` or both `.txt`.
pub fn find(scene: &Path) -> Option<PathBuf> {
    PLACES.iter().map(|place| if *place == "." { scene.to_owned() } else { scene.join(place) }).find(|dir| {
        ["bin", "txt"]
            .iter()
            .any(|e| ["cameras", "images"].iter().all(|f| dir.join(format!("{f}.{e}")).is_file()))
    })
}

/// Reads a reconstruction from the folder that holds its files; `.bin` is preferred to `.txt`.
/// A folder without `points3D` gives no points.
pub fn read(dir: &Path) -> Result<Reconstruction, SceneError> {
    if dir.join("cameras.bin").is_file() && dir.join("images.bin").is_file() {
        binary::read(dir)
    } else {
        text::read(dir)
    }
}
