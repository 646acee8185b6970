//! nerfstudio's `transforms.json`.
//!
//! Poses are camera to world with the camera's y up and z backwards (OpenGL); intrinsics are given for all frames, per
//! frame, or as Blender's `camera_angle_x`.

use crate::draft::{Draft, DraftPhoto, DraftPoint, DraftPose, finite};
use crate::lens::{Lens, Model};
use crate::photo::Header;
use crate::{SceneError, ply};
use glam::{DMat3, DVec3};
use serde::Deserialize;
use std::path::{Component, Path, PathBuf};

/// Endings tried when a `file_path` has none, as Blender writes it.
const ENDINGS: [&str; 6] = ["png", "jpg", "jpeg", "JPG", "PNG", "JPEG"];

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
struct Intrinsics {
    camera_model: Option<String>,
    camera_angle_x: Option<f64>,
    camera_angle_y: Option<f64>,
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct Frame {
    file_path: String,
    /// Mask of the pixels to use: black is ignored.
    mask_path: Option<String>,
    #[serde(default)]
    transform_matrix: Vec<Vec<Option<f64>>>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

#[derive(Debug, Deserialize)]
struct Transforms {
    frames: Vec<Frame>,
    #[serde(default)]
    ply_file_path: Option<String>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
}

/// The draft of a `transforms.json`; `images` is the folder to look in instead of the one the file names.
pub(crate) fn read(path: &Path, images: Option<&Path>) -> Result<Draft, SceneError> {
    let bytes = std::fs::read(path).map_err(SceneError::io(path))?;
    // Python writes NaN and Infinity, which are no JSON: they become null, that is, missing.
    let text = String::from_utf8_lossy(&bytes);
    let text = without_nan(&text);
    let transforms: Transforms = serde_json::from_str(&text).map_err(|e| {
        SceneError::invalid(path, format!("line {} column {}", e.line(), e.column()), e.to_string())
    })?;
    let folder = path.parent().unwrap_or(Path::new("."));

    let listed: Vec<PathBuf> = transforms.frames.iter().map(|f| tidy(&f.file_path)).collect();
    let common = common_folder(&listed);
    let mut photos = Vec::with_capacity(listed.len());
    for (frame, listed) in transforms.frames.iter().zip(&listed) {
        let short = listed.strip_prefix(&common).unwrap_or(listed);
        let wanted = images.map_or_else(|| folder.join(listed), |images| images.join(short));
        let file = with_ending(&wanted);
        // The name is that of the file that was found.
        let mut name = short.to_owned();
        if let Some(file_name) = file.file_name() {
            name.set_file_name(file_name);
        }
        let lens = lens_of(&frame.intrinsics, &transforms.intrinsics, &file);
        let name = name.to_string_lossy().replace('\\', "/");
        let usable = frame.mask_path.as_deref().map(|mask| folder.join(tidy(mask)));
        let pose = pose_of(&frame.transform_matrix);
        photos.push(DraftPhoto { name, file: Some(file), usable, lens, pose });
    }
    let (mut points, mut notes) = (Vec::new(), Vec::new());
    if let Some(ply) = transforms.ply_file_path.as_ref().map(|ply| folder.join(ply)) {
        let point = |p: ply::Coloured| DraftPoint {
            position: DVec3::from(p.position),
            colour: p.colour,
            track: Vec::new(),
        };
        match ply.is_file() {
            true => points = ply::read_points(&ply)?.into_iter().map(point).collect(),
            false => notes.push(format!(
                "{}: its points are to be in {}, which is not there",
                path.display(),
                ply.display()
            )),
        }
    }
    Ok(Draft { photos, points, notes, source: path.to_owned() })
}

/// Replaces the bare words NaN and Infinity, which Python's json writes, outside strings.
fn without_nan(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut in_string = false;
    let mut escaped = false;
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        if !in_string
            && let Some(word) = ["NaN", "-Infinity", "Infinity"].iter().find(|w| rest.starts_with(**w))
        {
            out += "null";
            rest = &rest[word.len()..];
            continue;
        }
        in_string ^= c == '"' && !escaped;
        escaped = in_string && c == '\\' && !escaped;
        out.push(c);
        rest = &rest[c.len_utf8()..];
    }
    out
}

/// A path without `.` parts.
fn tidy(path: &str) -> PathBuf {
    Path::new(path).components().filter(|c| *c != Component::CurDir).collect()
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
    if path.is_file() {
        return path.to_owned();
    }
    let ended = ENDINGS.iter().map(|ending| {
        let mut ended = path.as_os_str().to_owned();
        ended.push(".");
        ended.push(ending);
        PathBuf::from(ended)
    });
    ended.into_iter().find(|p| p.is_file()).unwrap_or_else(|| path.to_owned())
}

fn lens_of(frame: &Intrinsics, all: &Intrinsics, file: &Path) -> Result<Lens, String> {
    let get = |field: fn(&Intrinsics) -> Option<f64>| field(frame).or(field(all));
    let model = frame.camera_model.as_deref().or(all.camera_model.as_deref()).unwrap_or("OPENCV");
    let (width, height) = match (get(|i| i.w), get(|i| i.h)) {
        (Some(w), Some(h)) => {
            let side = |n: f64| if n >= 1.0 && n.fract() == 0.0 { Ok(n as u64) } else { Err(()) };
            match (side(w), side(h)) {
                (Ok(w), Ok(h)) => (w, h),
                _ => return Err(format!("its frame says that the photo has {w} x {h} pixels")),
            }
        }
        // Without a size the intrinsics are for the photo as it is.
        _ => {
            let (w, h) = Header::read(file)?.stored();
            (u64::from(w), u64::from(h))
        }
    };
    let from_angle = |angle: Option<f64>, side: u64| angle.map(|a| 0.5 * side as f64 / (0.5 * a).tan());
    let fx = get(|i| i.fl_x).or(from_angle(get(|i| i.camera_angle_x), width));
    let fy = get(|i| i.fl_y).or(from_angle(get(|i| i.camera_angle_y), height));
    let (fx, fy) = match (fx, fy) {
        (Some(fx), Some(fy)) => (fx, fy),
        (Some(f), None) | (None, Some(f)) => (f, f),
        (None, None) => return Err("its frame gives no focal length (fl_x or camera_angle_x)".into()),
    };
    let cx = get(|i| i.cx).unwrap_or(0.5 * width as f64);
    let cy = get(|i| i.cy).unwrap_or(0.5 * height as f64);
    let k = |field: fn(&Intrinsics) -> Option<f64>| get(field).unwrap_or(0.0);
    let (k1, k2, k3, k4) = (k(|i| i.k1), k(|i| i.k2), k(|i| i.k3), k(|i| i.k4));
    match model {
        "PINHOLE" | "SIMPLE_PINHOLE" => Lens::new(Model::Pinhole, width, height, &[fx, fy, cx, cy]),
        "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" => {
            let params = [fx, fy, cx, cy, k1, k2, k(|i| i.p1), k(|i| i.p2)];
            Lens::new(Model::OpenCv, width, height, &params).map(|lens| lens.with_radial(k3, k4))
        }
        "OPENCV_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => {
            Lens::new(Model::OpenCvFisheye, width, height, &[fx, fy, cx, cy, k1, k2, k3, k4])
        }
        other => Err(format!("camera model {other} cannot be undistorted; undistort the photos first")),
    }
}

