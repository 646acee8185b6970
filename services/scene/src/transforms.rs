//! nerfstudio's and instant-ngp's `transforms.json`, and Blender's `transforms_train.json` with its siblings.
//!
//! Poses are camera to world with the camera's y up and z backwards (OpenGL); intrinsics are given for all frames, per
//! frame, or as Blender's `camera_angle_x`.

use crate::decode::{ImageHead, converted};
use crate::draft::{Draft, DraftLensError, DraftPhoto, DraftPose, PoseError, finite};
use crate::endings::{CAPITALS, READ, is_photo};
use crate::lens::{CameraModel, Lens};
use crate::names::{Listing, below, is_inside, key, last_part, tidy};
use crate::photo_files::{Claim, Claimed, LocateError, no_file, photo_folders, settle};
use crate::split::{Split, SplitPart};
use crate::transforms_json::{Intrinsics, Transforms, TransformsFrame};
use crate::{DecodeError, SceneError, draft, text};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::collections::HashMap;
use std::path::{Component, Path, PathBuf};
use std::sync::{Arc, OnceLock};

/// Endings tried first when a `file_path` has none, as Blender writes it; then all the others that are read.
const USUAL: [&str; 6] = ["png", "jpg", "jpeg", "JPG", "PNG", "JPEG"];

fn endings() -> impl Iterator<Item = &'static str> {
    USUAL.into_iter().chain(READ).chain(CAPITALS)
}

/// A file of cameras, and the part of its photos where its name gives one.
struct CamerasFile {
    path: PathBuf,
    part: Option<SplitPart>,
    transforms: Transforms,
}

/// Blender's three files, which are one scene.
const BLENDER: [(&str, SplitPart); 3] = [
    ("transforms_train.json", SplitPart::Train),
    ("transforms_val.json", SplitPart::Validation),
    ("transforms_test.json", SplitPart::Test),
];

/// The cameras file of a folder: `transforms.json`, or the first of Blender's.
pub(crate) fn find(folder: &Path) -> Option<PathBuf> {
    let names = std::iter::once("transforms.json").chain(BLENDER.map(|(name, _)| name));
    names.map(|name| below(folder, name)).find(|path| path.is_file())
}

