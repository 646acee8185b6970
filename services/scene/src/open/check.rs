//! Which photos of a reconstruction can be used: each by its file, its masks, its lens, its pose and the split.

use crate::decode::{self, ImageHead, pixels_of};
use crate::draft::{Draft, DraftLensError, DraftPhoto, DraftPose, PoseError};
use crate::frame::Placed;
use crate::mask_files::MaskFiles;
use crate::names::is_inside;
use crate::photo_files::LocateError;
use crate::split::{Split, SplitPart};
use crate::{
    Camera, DecodeError, MaskFileError, Photo, PhotoError, Pose, Reading, SceneFrame, SceneSettings, Seal,
    View,
};
use glam::Mat3;
use image::metadata::Orientation;
use std::collections::HashSet;
use std::path::PathBuf;

/// Why a photo of the reconstruction takes no part.
#[derive(Debug, thiserror::Error)]
pub(super) enum UnusablePhoto {
    #[error("its name is not that of a file inside the photo folder")]
    OutsideName,
    #[error("it is not listed in the split {}", .0.display())]
    NotInSplit(PathBuf),
    #[error("the split {} keeps it for validation", .0.display())]
    Validation(PathBuf),
    #[error("the split {} gives it no id", .0.display())]
    NoId(PathBuf),
    /// It has no file.
    #[error(transparent)]
    Locate(#[from] LocateError),
    #[error("there is no file {}", .0.display())]
    NoFile(PathBuf),
    #[error(transparent)]
    Photo(#[from] PhotoError),
    #[error(transparent)]
    Pose(#[from] PoseError),
    #[error(transparent)]
    Lens(#[from] DraftLensError),
    #[error(
        "its lens cannot be right: of the undistorted image only {percent:.0} % can be filled from the photo"
    )]
    Folded { percent: f64 },
    /// Two files may be its mask.
    #[error(transparent)]
    MaskFile(#[from] MaskFileError),
    #[error("there is no file {}, which is to be its mask", .0.display())]
    NoMask(PathBuf),
    #[error("its mask {}: {reason}", mask.display())]
    Mask { mask: PathBuf, reason: DecodeError },
}

impl From<DecodeError> for UnusablePhoto {
    fn from(error: DecodeError) -> UnusablePhoto {
        UnusablePhoto::Photo(error.into())
    }
}

/// A photo that passed every check.
pub(super) struct CheckedPhoto {
    pub photo: Photo,
    pub camera: Camera,
    pub pose: DraftPose,
    /// What to say where a converted copy stands for the photo.
    pub copied: Option<String>,
    /// Its EXIF orientation, where its size does not decide whether the poses are of the turned pixels.
    pub ambiguous: Option<Orientation>,
}

impl CheckedPhoto {
    /// Where it stands; `photo` is its index in the draft.
    pub fn placed<'a>(&self, photo: usize, draft: &'a Draft) -> Option<Placed<'a>> {
        let lens = draft.photos[photo].lens.as_ref().ok()?;
        Some(Placed { photo, pose: self.pose, camera: self.camera, lens })
    }

    /// The view of the photo in the scene's frame.
    pub fn into_view(self, name: &str, frame: &SceneFrame) -> View {
        let rotation = self.pose.rotation;
        let centre = (self.pose.centre - frame.origin) / frame.scale;
        let pose = Pose {
            rotation: Mat3::from_cols_array(&rotation.to_cols_array().map(|v| v as f32)),
            translation: (-(rotation * centre)).as_vec3(),
        };
        View { name: name.to_owned(), camera: self.camera, pose, photo: self.photo, test: false }
    }
}

/// Whether a mask is named after the photo.
pub(super) fn has_mask(masks: Option<&MaskFiles>, photo: &str) -> bool {
    masks.is_some_and(|masks| !matches!(masks.find(photo), Ok(None)))
}

/// What photos are checked against.
pub(super) struct PhotoChecks<'a> {
    /// Masks of what to ignore.
    pub ignored: Option<&'a MaskFiles>,
    /// Masks of what to keep.
    pub keep: Option<&'a MaskFiles>,
    /// The split.
    pub split: Option<&'a Split>,
    /// Size and limits.
    pub settings: &'a SceneSettings,
}

