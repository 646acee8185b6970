//! COLMAP's `.bin` files: little endian, a count of records and then the records.

use super::records::{CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction};
use crate::SceneError;
use crate::lens::CameraModel;
use segwild_files::write_atomic;
use std::path::Path;

/// COLMAP's mark for a keypoint without a 3D point.
const NO_POINT: u64 = u64::MAX;

/// Reads the bytes of one file; every error names the record that was being read.
struct Cursor<'a> {
    path: &'a Path,
    bytes: &'a [u8],
    at: usize,
    record: String,
    start: usize,
}

impl<'a> Cursor<'a> {
    fn new(path: &'a Path, bytes: &'a [u8]) -> Cursor<'a> {
        Cursor { path, bytes, at: 0, record: "the count of records".into(), start: 0 }
    }

    fn start(&mut self, record: String) {
        self.record = record;
        self.start = self.at;
    }

    fn take(&mut self, n: usize) -> Result<&'a [u8], SceneError> {
        let left = self.bytes.len() - self.at;
        if n > left {
            return Err(SceneError::Truncated {
                path: self.path.to_owned(),
                record: self.record.clone(),
                offset: self.start as u64,
                needed: n as u64,
                left: left as u64,
            });
        }
        let taken = &self.bytes[self.at..self.at + n];
        self.at += n;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], SceneError> {
        Ok(self.take(N)?.try_into().expect("take returns what was asked for"))
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

    /// A count of things of `size` bytes each that must follow: refused before anything is allocated.
    fn count(&mut self, size: usize) -> Result<usize, SceneError> {
        let n = self.u64()?;
        let left = (self.bytes.len() - self.at) as u64;
        let needed = n.saturating_mul(size as u64);
        if needed > left {
            return Err(SceneError::Truncated {
                path: self.path.to_owned(),
                record: self.record.clone(),
                offset: self.start as u64,
                needed,
                left,
            });
        }
        Ok(n as usize)
    }

    fn invalid(&self, reason: String) -> SceneError {
        SceneError::invalid(self.path, format!("{} at byte {}", self.record, self.start), reason)
    }

    fn end(&self) -> Result<(), SceneError> {
        let left = self.bytes.len() - self.at;
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
    let bytes = crate::bytes::read_bytes(&path).map_err(SceneError::io(&path))?;
    let mut cursor = Cursor::new(&path, &bytes);
    let count = cursor.u64()?;
    let mut all = Vec::new();
    for i in 1..=count {
        cursor.start(format!("{what} {i} of {count}"));
        all.push(read(&mut cursor)?);
    }
    cursor.end()?;
    Ok(all)
}

pub(super) fn read(dir: &Path) -> Result<Reconstruction, SceneError> {
    let cameras = records(dir, "cameras.bin", "camera", |c| {
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
    })?;
    let images = records(dir, "images.bin", "image", |c| {
        let id = c.u32()?;
        let (rotation, translation) = (c.f64s()?, c.f64s()?);
        let camera_id = c.u32()?;
        let rest = &c.bytes[c.at..];
        let length = rest.iter().position(|&b| b == 0).unwrap_or(rest.len());
        let name = c.take(length + 1)?;
        let name = crate::text::line(&name[..length]);
        let n = c.count(24)?;
        let mut keypoints = Vec::with_capacity(n);
        for _ in 0..n {
            let pixel = c.f64s()?;
            let point = c.u64()?;
            keypoints.push(Keypoint { pixel, point: (point != NO_POINT).then_some(point) });
        }
        Ok(ImageRecord { id, rotation, translation, camera_id, name, keypoints })
    })?;
    Ok(Reconstruction { cameras, images, ..Reconstruction::default() })
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
