//! The records of a reconstruction, as its files hold them.

use crate::lens::CameraModel;

/// One line of `cameras`.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraRecord {
    /// What images refer to.
    pub id: u32,
    /// The camera model.
    pub model: CameraModel,
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

/// Whether a feature is kept: by the id of its image, its index there, and itself.
pub(super) type KeepFeature<'a> = dyn FnMut(u32, u32, Keypoint) -> bool + 'a;

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
