//! A `transforms.json` as it stands in its file.

use crate::{SceneError, text};
use serde::Deserialize;
use std::path::Path;

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub(super) struct Intrinsics {
    pub(super) camera_model: Option<String>,
    pub(super) camera_angle_x: Option<f64>,
    pub(super) camera_angle_y: Option<f64>,
    pub(super) fl_x: Option<f64>,
    pub(super) fl_y: Option<f64>,
    pub(super) cx: Option<f64>,
    pub(super) cy: Option<f64>,
    pub(super) w: Option<f64>,
    pub(super) h: Option<f64>,
    pub(super) k1: Option<f64>,
    pub(super) k2: Option<f64>,
    pub(super) k3: Option<f64>,
    pub(super) k4: Option<f64>,
    pub(super) k5: Option<f64>,
    pub(super) k6: Option<f64>,
    pub(super) p1: Option<f64>,
    pub(super) p2: Option<f64>,
    /// nerfstudio's other form of the same: k1, k2, k3, k4, p1, p2.
    pub(super) distortion_params: Option<Vec<f64>>,
    /// instant-ngp's words for a fisheye and for what is no lens.
    pub(super) is_fisheye: Option<bool>,
    #[serde(alias = "latlong", alias = "is_equirectangular")]
    pub(super) equirectangular: Option<bool>,
    #[serde(alias = "is_orthographic")]
    pub(super) orthographic: Option<bool>,
    /// Its polynomial of the angle (f-theta).
    pub(super) ftheta_p0: Option<f64>,
}

#[derive(Debug, Deserialize)]
pub(super) struct TransformsFrame {
    pub(super) file_path: String,
    /// Mask of the pixels to use: black is ignored.
    pub(super) mask_path: Option<String>,
    #[serde(default)]
    pub(super) transform_matrix: Vec<Vec<Option<f64>>>,
    #[serde(flatten)]
    pub(super) intrinsics: Intrinsics,
}

#[derive(Debug, Deserialize)]
pub(super) struct Transforms {
    pub(super) frames: Vec<TransformsFrame>,
    #[serde(default)]
    pub(super) ply_file_path: Option<String>,
    pub(super) train_filenames: Option<Vec<String>>,
    pub(super) val_filenames: Option<Vec<String>>,
    pub(super) test_filenames: Option<Vec<String>>,
    #[serde(flatten)]
    pub(super) intrinsics: Intrinsics,
}

impl Transforms {
    pub(super) fn read(path: &Path) -> Result<Transforms, SceneError> {
        // Python writes NaN and Infinity, which are no JSON: they become null, that is, missing.
        let text = text::read(path)?;
        let text = without_nan(&text);
        serde_json::from_str(&text)
            .map_err(|e| SceneError::invalid(path, format!("line {} column {}", e.line(), e.column()), e))
    }
}

/// The names of the photos that a transforms.json lists; `None` where there is none that can be read.
pub(crate) fn frame_names(path: &Path) -> Option<Vec<String>> {
    let transforms = Transforms::read(path).ok()?;
    Some(transforms.frames.into_iter().map(|frame| frame.file_path).collect())
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
