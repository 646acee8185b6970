//! COLMAP reconstructions: reading and writing `cameras`, `images` and `points3D`, binary and text.
//!
//! The records are as the files hold them, in the file's units, unchecked beyond their form: which photos can be
//! used is decided by [`crate::Scene::open`].

mod binary;
mod models;
mod records;
mod text;
mod tracked;

pub use crate::lens::CameraModel;
pub use binary::write;
pub use models::MODEL_FOLDERS;
pub(crate) use models::{find, numbered_photos};
pub use records::{CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction};
pub use text::write_text;
pub(crate) use tracked::TrackedPixels;

use crate::SceneError;
use records::KeepFeature;
use std::collections::HashMap;
use std::path::Path;

/// Reads a reconstruction from the folder that holds its files; `.bin` is preferred to `.txt`.
/// The points are read in the other form where they are there in that alone; a folder without `points3D` gives no points.
pub fn read(dir: &Path) -> Result<Reconstruction, SceneError> {
    read_as(dir, form(dir), &mut |_, _, _| true)
}

/// Reads a reconstruction without features, and the pixels of the features that its points name: most features belong to no
/// point, and those of a thousand photos would take more memory than the photos' training.
pub(crate) fn read_tracked(dir: &Path) -> Result<(Reconstruction, TrackedPixels), SceneError> {
    let form = form(dir);
    let read = cameras(dir, form)?;
    let points = points(dir, form)?;
    let mut pixels = TrackedPixels::of(&points);
    let images = images(dir, form, &mut |image, index, keypoint| {
        pixels.put(image, index, keypoint.pixel);
        false
    })?;
    Ok((Reconstruction { images, points, ..read }, pixels))
}

/// The form in which cameras and photos are read.
fn form(dir: &Path) -> &'static str {
    if has(dir, "bin") { "bin" } else { "txt" }
}

fn read_as(dir: &Path, form: &str, keep: &mut KeepFeature<'_>) -> Result<Reconstruction, SceneError> {
    let read = cameras(dir, form)?;
    let images = images(dir, form, keep)?;
    Ok(Reconstruction { images, points: points(dir, form)?, ..read })
}

/// A reconstruction with its cameras alone.
fn cameras(dir: &Path, form: &str) -> Result<Reconstruction, SceneError> {
    if form == "bin" {
        return Ok(Reconstruction { cameras: binary::cameras(dir)?, ..Reconstruction::default() });
    }
    let (cameras, unknown_cameras) = text::cameras(dir)?;
    Ok(Reconstruction { cameras, unknown_cameras, ..Reconstruction::default() })
}

/// The photos of a reconstruction.
fn images(dir: &Path, form: &str, keep: &mut KeepFeature<'_>) -> Result<Vec<ImageRecord>, SceneError> {
    if form == "bin" { binary::images(dir, keep) } else { text::images(dir, keep) }
}

/// The points of a reconstruction whose cameras are of this form.
fn points(dir: &Path, form: &str) -> Result<Vec<PointRecord>, SceneError> {
    match points_form(dir, form) {
        Some("bin") => binary::points(dir),
        Some(_) => text::points(dir),
        None => Ok(Vec::new()),
    }
}

/// The form of the points of a reconstruction whose cameras are of this form: the same, if there are any in it.
fn points_form(dir: &Path, form: &str) -> Option<&'static str> {
    let forms = if form == "bin" { ["bin", "txt"] } else { ["txt", "bin"] };
    forms.into_iter().find(|form| dir.join(format!("points3D.{form}")).is_file())
}

/// The note where the points are of another form than the cameras and photos.
pub(crate) fn mixed(dir: &Path) -> Option<String> {
    let own = form(dir);
    let other = points_form(dir, own).filter(|other| *other != own)?;
    let dir = dir.display();
    Some(format!("{dir}: the points are those of points3D.{other}, for there is no points3D.{own}"))
}

/// Whether a folder holds `cameras` and `images` of one form.
fn has(dir: &Path, form: &str) -> bool {
    ["cameras", "images"].iter().all(|file| dir.join(format!("{file}.{form}")).is_file())
}

/// Whether a folder holds the points of a reconstruction.
pub(crate) fn has_points(dir: &Path) -> bool {
    points_form(dir, "bin").is_some()
}

/// Where the two forms of a reconstruction differ, in words: somebody edited the `.txt`, and the `.bin` beside it is read.
pub(crate) fn stale(dir: &Path) -> Option<String> {
    if !(has(dir, "bin") && has(dir, "txt")) {
        return None;
    }
    let read = |form| read_as(dir, form, &mut |_, _, _| false);
    let differs = match (read("bin"), read("txt")) {
        (Ok(bin), Ok(text)) => difference(&bin, &text)?,
        (Ok(_), Err(error)) => error.to_string(),
        // Errors in the .bin are reported when it is read.
        (Err(_), _) => return None,
    };
    Some(format!(
        "{}: the .txt files do not say what the .bin files say ({differs}); the .bin files are read: remove them to use the .txt",
        dir.display()
    ))
}

/// In what two reconstructions differ, beyond the digits that text leaves out.
fn difference(a: &Reconstruction, b: &Reconstruction) -> Option<String> {
    let alike =
        |x: f64, y: f64| (x - y).abs() <= 1e-4 * (1.0 + x.abs().max(y.abs())) || x.to_bits() == y.to_bits();
    let all = |x: &[f64], y: &[f64]| x.len() == y.len() && x.iter().zip(y).all(|(x, y)| alike(*x, *y));
    if a.images.len() != b.images.len() {
        return Some(format!("{} photos and {}", b.images.len(), a.images.len()));
    }
    let others: HashMap<u32, &ImageRecord> = b.images.iter().map(|image| (image.id, image)).collect();
    for image in &a.images {
        let same = others.get(&image.id).is_some_and(|other| {
            image.name == other.name
                && image.camera_id == other.camera_id
                && all(&image.rotation, &other.rotation)
                && all(&image.translation, &other.translation)
        });
        if !same {
            return Some(format!("photo {}", image.name));
        }
    }
    let others: HashMap<u32, &CameraRecord> = b.cameras.iter().map(|camera| (camera.id, camera)).collect();
    for camera in &a.cameras {
        let same = others.get(&camera.id).is_some_and(|other| {
            (camera.model, camera.width, camera.height) == (other.model, other.width, other.height)
                && all(&camera.params, &other.params)
        });
        if !same {
            return Some(format!("camera {}", camera.id));
        }
    }
    (a.points.len() != b.points.len()).then(|| format!("{} points and {}", b.points.len(), a.points.len()))
}
