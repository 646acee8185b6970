//! COLMAP's `.txt` files: a line per record, two per image; `#` starts a comment.

use super::records::{CameraRecord, ImageRecord, KeepFeature, Keypoint, PointRecord, Reconstruction};
use crate::SceneError;
use crate::lens::CameraModel;
use crate::text;
use segwild_files::write_atomic;
use std::fmt::Write;
use std::path::Path;
use std::str::FromStr;

/// The fields of one line; every error names file and line.
struct LineFields<'a> {
    path: &'a Path,
    line: usize,
    rest: &'a str,
}

impl<'a> LineFields<'a> {
    fn word(&mut self) -> Option<&'a str> {
        let start = self.rest.trim_start();
        if start.is_empty() {
            return None;
        }
        let (word, rest) = start.split_once(char::is_whitespace).unwrap_or((start, ""));
        self.rest = rest;
        Some(word)
    }

    fn value<T: FromStr>(&mut self, what: &str) -> Result<T, SceneError> {
        let Some(word) = self.word() else {
            return Err(self.invalid(format!("the line ends before {what}")));
        };
        word.parse().map_err(|_| self.unlike(word, what))
    }

    fn values<const N: usize>(&mut self, what: &str) -> Result<[f64; N], SceneError> {
        let mut values = [0.0; N];
        for v in &mut values {
            *v = self.value(what)?;
        }
        Ok(values)
    }

    fn unlike(&self, word: &str, what: &str) -> SceneError {
        self.invalid(format!("`{}` is no {what}", shortened(word)))
    }

    fn invalid(&self, reason: String) -> SceneError {
        SceneError::invalid(self.path, format!("line {}", self.line), reason)
    }
}

/// A word as a message quotes it: of a long one only the start, since a damaged file may be a single word of gigabytes.
fn shortened(word: &str) -> String {
    match word.char_indices().nth(80) {
        Some((end, _)) => format!("{}...", &word[..end]),
        None => word.to_owned(),
    }
}

fn is_record(line: &str) -> bool {
    let line = line.trim_start();
    !line.is_empty() && !line.starts_with('#')
}

/// Cameras, and numbers of those whose model is not known here with its name.
type ReadCameras = (Vec<CameraRecord>, Vec<(u32, String)>);

/// The cameras of `cameras.txt`.
pub(super) fn cameras(dir: &Path) -> Result<ReadCameras, SceneError> {
    let path = dir.join("cameras.txt");
    let text = text::read(&path)?;
    let (mut cameras, mut unknown_cameras) = (Vec::new(), Vec::new());
    for (i, line) in text.lines().enumerate().filter(|(_, l)| is_record(l)) {
        let mut words = LineFields { path: &path, line: i + 1, rest: line };
        let id = words.value("camera id")?;
        let name: String = words.value("camera model")?;
        let Some(model) = CameraModel::from_name(&name) else {
            unknown_cameras.push((id, shortened(&name)));
            continue;
        };
        let (width, height) = (words.value("width")?, words.value("height")?);
        let mut params = Vec::with_capacity(model.param_count());
        for _ in 0..model.param_count() {
            params.push(words.value("camera parameter")?);
        }
        cameras.push(CameraRecord { id, model, width, height, params });
    }
    Ok((cameras, unknown_cameras))
}

/// The photos of `images.txt`, with those of their features for which `keep` returns true.
pub(super) fn images(dir: &Path, keep: &mut KeepFeature<'_>) -> Result<Vec<ImageRecord>, SceneError> {
    let path = dir.join("images.txt");
    let text = text::read(&path)?;
    let mut images = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((i, line)) = lines.next() {
        if !is_record(line) {
            continue;
        }
        let mut words = LineFields { path: &path, line: i + 1, rest: line };
        let id = words.value("image id")?;
        let rotation = words.values("quaternion")?;
        let translation = words.values("translation")?;
        let camera_id = words.value("camera id")?;
        // The name is the rest of the line: names may hold spaces.
        let name = words.rest.trim().to_owned();
        // The second line belongs to the image even when it is empty.
        let mut keypoints = Vec::new();
        if let Some((i, line)) = lines.next() {
            let mut words = LineFields { path: &path, line: i + 1, rest: line };
            let mut index = 0;
            while let Some(x) = words.word() {
                let x = x.parse().map_err(|_| words.unlike(x, "pixel position"))?;
                let y = words.value("pixel position")?;
                let point: i64 = words.value("point id")?;
                let keypoint = Keypoint { pixel: [x, y], point: u64::try_from(point).ok() };
                if keep(id, index, keypoint) {
                    keypoints.push(keypoint);
                }
                index += 1;
            }
        }
        images.push(ImageRecord { id, rotation, translation, camera_id, name, keypoints });
    }
    Ok(images)
}

/// The points of `points3D.txt`.
pub(super) fn points(dir: &Path) -> Result<Vec<PointRecord>, SceneError> {
    let path = dir.join("points3D.txt");
    let mut points = Vec::new();
    let text = text::read(&path)?;
    for (i, line) in text.lines().enumerate().filter(|(_, l)| is_record(l)) {
        let mut words = LineFields { path: &path, line: i + 1, rest: line };
        let id = words.value("point id")?;
        let position = words.values("position")?;
        let colour = [words.value("colour")?, words.value("colour")?, words.value("colour")?];
        let error = words.value("error")?;
        let mut track = Vec::new();
        while let Some(image) = words.word() {
            let image = image.parse().map_err(|_| words.unlike(image, "image id"))?;
            track.push((image, words.value("keypoint index")?));
        }
        points.push(PointRecord { id, position, colour, error, track });
    }
    Ok(points)
}

/// Writes `cameras.txt`, `images.txt` and `points3D.txt` into `dir`, which is made if it is not there.
/// Numbers are written so that reading gives the same bits.
pub fn write_text(dir: &Path, reconstruction: &Reconstruction) -> Result<(), SceneError> {
    std::fs::create_dir_all(dir).map_err(SceneError::io(dir))?;
    let spaced = |values: &[f64]| values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    // Writing into a String cannot fail.
    let mut out = String::from("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]\n");
    for c in &reconstruction.cameras {
        let _ = writeln!(out, "{} {} {} {} {}", c.id, c.model.name(), c.width, c.height, spaced(&c.params));
    }
    write_atomic(&dir.join("cameras.txt"), out.as_bytes())?;

    out = String::from("# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# POINTS2D[] as (X Y POINT3D_ID)\n");
    for i in &reconstruction.images {
        let _ = writeln!(
            out,
            "{} {} {} {} {}",
            i.id,
            spaced(&i.rotation),
            spaced(&i.translation),
            i.camera_id,
            i.name
        );
        let keypoint = |k: &Keypoint| {
            let point = k.point.map_or_else(|| "-1".to_owned(), |p| p.to_string());
            format!("{} {} {point}", k.pixel[0], k.pixel[1])
        };
        let _ = writeln!(out, "{}", i.keypoints.iter().map(keypoint).collect::<Vec<_>>().join(" "));
    }
    write_atomic(&dir.join("images.txt"), out.as_bytes())?;

    out = String::from("# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)\n");
    for p in &reconstruction.points {
        let [r, g, b] = p.colour;
        let _ = write!(out, "{} {} {r} {g} {b} {}", p.id, spaced(&p.position), p.error);
        for (image, keypoint) in &p.track {
            let _ = write!(out, " {image} {keypoint}");
        }
        out.push('\n');
    }
    Ok(write_atomic(&dir.join("points3D.txt"), out.as_bytes())?)
}
