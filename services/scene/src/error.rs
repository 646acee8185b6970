//! Errors of a scene's files, with messages for a person.

use crate::decode::DecodeError;
use segwild_files::FileError;
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Why a scene, a photo, a mask or a file of splats cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// The system refuses the file.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file cannot be written: the disk's or the folder's fault, and no input's.
    #[error(transparent)]
    File(#[from] FileError),
    /// The file ends in the middle of a record.
    #[error(
        "{path}: the file is cut short: {record} starts at byte {offset} and needs {needed} more bytes where only \
         {left} are left; copy the file again",
        path = path.display()
    )]
    Truncated {
        /// The file.
        path: PathBuf,
        /// The record that is incomplete, such as `image 12 of 40`.
        record: String,
        /// Where that record starts.
        offset: u64,
        /// Bytes that the next field of the record needs.
        needed: u64,
        /// Bytes that are left for it.
        left: u64,
    },
    /// The file holds something that cannot be.
    #[error("{path}: {location}: {reason}", path = path.display())]
    Invalid {
        /// The file.
        path: PathBuf,
        /// The line, record or byte.
        location: String,
        /// What is wrong, and what to do where that is not plain.
        reason: String,
    },
    /// A photo, or the mask that belongs to it, cannot be used.
    #[error("photo {name}: {path}: {reason}", path = path.display())]
    Photo {
        /// Name of the photo in the scene.
        name: String,
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: PhotoError,
    },
    /// A photo, or the mask that belongs to it, is not the file any more that it was when the scene was opened. The same scene,
    /// opened again, may do without it.
    #[error(
        "photo {name}: {path}: the file was changed or taken away while it was in use; put it back, or run again without it",
        path = path.display()
    )]
    Changed {
        /// Name of the photo in the scene.
        name: String,
        /// The file.
        path: PathBuf,
    },
    /// A folder or file that a setting names is not as it must be.
    #[error("`{setting}` is set to {value}: {reason}")]
    Setting {
        /// The setting.
        setting: &'static str,
        /// Its value.
        value: String,
        /// What is wrong.
        reason: String,
    },
    /// No reconstruction was recognised.
    #[error("{path} {problem}; looked for {looked_for}", path = path.display())]
    NotAScene {
        /// The folder.
        path: PathBuf,
        /// What it is instead.
        problem: &'static str,
        /// The forms of scenes that are recognised.
        looked_for: String,
    },
    /// The scene was read, and nothing of it can be used.
    #[error("{path}: nothing usable is left: {reason}", path = path.display())]
    NothingUsable {
        /// The file or folder.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

impl SceneError {
    /// For `map_err`: the system refused `path`.
    pub fn io(path: &Path) -> impl FnOnce(std::io::Error) -> SceneError + '_ {
        move |source| SceneError::Io { path: path.to_owned(), source }
    }

    /// The file holds something that cannot be.
    pub fn invalid(path: &Path, location: impl Into<String>, reason: impl Display) -> SceneError {
        SceneError::Invalid { path: path.to_owned(), location: location.into(), reason: reason.to_string() }
    }
}

/// The error of a reader or renderer that a higher floor supplies to a lower one, which reports it and never matches it.
pub type ReaderError = Box<dyn std::error::Error + Send + Sync>;

/// All that can be wrong with a photo: its file, its size, its masks. [`SceneError::Photo`] adds its name and path.
#[derive(Debug, thiserror::Error)]
pub enum PhotoError {
    /// The file cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Its pixels are turned against its EXIF orientation: nothing says which way.
    #[error(
        "some program has turned its pixels since it was taken (it has {width} x {height}, its camera is for {camera_width} x \
         {camera_height}): put the photo back that was reconstructed"
    )]
    TurnedSince {
        /// Width as stored, in pixels.
        width: u32,
        /// Height as stored.
        height: u32,
        /// Width that the camera is for.
        camera_width: u32,
        /// Height that the camera is for.
        camera_height: u32,
    },
    /// The photo has another shape than its camera.
    #[error(
        "the photo has {width} x {height} pixels, but its camera is for {camera_width} x {camera_height}; the shapes differ, so the \
         photo is not the one that was reconstructed"
    )]
    OtherShape {
        /// Width as stored, in pixels.
        width: u32,
        /// Height as stored.
        height: u32,
        /// Width that the camera is for.
        camera_width: u32,
        /// Height that the camera is for.
        camera_height: u32,
    },
    /// A mask has another shape than the photo.
    #[error(
        "its mask {mask} has {mask_width} x {mask_height} pixels, which does not fit the photo's {width} x {height}",
        mask = mask.display()
    )]
    MaskShape {
        /// The mask's file.
        mask: PathBuf,
        /// Width of the mask in pixels.
        mask_width: u32,
        /// Height of the mask.
        mask_height: u32,
        /// Width of the photo.
        width: u32,
        /// Height of the photo.
        height: u32,
    },
    /// Its masks cover all of it.
    #[error("its masks leave nothing of it")]
    MaskedOut,
    /// It has no opaque pixel.
    #[error("all of it is transparent")]
    Transparent,
}