fn pose_of(matrix: &[Vec<Option<f64>>]) -> Result<DraftPose, String> {
    let mut m = [[0.0; 4]; 3];
    for (r, row) in m.iter_mut().enumerate() {
        for (c, value) in row.iter_mut().enumerate() {
            let given = matrix.get(r).and_then(|row| row.get(c));
            *value = match given {
                None => return Err("its transform_matrix is not 4 x 4".into()),
                Some(Some(v)) if v.is_finite() => *v,
                Some(_) => return Err("its pose is not finite".into()),
            };
        }
    }
    // The camera's axes in the world; y and z turn from OpenGL's to ours.
    let axis = |c: usize, sign: f64| DVec3::new(m[0][c], m[1][c], m[2][c]) * sign;
    let [x, y, z] = [axis(0, 1.0), axis(1, -1.0), axis(2, -1.0)];
    let no_rotation = || Err("the matrix of its pose is not a rotation".to_owned());
    let scale = x.length();
    if scale < 1e-9 {
        return no_rotation();
    }
    let to_world = DMat3::from_cols(x / scale, y / scale, z / scale);
    let off = to_world.transpose() * to_world - DMat3::IDENTITY;
    let off = off.to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
    // Files with four or five digits are common.
    if off > 1e-2 || to_world.determinant() <= 0.0 {
        return no_rotation();
    }
    // Exactly a rotation again: Gram-Schmidt.
    let x = to_world.x_axis.normalize();
    let y = (to_world.y_axis - x * x.dot(to_world.y_axis)).normalize();
    let to_world = DMat3::from_cols(x, y, x.cross(y));
    finite(DraftPose { rotation: to_world.transpose(), centre: DVec3::new(m[0][3], m[1][3], m[2][3]) })
}
