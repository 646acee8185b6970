//! A reconstruction as its files give it, before anything is checked against the photos.

use crate::colmap::{self, ImageRecord};
use crate::lens::{Lens, LensError};
use crate::photo_files::LocateError;
use crate::ply;
use crate::split::Split;
use crate::{DecodeError, SceneError};
use glam::{DMat3, DQuat, DVec3};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A reconstruction in one form, whatever its files were.
#[derive(Debug, Default)]
pub(crate) struct Draft {
    pub photos: Vec<DraftPhoto>,
    pub points: Vec<DraftPoint>,
    /// Notes on what is odd about it, though it can be used.
    pub notes: Vec<String>,
    /// The split that its own files give.
    pub split: Option<Split>,
    /// The file or folder it was read from.
    pub source: PathBuf,
}

/// One photo; fields that cannot be used hold the reason.
#[derive(Debug)]
pub(crate) struct DraftPhoto {
    pub name: String,
    /// Its file, if the reconstruction names one, or why it is missing; `None`: it is searched by name.
    pub file: Option<Result<PathBuf, LocateError>>,
    /// Its mask of the pixels to use, if the reconstruction names one.
    pub usable: Option<PathBuf>,
    pub lens: Result<Lens, DraftLensError>,
    pub pose: Result<DraftPose, PoseError>,
}

/// Why a photo of a reconstruction has no lens.
#[derive(Clone, Debug, thiserror::Error)]
pub(crate) enum DraftLensError {
    /// Its camera's parameters are those of no lens.
    #[error(transparent)]
    Lens(#[from] LensError),
    #[error("there is no camera {camera}, which it says it has")]
    NoCamera { camera: u32 },
    #[error(
        "its camera {camera} has the model {model}, which is not known here; undistort the photos with COLMAP's image_undistorter \
         first"
    )]
    UnknownModel { camera: u32, model: String },
    #[error("its frame says that the photo has {width} x {height} pixels")]
    FrameSize { width: f64, height: f64 },
    /// Its frame gives no size, and the photo cannot be read for it.
    #[error(transparent)]
    PhotoSize(Arc<DecodeError>),
    #[error("its frame gives no focal length (fl_x or camera_angle_x)")]
    NoFocal,
    #[error("camera model EQUIRECTANGULAR is a panorama: cut perspective photos out of it first")]
    Panorama,
    #[error("camera model ORTHOPHOTO has no perspective: no scene can be made from it")]
    Orthographic,
    #[error("instant-ngp's f-theta lens cannot be undistorted; undistort the photos first")]
    FTheta,
    #[error("camera model {0} cannot be undistorted; undistort the photos first")]
    FrameModel(String),
}

/// Why a photo of a reconstruction has no pose.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum PoseError {
    #[error("its pose is not finite")]
    NotFinite,
    #[error("the quaternion of its pose is zero")]
    ZeroQuaternion,
    #[error("its transform_matrix is not 4 x 4")]
    MatrixSize,
    #[error("the matrix of its pose is not a rotation")]
    NoRotation,
    /// COLMAP's id of an image, which tracks refer to.
    #[error("its image id {0} belongs to another photo too")]
    SharedId(u32),
}

/// World to camera, in the file's units.
#[derive(Clone, Copy, Debug)]
pub(crate) struct DraftPose {
    pub rotation: DMat3,
    pub centre: DVec3,
}

#[derive(Debug)]
pub(crate) struct DraftPoint {
    pub position: DVec3,
    pub colour: [u8; 3],
    /// Index of the photo, and the pixel where the file gives one.
    pub track: Vec<(usize, Option<[f64; 2]>)>,
}

/// The draft of a COLMAP reconstruction in `dir`.
pub(crate) fn from_colmap(dir: &Path) -> Result<Draft, SceneError> {
    let mut notes: Vec<String> = colmap::stale(dir).into_iter().chain(colmap::mixed(dir)).collect();
    let (reconstruction, pixels) = colmap::read_tracked(dir)?;
    let mut lenses = HashMap::new();
    for camera in &reconstruction.cameras {
        // Of two cameras with one id the first counts.
        lenses
            .entry(camera.id)
            .or_insert_with(|| Lens::new(camera.model, camera.width, camera.height, &camera.params));
    }
    let unknown: HashMap<u32, &String> =
        reconstruction.unknown_cameras.iter().rev().map(|(id, model)| (*id, model)).collect();
    let mut by_id: HashMap<u32, usize> = HashMap::new();
    let mut photos = Vec::with_capacity(reconstruction.images.len());
    for (i, image) in reconstruction.images.iter().enumerate() {
        let mut pose = pose_of(image);
        if *by_id.entry(image.id).or_insert(i) != i {
            pose = Err(PoseError::SharedId(image.id));
        }
        let camera = image.camera_id;
        let lens = match (lenses.get(&camera), unknown.get(&camera)) {
            (Some(lens), _) => lens.clone().map_err(DraftLensError::Lens),
            (None, Some(model)) => Err(DraftLensError::UnknownModel { camera, model: (*model).clone() }),
            (None, None) => Err(DraftLensError::NoCamera { camera }),
        };
        photos.push(DraftPhoto { name: image.name.clone(), file: None, usable: None, lens, pose });
    }
    let points = reconstruction.points.into_iter().map(|point| {
        let sighting = |&(image, feature): &(u32, u32)| {
            let photo = *by_id.get(&image)?;
            Some((photo, pixels.get(image, feature)))
        };
        let track = point.track.iter().filter_map(sighting).collect();
        DraftPoint { position: DVec3::from(point.position), colour: point.colour, track }
    });
    let mut points: Vec<DraftPoint> = points.collect();
    let ply = dir.join("points3D.ply");
    if !colmap::has_points(dir) && ply.is_file() {
        points = cloud(&ply)?;
        notes.push(format!(
            "the points are those of {}, for there is no points3D.bin or .txt beside it",
            ply.display()
        ));
    }
    Ok(Draft { photos, points, notes, split: None, source: dir.to_owned() })
}

/// The points of a point cloud, without tracks.
pub(crate) fn cloud(ply: &Path) -> Result<Vec<DraftPoint>, SceneError> {
    let point = |p: ply::Coloured| DraftPoint {
        position: DVec3::from(p.position),
        colour: p.colour,
        track: Vec::new(),
    };
    Ok(ply::read_points(ply)?.into_iter().map(point).collect())
}

fn pose_of(image: &ImageRecord) -> Result<DraftPose, PoseError> {
    let [w, x, y, z] = image.rotation;
    let (q, t) = (DQuat::from_xyzw(x, y, z, w), DVec3::from(image.translation));
    if !q.is_finite() || !t.is_finite() {
        return Err(PoseError::NotFinite);
    }
    let length = q.length();
    if length < 1e-9 || !length.is_finite() {
        return Err(PoseError::ZeroQuaternion);
    }
    let rotation = DMat3::from_quat(q / length);
    finite(DraftPose { rotation, centre: -(rotation.transpose() * t) })
}

/// Refuses a camera centre that is not finite or too far away for f64 arithmetic.
pub(crate) fn finite(pose: DraftPose) -> Result<DraftPose, PoseError> {
    if pose.centre.is_finite() && pose.centre.abs().max_element() < 1e30 {
        Ok(pose)
    } else {
        Err(PoseError::NotFinite)
    }
}