/// The draft of a `transforms.json`, or of Blender's three files if it is one of them and `all` of the folder is meant; `images` is
/// the folder to look in instead of the one the file names.
pub(crate) fn read(path: &Path, images: Option<&Path>, all: bool) -> Result<Draft, SceneError> {
    let folder = path.parent().unwrap_or(Path::new("."));
    let beside =
        BLENDER.map(|(name, part)| (folder.join(name), part)).into_iter().filter(|(p, _)| p.is_file());
    let beside: Vec<(PathBuf, SplitPart)> = beside.collect();
    let mut notes = Vec::new();
    let sheets: Vec<CamerasFile> = if all && beside.iter().any(|(p, _)| p == path) {
        beside.iter().map(|(path, part)| cameras_file(path, Some(*part))).collect::<Result<_, _>>()?
    } else {
        let others: Vec<String> =
            beside.iter().filter(|(p, _)| p != path).map(|(p, _)| p.display().to_string()).collect();
        if !others.is_empty() {
            notes.push(format!("{} is read, and not {} beside it", path.display(), others.join(", ")));
        }
        vec![cameras_file(path, None)?]
    };
    let files = PhotoFinder::new(folder, images);
    let listed: Vec<PathBuf> = sheets
        .iter()
        .flat_map(|sheet| sheet.transforms.frames.iter().map(|f| PathBuf::from(rooted(&f.file_path))))
        .collect();
    let common = common_folder(&listed);
    let frames: Vec<(&CamerasFile, &TransformsFrame)> =
        sheets.iter().flat_map(|sheet| sheet.transforms.frames.iter().map(move |f| (sheet, f))).collect();
    let short = |listed: &'_ PathBuf| listed.strip_prefix(&common).unwrap_or(listed).to_owned();
    let claim = |(&(_, frame), listed): (&(&CamerasFile, &TransformsFrame), &PathBuf)| match images {
        Some(_) => files.find(&short(listed).to_string_lossy()),
        None => files.find(&frame.file_path),
    };
    let claims = frames.par_iter().zip(&listed).map(claim).collect();
    let names: Vec<&str> = frames.iter().map(|(_, frame)| frame.file_path.as_str()).collect();
    let claims = settle(&names, claims);
    let photo =
        |(((sheet, frame), listed), claim): ((&(&CamerasFile, &TransformsFrame), &PathBuf), Claimed)| {
            let short = &short(listed);
            let file = claim.map(|claim| claim.path);
            let at = file.as_deref().unwrap_or(Path::new(""));
            let lens = lens_of(&frame.intrinsics, &sheet.transforms.intrinsics, at);
            let usable = frame.mask_path.as_deref().map(|mask| files.beside(mask));
            let pose = pose_of(&frame.transform_matrix);
            DraftPhoto { name: files.name(short, &file), file: Some(file), usable, lens, pose }
        };
    let photos: Vec<DraftPhoto> = frames.par_iter().zip(&listed).zip(claims).map(photo).collect();
    let mut points = Vec::new();
    let ply = sheets.iter().find_map(|sheet| sheet.transforms.ply_file_path.as_ref());
    if let Some(ply) = ply.map(|ply| files.beside(ply)) {
        match ply.is_file() {
            true => points = draft::cloud(&ply)?,
            false => notes.push(format!(
                "{}: its points are to be in {}, which is not there",
                path.display(),
                ply.display()
            )),
        }
    }
    let split = split_of(path, &sheets, &photos);
    Ok(Draft { photos, points, notes, split, source: sources(path, &sheets) })
}

/// All the files that were read, as one name for a person.
fn sources(path: &Path, sheets: &[CamerasFile]) -> PathBuf {
    let files = sheets.iter().map(|s| last_part(&s.path.to_string_lossy()).to_owned());
    path.with_file_name(files.collect::<Vec<_>>().join(" + "))
}

fn cameras_file(path: &Path, part: Option<SplitPart>) -> Result<CamerasFile, SceneError> {
    Ok(CamerasFile { path: path.to_owned(), part, transforms: Transforms::read(path)? })
}

/// The split that the files themselves give.
fn split_of(path: &Path, sheets: &[CamerasFile], photos: &[DraftPhoto]) -> Option<Split> {
    let mut names = photos.iter().map(|photo| photo.name.clone());
    if sheets.iter().any(|sheet| sheet.part.is_some()) {
        let parts = sheets
            .iter()
            .flat_map(|s| s.transforms.frames.iter().map(|_| s.part.unwrap_or(SplitPart::Train)));
        return Some(Split::new(&sources(path, sheets), names.zip(parts).collect::<Vec<_>>(), true));
    }
    let Transforms { frames, train_filenames, val_filenames, test_filenames, .. } = &sheets[0].transforms;
    let lists = [
        (train_filenames, SplitPart::Train),
        (val_filenames, SplitPart::Validation),
        (test_filenames, SplitPart::Test),
    ];
    if lists.iter().all(|(list, _)| list.is_none()) {
        return None;
    }
    let known: HashMap<String, String> =
        frames.iter().map(|frame| key(&frame.file_path)).zip(names.by_ref()).collect();
    let named = |file: &String| known.get(&key(file)).cloned().unwrap_or_else(|| file.clone());
    let rows = lists.iter().flat_map(|(list, part)| list.iter().flatten().map(|file| (named(file), *part)));
    Some(Split::new(path, rows.collect::<Vec<_>>(), train_filenames.is_some()))
}

