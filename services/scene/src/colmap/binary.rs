//! COLMAP's `.bin` files: little endian, a count of records and then the records.

use super::records::{CameraRecord, ImageRecord, KeepFeature, Keypoint, PointRecord, Reconstruction};
use crate::SceneError;
use crate::lens::CameraModel;
use segwild_files::write_atomic;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

/// COLMAP's mark for a keypoint without a 3D point.
const NO_POINT: u64 = u64::MAX;

/// Reads one file from its start to its end; every error names the record that was being read.
struct Cursor<'a> {
    path: &'a Path,
    file: BufReader<File>,
    /// Bytes of the file.
    length: u64,
    at: u64,
    record: String,
    start: u64,
}

impl<'a> Cursor<'a> {
    fn open(path: &'a Path) -> Result<Cursor<'a>, SceneError> {
        let file = segwild_files::open_plain(path).map_err(SceneError::io(path))?;
        let length = file.metadata().map_err(SceneError::io(path))?.len();
        let file = BufReader::new(file);
        Ok(Cursor { path, file, length, at: 0, record: "the count of records".into(), start: 0 })
    }

    fn start(&mut self, record: String) {
        self.record = record;
        self.start = self.at;
    }

    fn left(&self) -> u64 {
        self.length - self.at
    }

    /// Refuses what the rest of the file cannot hold.
    fn needs(&self, needed: u64) -> Result<(), SceneError> {
        let left = self.left();
        if needed <= left {
            return Ok(());
        }
        let (path, record, offset) = (self.path.to_owned(), self.record.clone(), self.start);
        Err(SceneError::Truncated { path, record, offset, needed, left })
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], SceneError> {
        self.needs(N as u64)?;
        let mut bytes = [0; N];
        // A file that was cut since it was opened.
        self.file.read_exact(&mut bytes).map_err(SceneError::io(self.path))?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn u32(&mut self) -> Result<u32, SceneError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<u64, SceneError> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], SceneError> {
        let mut values = [0.0; N];
        for v in &mut values {
            *v = f64::from_le_bytes(self.array()?);
        }
        Ok(values)
    }

    /// Text up to a zero byte.
    fn text(&mut self) -> Result<String, SceneError> {
        let left = self.left();
        let mut bytes = Vec::new();
        let read =
            self.file.by_ref().take(left).read_until(0, &mut bytes).map_err(SceneError::io(self.path))?;
        if bytes.pop() != Some(0) {
            self.needs(left + 1)?;
        }
        self.at += read as u64;
        Ok(crate::text::line(&bytes))
    }

    /// A count of things of `size` bytes each that must follow: refused before anything is allocated.
    fn count(&mut self, size: u64) -> Result<usize, SceneError> {
        let n = self.u64()?;
        self.needs(n.saturating_mul(size))?;
        Ok(n as usize)
    }

    fn invalid(&self, reason: String) -> SceneError {
        SceneError::invalid(self.path, format!("{} at byte {}", self.record, self.start), reason)
    }

    fn end(&self) -> Result<(), SceneError> {
        let left = self.left();
        if left == 0 {
            return Ok(());
        }
        let location = format!("byte {}", self.at);
        Err(SceneError::invalid(
            self.path,
            location,
            format!("{left} bytes follow the last record; the file is damaged"),
        ))
    }
}

/// Reads `name` under `dir` record by record. The count in the header is believed only as far as records follow.
fn records<T>(
    dir: &Path,
    name: &str,
    what: &str,
    mut read: impl FnMut(&mut Cursor<'_>) -> Result<T, SceneError>,
) -> Result<Vec<T>, SceneError> {
    let path = dir.join(name);
    let mut cursor = Cursor::open(&path)?;
    let count = cursor.u64()?;
    let mut all = Vec::new();
    for i in 1..=count {
        cursor.start(format!("{what} {i} of {count}"));
        all.push(read(&mut cursor)?);
    }
    cursor.end()?;
    Ok(all)
}

/// The cameras of `cameras.bin`.
pub(super) fn cameras(dir: &Path) -> Result<Vec<CameraRecord>, SceneError> {
    records(dir, "cameras.bin", "camera", |c| {
        let id = c.u32()?;
        let number = c.u32()? as i32;
        let Some(model) = CameraModel::from_id(number) else {
            return Err(c.invalid(format!(
                "camera {id} has the model number {number}, which is not known here; \
                 undistort the photos with COLMAP (image_undistorter) first"
            )));
        };
        let (width, height) = (c.u64()?, c.u64()?);
        let mut params = Vec::with_capacity(model.param_count());
        for _ in 0..model.param_count() {
            params.extend(c.f64s::<1>()?);
        }
        Ok(CameraRecord { id, model, width, height, params })
    })
}

/// The photos of `images.bin`, with those of their features for which `keep` returns true.
pub(super) fn images(dir: &Path, keep: &mut KeepFeature<'_>) -> Result<Vec<ImageRecord>, SceneError> {
    records(dir, "images.bin", "image", |c| {
        let id = c.u32()?;
        let (rotation, translation) = (c.f64s()?, c.f64s()?);
        let camera_id = c.u32()?;
        let name = c.text()?;
        let mut keypoints = Vec::new();
        for index in 0..c.count(24)? {
            let pixel = c.f64s()?;
            let point = c.u64()?;
            let keypoint = Keypoint { pixel, point: (point != NO_POINT).then_some(point) };
            if keep(id, index as u32, keypoint) {
                keypoints.push(keypoint);
            }
        }
        Ok(ImageRecord { id, rotation, translation, camera_id, name, keypoints })
    })
}

/// The points of `points3D.bin`.
pub(super) fn points(dir: &Path) -> Result<Vec<PointRecord>, SceneError> {
    records(dir, "points3D.bin", "point", |c| {
        let id = c.u64()?;
        let position = c.f64s()?;
        let colour = c.array()?;
        let [error] = c.f64s()?;
        let n = c.count(8)?;
        let mut track = Vec::with_capacity(n);
        for _ in 0..n {
            track.push((c.u32()?, c.u32()?));
        }
        Ok(PointRecord { id, position, colour, error, track })
    })
}

/// Writes `cameras.bin`, `images.bin` and `points3D.bin` into `dir`, which is made if it is not there.
pub fn write(dir: &Path, reconstruction: &Reconstruction) -> Result<(), SceneError> {
    std::fs::create_dir_all(dir).map_err(SceneError::io(dir))?;
    let mut out = Vec::new();
    put_u64(&mut out, reconstruction.cameras.len() as u64);
    for camera in &reconstruction.cameras {
        out.extend(camera.id.to_le_bytes());
        out.extend(camera.model.id().to_le_bytes());
        put_u64(&mut out, camera.width);
        put_u64(&mut out, camera.height);
        put_f64s(&mut out, &camera.params);
    }
    write_atomic(&dir.join("cameras.bin"), &out)?;

    out.clear();
    put_u64(&mut out, reconstruction.images.len() as u64);
    for image in &reconstruction.images {
        out.extend(image.id.to_le_bytes());
        put_f64s(&mut out, &image.rotation);
        put_f64s(&mut out, &image.translation);
        out.extend(image.camera_id.to_le_bytes());
        out.extend(image.name.as_bytes());
        out.push(0);
        put_u64(&mut out, image.keypoints.len() as u64);
        for keypoint in &image.keypoints {
            put_f64s(&mut out, &keypoint.pixel);
            put_u64(&mut out, keypoint.point.unwrap_or(NO_POINT));
        }
    }
    write_atomic(&dir.join("images.bin"), &out)?;

    out.clear();
    put_u64(&mut out, reconstruction.points.len() as u64);
    for point in &reconstruction.points {
        put_u64(&mut out, point.id);
        put_f64s(&mut out, &point.position);
        out.extend(point.colour);
        put_f64s(&mut out, &[point.error]);
        put_u64(&mut out, point.track.len() as u64);
        for (image, keypoint) in &point.track {
            out.extend(image.to_le_bytes());
            out.extend(keypoint.to_le_bytes());
        }
    }
    Ok(write_atomic(&dir.join("points3D.bin"), &out)?)
}

fn put_u64(out: &mut Vec<u8>, value: u64) {
    out.extend(value.to_le_bytes());
}

fn put_f64s(out: &mut Vec<u8>, values: &[f64]) {
    for v in values {
        out.extend(v.to_le_bytes());
    }
}
