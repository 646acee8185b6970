//! Splats for other programs: in the units of the reconstruction, near enough to the origin for single precision, in a file
//! that gives the render mode and the offset that was subtracted, where its format can.

mod glb;
mod rotation;
mod spz;

use crate::ply::to_bytes;
use crate::settings::Value as _;
use crate::{SceneError, SceneFrame, Splats, choice};
use glam::DVec3;
use segwild_files::write_atomic;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::io;
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

choice! {
    /// A format of files of splats.
    pub enum SplatFormat {
        /// The layout of 3D Gaussian splatting: every property as a 32-bit float.
        Ply = "ply",
        /// Niantic's packed splats, about a tenth as large.
        Spz = "spz",
        /// Binary glTF with `KHR_gaussian_splatting`.
        Glb = "glb",
    }
}

impl SplatFormat {
    /// The format that a file's ending names.
    ///
    /// ```
    /// use segwild_scene::SplatFormat;
    /// assert_eq!(SplatFormat::of("statue.SPZ".as_ref()).ok(), Some(SplatFormat::Spz));
    /// assert!(SplatFormat::of("statue.obj".as_ref()).is_err());
    /// ```
    ///
    /// # Errors
    /// When it names none that is written.
    pub fn of(path: &Path) -> Result<SplatFormat, SceneError> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let refused = || {
            let reason = "splats are written as .ply, .spz or .glb";
            SceneError::invalid(path, "its ending", reason)
        };
        SplatFormat::read(&ending).map_err(|_| refused())
    }
}

/// About x: from COLMAP's axes (x right, y down, z ahead) to those of `.spz` (x right, y up, z towards the viewer).
const X: usize = 0;
/// About z: to those of glTF (x left, y up, z ahead).
const Z: usize = 2;

/// How a file of splats was made.
#[derive(Clone, Copy, Debug)]
pub struct Export<'a> {
    /// How the splats' frame lies in the reconstruction's.
    pub frame: &'a SceneFrame,
    /// Whether opacities are compensated for the pixel filter (mip mode): a viewer has to do the same.
    pub antialias: bool,
    /// More properties of each splat, for a `.ply`: a name, and a byte per splat.
    pub extra: &'a [(&'a str, &'a [u8])],
    /// How the splats were made, as a JSON object. A `.glb` has all of it in `asset.extras`, as `provenance`; a `.ply` its words
    /// `version` and `scene` in a comment. `.spz` has no field for it.
    pub provenance: Option<&'a serde_json::Value>,
}

impl Export<'_> {
    /// Writes splats of the normalised frame in the units of the reconstruction, less [`SceneFrame::offset`], in the format that
    /// the file's ending names. The offset, where there is one, is also written to `NAME.offset.json` beside the file.
    ///
    /// # Errors
    /// When the ending names no format, or the disk fails.
    ///
    /// # Panics
    /// As [`crate::ply::write_with`].
    pub fn write(&self, path: &Path, splats: &Splats) -> Result<(), SceneError> {
        let format = SplatFormat::of(path)?;
        write_atomic(path, &self.encode(format, splats).map_err(SceneError::io(path))?)?;
        self.note_offset(path)
    }

    /// The bytes of a file. Of a `.ply`, the header gives the render mode (`comment SplatRenderMode: mip`, or `default`) and, where
    /// there are any, the offset (`comment offset X Y Z`) and the provenance (`comment segwild version=V scene=HASH`).
    ///
    /// # Errors
    /// When the compression of `.spz` fails.
    ///
    /// # Panics
    /// As [`crate::ply::write_with`].
    pub fn encode(&self, format: SplatFormat, splats: &Splats) -> io::Result<Vec<u8>> {
        let (splats, offset, mode) = (self.in_file_frame(splats), self.frame.offset(), self.mode());
        Ok(match format {
            SplatFormat::Ply => {
                let mut comments = vec![format!("SplatRenderMode: {mode}")];
                if offset != DVec3::ZERO {
                    comments.push(format!("offset {} {} {}", offset.x, offset.y, offset.z));
                }
                comments.extend(self.provenance.map(comment));
                to_bytes(&splats, self.extra, &comments)
            }
            SplatFormat::Spz => spz::to_bytes(&splats.half_turned(X), self.antialias)?,
            SplatFormat::Glb => {
                let mut notes = json!({ "SplatRenderMode": mode, "offset": offset.to_array() });
                if let Some(provenance) = self.provenance {
                    notes["provenance"] = provenance.clone();
                }
                glb::to_bytes(&splats.half_turned(Z), &notes)
            }
        })
    }

    fn mode(&self) -> &'static str {
        if self.antialias { "mip" } else { "default" }
    }

    fn in_file_frame(&self, splats: &Splats) -> Splats {
        let origin = self.frame.origin - self.frame.offset();
        splats.to_file_frame(&SceneFrame { origin, scale: self.frame.scale })
    }

    /// Writes the offset beside a file, and removes what an earlier file of that name left there.
    ///
    /// # Errors
    /// When the disk fails.
    pub fn note_offset(&self, path: &Path) -> Result<(), SceneError> {
        note(path, self.frame.offset())
    }
}

/// Longest word of a comment: some readers take lines of 1024 characters at most.
const LONGEST_WORD: usize = 100;

/// Provenance as a comment of a `.ply`: a line of ASCII, as its readers expect.
fn comment(provenance: &serde_json::Value) -> String {
    let plain = |c: char| if c.is_ascii_graphic() { c } else { '_' };
    let word = |name: &str| {
        let value: String = provenance[name].as_str()?.chars().take(LONGEST_WORD).map(plain).collect();
        Some(format!(" {name}={value}"))
    };
    format!("segwild{}", ["version", "scene"].into_iter().filter_map(word).collect::<String>())
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