/// Finds the files that a transforms.json names, in the scene's folder and nowhere else.
struct PhotoFinder<'a> {
    /// Folder of the file, and of the photos.
    folder: &'a Path,
    photos: PathBuf,
    listing: OnceLock<Listing>,
    below: Vec<(PathBuf, OnceLock<Listing>)>,
}

impl<'a> PhotoFinder<'a> {
    fn new(folder: &'a Path, images: Option<&Path>) -> PhotoFinder<'a> {
        let photos = images.unwrap_or(folder).to_owned();
        let folders = photo_folders(folder).into_iter();
        let below = folders.filter(|dir| images.is_none() && *dir != folder && dir.is_dir());
        let below = below.map(|dir| (dir, OnceLock::new())).collect();
        PhotoFinder { folder, photos, listing: OnceLock::new(), below }
    }

    /// The file of a photo.
    fn find(&self, listed: &str) -> Claimed {
        let tidied = tidy(listed);
        let other = (tidied != listed).then_some(tidied.as_str());
        for name in std::iter::once(listed).chain(other) {
            if let Some(path) = inside(&self.photos, name).map(|path| with_ending(&path))
                && (path.is_file() || converted(&path).is_some())
            {
                return Ok(Claim { path, left: None });
            }
        }
        let listings =
            std::iter::once((&self.photos, &self.listing)).chain(self.below.iter().map(|(p, l)| (p, l)));
        for (folder, listing) in listings {
            let listing = listing.get_or_init(|| Listing::of(folder));
            let endings =
                endings().filter(|_| !is_photo(Path::new(listed))).map(|ending| format!("{listed}.{ending}"));
            let found =
                std::iter::once(listed.to_owned()).chain(endings).find_map(|name| listing.tail(&name));
            if let Some(entry) = found {
                return Ok(Claim::left(entry));
            }
        }
        if inside(&self.photos, listed).is_none() && self.folder.join(listed).is_file() {
            let (listed, folder) = (listed.to_owned(), self.folder.to_owned());
            return Err(LocateError::OutsideFile { listed, folder });
        }
        let candidate = self.listing.get().and_then(|listing| listing.candidate(listed));
        Err(no_file(&self.photos, listed, candidate))
    }

    /// The name of a photo: that of the file that was found, if one was.
    fn name(&self, short: &Path, file: &Result<PathBuf, LocateError>) -> String {
        let Ok(file) = file else { return short.to_string_lossy().into_owned() };
        let mut name = short.to_owned();
        if let Some(file_name) = file.file_name() {
            name.set_file_name(text::line(file_name.as_encoded_bytes()));
        }
        let name = name.to_string_lossy().into_owned();
        match file.strip_prefix(&self.photos) {
            Ok(within) if !is_inside(&name) => text::line(within.as_os_str().as_encoded_bytes()),
            _ => name,
        }
    }

    /// A file that is named beside the photos; where it would be if it is not there.
    fn beside(&self, name: &str) -> PathBuf {
        let wanted = [name.to_owned(), tidy(name)].into_iter().filter_map(|name| inside(self.folder, &name));
        if let Some(path) = wanted.clone().find(|path| path.is_file()) {
            return path;
        }
        let listing = self.listing.get_or_init(|| Listing::of(&self.photos));
        let found = listing.tail(name).map(|entry| entry.path.clone());
        found.or_else(|| wanted.into_iter().next()).unwrap_or_else(|| self.folder.join(tidy(name)))
    }
}

/// The file of a name as it stands in a folder; `None` where it would lie outside.
fn inside(folder: &Path, name: &str) -> Option<PathBuf> {
    let mut path = PathBuf::new();
    for component in folder.join(name).components() {
        match component {
            Component::CurDir => {}
            Component::ParentDir => {
                path.pop();
            }
            other => path.push(other),
        }
    }
    path.starts_with(folder).then_some(path)
}

/// A listed path with `/` between its parts; the root of an absolute one is kept, so that it is a folder like the others.
fn rooted(listed: &str) -> String {
    let tidied = tidy(listed);
    if listed.starts_with('/') { format!("/{tidied}") } else { tidied }
}

/// The folder that all files share, so that photos are named within it.
fn common_folder(files: &[PathBuf]) -> PathBuf {
    let mut folders = files.iter().map(|f| f.parent().unwrap_or(Path::new("")));
    let mut common = folders.next().unwrap_or(Path::new("")).to_owned();
    for folder in folders {
        common = common
            .components()
            .zip(folder.components())
            .take_while(|(a, b)| a == b)
            .map(|(a, _)| a)
            .collect();
    }
    common
}

fn with_ending(path: &Path) -> PathBuf {
    if path.is_file() || is_photo(path) {
        return path.to_owned();
    }
    let ended = endings().map(|ending| {
        let mut ended = path.as_os_str().to_owned();
        ended.push(".");
        ended.push(ending);
        PathBuf::from(ended)
    });
    ended.into_iter().find(|p| p.is_file()).unwrap_or_else(|| path.to_owned())
}

/// Size of a photo as stored, or of its converted copy. Whether it is too large is seen when the photo is looked at.
fn photo_size(file: &Path) -> Result<(u32, u32), DecodeError> {
    let stored = |file: &Path| ImageHead::read(file, u64::MAX).map(|head| head.stored());
    stored(file).or_else(|error| converted(file).map_or(Err(error), |copy| stored(&copy)))
}

fn lens_of(frame: &Intrinsics, all: &Intrinsics, file: &Path) -> Result<Lens, DraftLensError> {
    let get = |field: fn(&Intrinsics) -> Option<f64>| field(frame).or(field(all));
    let (width, height) = match (get(|i| i.w), get(|i| i.h)) {
        (Some(width), Some(height)) => {
            let side = |n: f64| (n >= 1.0 && n.fract() == 0.0).then_some(n as u64);
            side(width).zip(side(height)).ok_or(DraftLensError::FrameSize { width, height })?
        }
        // Without a size the intrinsics are for the photo as it is.
        _ => {
            let (w, h) = photo_size(file).map_err(|e| DraftLensError::PhotoSize(Arc::new(e)))?;
            (u64::from(w), u64::from(h))
        }
    };
    let from_angle = |angle: Option<f64>, side: u64| angle.map(|a| 0.5 * side as f64 / (0.5 * a).tan());
    let fx = get(|i| i.fl_x).or(from_angle(get(|i| i.camera_angle_x), width));
    let fy = get(|i| i.fl_y).or(from_angle(get(|i| i.camera_angle_y), height));
    let (fx, fy) = match (fx, fy) {
        (Some(fx), Some(fy)) => (fx, fy),
        (Some(f), None) | (None, Some(f)) => (f, f),
        (None, None) => return Err(DraftLensError::NoFocal),
    };
    let cx = get(|i| i.cx).unwrap_or(0.5 * width as f64);
    let cy = get(|i| i.cy).unwrap_or(0.5 * height as f64);
    let pinhole = [fx, fy, cx, cy];
    // k1 to k6, p1, p2.
    let k = match frame.distortion_params.as_ref().or(all.distortion_params.as_ref()) {
        Some(params) => {
            let at = |i: usize| params.get(i).copied().unwrap_or(0.0);
            [at(0), at(1), at(2), at(3), 0.0, 0.0, at(4), at(5)]
        }
        None => {
            let fields: [fn(&Intrinsics) -> Option<f64>; 8] =
                [|i| i.k1, |i| i.k2, |i| i.k3, |i| i.k4, |i| i.k5, |i| i.k6, |i| i.p1, |i| i.p2];
            fields.map(|field| get(field).unwrap_or(0.0))
        }
    };
    distorted(&model_of(frame, all)?, (width, height), pinhole, k)
}

/// The camera model that a frame names; an error where it is none that maps to a pinhole.
fn model_of(frame: &Intrinsics, all: &Intrinsics) -> Result<String, DraftLensError> {
    let says = |field: fn(&Intrinsics) -> Option<bool>| field(frame).or(field(all)) == Some(true);
    let named = frame.camera_model.as_deref().or(all.camera_model.as_deref()).unwrap_or("OPENCV");
    let model = named.to_uppercase();
    if says(|i| i.equirectangular) || model == "EQUIRECTANGULAR" {
        return Err(DraftLensError::Panorama);
    }
    if says(|i| i.orthographic) || model == "ORTHOPHOTO" {
        return Err(DraftLensError::Orthographic);
    }
    if frame.ftheta_p0.or(all.ftheta_p0).is_some() {
        return Err(DraftLensError::FTheta);
    }
    Ok(if says(|i| i.is_fisheye) { "OPENCV_FISHEYE".into() } else { model })
}

fn distorted(model: &str, size: (u64, u64), pinhole: [f64; 4], k: [f64; 8]) -> Result<Lens, DraftLensError> {
    let (width, height) = size;
    let [k1, k2, k3, k4, k5, k6, p1, p2] = k;
    let lens =
        |model: CameraModel, more: &[f64]| Lens::new(model, width, height, &[&pinhole[..], more].concat());
    let lens = match model {
        "PINHOLE" | "SIMPLE_PINHOLE" => lens(CameraModel::Pinhole, &[]),
        "OPENCV" | "PERSPECTIVE" | "SIMPLE_RADIAL" | "RADIAL" => {
            lens(CameraModel::OpenCv, &[k1, k2, p1, p2]).map(|lens| lens.with_radial(k3, k4))
        }
        "FULL_OPENCV" => lens(CameraModel::FullOpenCv, &[k1, k2, p1, p2, k3, k4, k5, k6]),
        "OPENCV_FISHEYE" | "FISHEYE" | "SIMPLE_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => {
            lens(CameraModel::OpenCvFisheye, &[k1, k2, k3, k4])
        }
        other => return Err(DraftLensError::FrameModel(other.to_owned())),
    };
    Ok(lens?)
}