/// Checks a photo. `path` is its file, `held` has those of all photos.
///
/// # Errors
/// Why it takes no part.
pub(super) fn check(
    photo: &DraftPhoto,
    path: Result<PathBuf, LocateError>,
    held: &HashSet<PathBuf>,
    checks: &PhotoChecks<'_>,
) -> Result<CheckedPhoto, UnusablePhoto> {
    let PhotoChecks { ignored, keep, split, settings } = *checks;
    if !is_inside(&photo.name) {
        path?;
        return Err(UnusablePhoto::OutsideName);
    }
    match split.map(|s| (s, s.part(&photo.name))) {
        Some((s, None)) => return Err(UnusablePhoto::NotInSplit(s.path.clone())),
        Some((s, Some(SplitPart::Validation))) => return Err(UnusablePhoto::Validation(s.path.clone())),
        Some((s, Some(SplitPart::NoPose))) => return Err(UnusablePhoto::NoId(s.path.clone())),
        _ => {}
    }
    let pose = photo.pose.clone()?;
    let (path, head, copied) = readable(path?, held, settings)?;
    let mask = |masks: Option<&MaskFiles>| masks.map_or(Ok(None), |masks| masks.find(&photo.name));
    let ignore = mask(ignored)?;
    let usable = match &photo.usable {
        Some(mask) => Some(mask.clone()),
        None => mask(keep)?,
    };
    let files = [Some(&path), ignore.as_ref(), usable.as_ref()];
    let seal = Seal::on(files.into_iter().flatten().map(PathBuf::as_path));
    let lens = photo.lens.as_ref().map_err(DraftLensError::clone)?;
    let (width, height) = head.size_for(lens.width(), lens.height())?;
    let lens = lens.resized(width, height);
    let filled = lens.filled();
    if filled < HALF {
        return Err(UnusablePhoto::Folded { percent: 100.0 * filled });
    }
    let camera = lens.pinhole();
    if let Some(mask) = usable.as_ref().filter(|mask| !mask.is_file()) {
        return Err(UnusablePhoto::NoMask(mask.clone()));
    }
    let most_pixels = pixels_of(settings.max_megapixels);
    let mut bytes = head.photo_bytes(&camera, lens.is_distorted(), settings.size);
    for mask in [&ignore, &usable].into_iter().flatten() {
        let head = ImageHead::read(mask, most_pixels)
            .map_err(|reason| UnusablePhoto::Mask { mask: mask.clone(), reason })?;
        bytes = bytes.max(head.bytes_for(head.width, head.height));
    }
    // Whether it is empty or turned is decided when all photos are known.
    let reading = Reading { bytes, empty: head.has_alpha(), turned: false, most_pixels };
    let ambiguous = head.ambiguous_orientation();
    let lens = lens.is_distorted().then_some(lens);
    Ok(CheckedPhoto {
        photo: Photo { path, ignore, usable, lens, seal, reading },
        camera,
        pose,
        copied,
        ambiguous,
    })
}

/// The photo's file, or its converted copy where this program does not read the file itself; the head of what is read, and what
/// to say of the copy.
fn readable(
    path: PathBuf,
    held: &HashSet<PathBuf>,
    settings: &SceneSettings,
) -> Result<(PathBuf, ImageHead, Option<String>), UnusablePhoto> {
    let most = pixels_of(settings.max_megapixels);
    let read = match path.exists() {
        true => ImageHead::read(&path, most).map_err(UnusablePhoto::from),
        false => Err(UnusablePhoto::NoFile(path.clone())),
    };
    // A file that is another photo is nobody's copy.
    let copy = || decode::converted_copies(&path).find(|copy| !held.contains(copy));
    let (path, head, note) = match read.map_err(|error| (error, copy())) {
        Ok(head) => (path, head, None),
        Err((error, None)) => return Err(error),
        Err((_, Some(copy))) => {
            let head = ImageHead::read(&copy, most)?;
            let note = format!("{} is read from its converted copy {}", path.display(), copy.display());
            (copy, head, Some(note))
        }
    };
    head.check_end(&path)?;
    Ok((path, head, note))
}

/// Least share of the undistorted image that a photo must fill for its lens to be accepted.
const HALF: f64 = 0.5;
