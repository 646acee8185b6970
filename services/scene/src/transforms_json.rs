//! A `transforms.json` as it stands in its file.

use crate::{SceneError, text};
use serde::Deserialize;
use std::path::Path;

#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default)]
pub(crate) struct Intrinsics {
    pub(crate) camera_model: Option<String>,
    pub(crate) camera_angle_x: Option<f64>,
    pub(crate) camera_angle_y: Option<f64>,
    pub(crate) fl_x: Option<f64>,
    pub(crate) fl_y: Option<f64>,
    pub(crate) cx: Option<f64>,
    pub(crate) cy: Option<f64>,
    pub(crate) w: Option<f64>,
    pub(crate) h: Option<f64>,
    pub(crate) k1: Option<f64>,
    pub(crate) k2: Option<f64>,
    pub(crate) k3: Option<f64>,
    pub(crate) k4: Option<f64>,
    pub(crate) k5: Option<f64>,
    pub(crate) k6: Option<f64>,
    pub(crate) p1: Option<f64>,
    pub(crate) p2: Option<f64>,
    /// nerfstudio's other form of the same: k1, k2, k3, k4, p1, p2.
    pub(crate) distortion_params: Option<Vec<f64>>,
    /// instant-ngp's words for a fisheye and for what is no lens.
    pub(crate) is_fisheye: Option<bool>,
    #[serde(alias = "latlong", alias = "is_equirectangular")]
    pub(crate) equirectangular: Option<bool>,
    #[serde(alias = "is_orthographic")]
    pub(crate) orthographic: Option<bool>,
    /// Its polynomial of the angle (f-theta).
    pub(crate) ftheta_p0: Option<f64>,
}

#[derive(Debug, Deserialize)]
pub(crate) struct TransformsFrame {
    pub(crate) file_path: String,
    /// Mask of the pixels to use: black is ignored.
    pub(crate) mask_path: Option<String>,
    #[serde(default)]
    pub(crate) transform_matrix: Vec<Vec<Option<f64>>>,
    #[serde(flatten)]
    pub(crate) intrinsics: Intrinsics,
}

#[derive(Debug, Deserialize)]
pub(crate) struct Transforms {
    pub(crate) frames: Vec<TransformsFrame>,
    #[serde(default)]
    pub(crate) ply_file_path: Option<String>,
    pub(crate) train_filenames: Option<Vec<String>>,
    pub(crate) val_filenames: Option<Vec<String>>,
    pub(crate) test_filenames: Option<Vec<String>>,
    #[serde(flatten)]
    pub(crate) intrinsics: Intrinsics,
}

impl Transforms {
    pub(crate) fn read(path: &Path) -> Result<Transforms, SceneError> {
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