fn pose_of(matrix: &[Vec<Option<f64>>]) -> Result<DraftPose, PoseError> {
    let mut m = [[0.0; 4]; 3];
    for (r, row) in m.iter_mut().enumerate() {
        for (c, value) in row.iter_mut().enumerate() {
            let given = matrix.get(r).and_then(|row| row.get(c));
            *value = match given {
                None => return Err(PoseError::MatrixSize),
                Some(Some(v)) if v.is_finite() => *v,
                Some(_) => return Err(PoseError::NotFinite),
            };
        }
    }
    // The camera's axes in the world; y and z turn from OpenGL's to ours.
    let axis = |c: usize, sign: f64| DVec3::new(m[0][c], m[1][c], m[2][c]) * sign;
    let [x, y, z] = [axis(0, 1.0), axis(1, -1.0), axis(2, -1.0)];
    let scale = x.length();
    if scale < 1e-9 {
        return Err(PoseError::NoRotation);
    }
    let to_world = DMat3::from_cols(x / scale, y / scale, z / scale);
    let off = to_world.transpose() * to_world - DMat3::IDENTITY;
    let off = off.to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
    // Files with four or five digits are common.
    if off > 1e-2 || to_world.determinant() <= 0.0 {
        return Err(PoseError::NoRotation);
    }
    // Exactly a rotation again: Gram-Schmidt.
    let x = to_world.x_axis.normalize();
    let y = (to_world.y_axis - x * x.dot(to_world.y_axis)).normalize();
    let to_world = DMat3::from_cols(x, y, x.cross(y));
    finite(DraftPose { rotation: to_world.transpose(), centre: DVec3::new(m[0][3], m[1][3], m[2][3]) })
}
