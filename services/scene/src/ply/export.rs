//! Splats for other programs: in the units of the reconstruction, near enough to the origin for single precision, in a file
//! whose header gives the render mode and the offset that was subtracted.

use super::to_bytes;
use crate::{SceneError, SceneFrame, Splats};
use glam::DVec3;
use segwild_files::write_atomic;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// From so many scene extents on, coordinates do not fit single precision: what is half of a millionth of the extent becomes
/// visible. Georeferenced scenes lie thousands to millions of extents from their origin.
const FAR: f64 = 500.0;

impl SceneFrame {
    /// What exported files subtract from positions of the reconstruction: zero, unless the scene lies so far from the origin
    /// that its positions would lose precision as `f32`. Whole steps of a power of ten, in file units.
    ///
    /// ```
    /// use segwild_scene::SceneFrame;
    /// let utm = SceneFrame { origin: glam::DVec3::new(448262.3, 5411932.7, 35.0), scale: 4.0 };
    /// assert_eq!(utm.offset(), glam::DVec3::new(448262.0, 5411933.0, 35.0));
    /// assert_eq!(SceneFrame { scale: 60_000.0, ..utm }.offset(), glam::DVec3::ZERO);
    /// ```
    pub fn offset(&self) -> DVec3 {
        if self.origin.abs().max_element() <= FAR * self.scale {
            return DVec3::ZERO;
        }
        let digits = self.scale.log10().floor() as i32;
        match 10f64.powi(digits.abs()) {
            // Steps below 1 are counted, for they are not binary fractions.
            many if digits < 0 => (self.origin * many).round() / many,
            step => (self.origin / step).round() * step,
        }
    }
}

/// How a file of splats was made.
#[derive(Clone, Copy, Debug)]
pub struct Export<'a> {
    /// How the splats' frame lies in the reconstruction's.
    pub frame: &'a SceneFrame,
    /// Whether opacities are compensated for the pixel filter (mip mode): a viewer has to do the same.
    pub antialias: bool,
    /// More properties of each splat: a name, and a byte per splat.
    pub extra: &'a [(&'a str, &'a [u8])],
}

impl Export<'_> {
    /// Writes splats of the normalised frame in the units of the reconstruction, less [`SceneFrame::offset`]. The header gives the
    /// render mode (`comment SplatRenderMode: mip`, or `default`) and, where there is one, the offset (`comment offset
    /// X Y Z`); the offset is also written to `NAME.offset.json` beside the file.
    ///
    /// # Panics
    /// As [`super::write_with`].
    pub fn write(&self, path: &Path, splats: &Splats) -> Result<(), SceneError> {
        write_atomic(path, &self.to_bytes(splats))?;
        note(path, self.frame.offset())
    }

    /// The bytes of the file that [`Export::write`] writes.
    ///
    /// # Panics
    /// As [`super::write_with`].
    pub fn to_bytes(&self, splats: &Splats) -> Vec<u8> {
        let offset = self.frame.offset();
        let near = SceneFrame { origin: self.frame.origin - offset, scale: self.frame.scale };
        let mode = if self.antialias { "mip" } else { "default" };
        let mut comments = vec![format!("SplatRenderMode: {mode}")];
        if offset != DVec3::ZERO {
            comments.push(format!("offset {} {} {}", offset.x, offset.y, offset.z));
        }
        to_bytes(&splats.to_file_frame(&near), self.extra, &comments)
    }
}

/// The JSON beside a file whose positions have an offset.
#[derive(Serialize, Deserialize)]
struct Note {
    /// The file's name.
    file: String,
    /// Add this to each position of the file for the coordinates of the reconstruction.
    offset: [f64; 3],
}

/// Writes the offset beside a file, and takes away what an earlier file of that name left there.
fn note(path: &Path, offset: DVec3) -> Result<(), SceneError> {
    let beside = beside(path);
    let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if offset != DVec3::ZERO {
        let note = Note { file, offset: offset.to_array() };
        let text = serde_json::to_vec_pretty(&note)
            .map_err(|e| SceneError::invalid(&beside, "the offset", e.to_string()))?;
        return Ok(write_atomic(&beside, &text)?);
    }
    let old: Option<Note> = std::fs::read(&beside).ok().and_then(|text| serde_json::from_slice(&text).ok());
    match old {
        Some(note) if note.file == file => std::fs::remove_file(&beside).map_err(SceneError::io(&beside)),
        _ => Ok(()),
    }
}

/// Where the offset of a file stands.
fn beside(path: &Path) -> PathBuf {
    path.with_extension("offset.json")
}
