//! How a CLIP model wants its images.

use crate::VisionError;
use crate::builtin::check;
use crate::clip_file_error::TokenizerError;
use crate::clip_interface::SIDES;
use segwild_scene::Image;
use serde_json::Value;

/// Side of CLIP's images where neither the network nor a file beside it says, in pixels.
const SIDE: usize = 224;
/// Mean per channel of CLIP's training images, sRGB in [0, 1] (`clip/clip.py` of the published code). Pixels of this colour are 0
/// after standardisation.
pub const CLIP_MEAN: [f32; 3] = [0.481_454_66, 0.457_827_5, 0.408_210_73];
/// Standard deviation per channel of these images.
const CLIP_DEVIATION: [f32; 3] = [0.268_629_54, 0.261_302_6, 0.275_777_1];

/// How images are scaled.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipScaling {
    /// Side of the square, in pixels.
    pub side: usize,
    /// Mean and standard deviation per channel, sRGB in [0, 1].
    pub channels: [(f32, f32); 3],
}

impl Default for ClipScaling {
    fn default() -> ClipScaling {
        let channels = std::array::from_fn(|c| (CLIP_MEAN[c], CLIP_DEVIATION[c]));
        ClipScaling { side: SIDE, channels }
    }
}

impl ClipScaling {
    /// As CLIP, with the side that a network fixes.
    pub(super) fn with_side(side: Option<usize>) -> ClipScaling {
        let usual = ClipScaling::default();
        ClipScaling { side: side.unwrap_or(usual.side), ..usual }
    }

    /// Reads `preprocessor_config.json`. What it does not say is as in CLIP. `side`: what the network fixes, whatever the file says.
    ///
    /// # Errors
    /// When it is no JSON, or what it says makes no sense.
    pub fn of_json(bytes: &[u8], side: Option<usize>) -> Result<ClipScaling, TokenizerError> {
        let config: Value = serde_json::from_slice(bytes).map_err(TokenizerError::Json)?;
        let mut scaling = ClipScaling::with_side(side);
        let size =
            ["crop_size", "size"].into_iter().find_map(|name| config.get(name).map(|size| (name, size)));
        if let Some((name, size)) = size.filter(|_| side.is_none()) {
            let side = ["height", "shortest_edge"].iter().find_map(|edge| size.get(edge)).unwrap_or(size);
            let side = side.as_u64().and_then(|side| usize::try_from(side).ok());
            scaling.side = side.filter(|side| SIDES.contains(side)).ok_or_else(|| {
                let found = format!("{}; a side of 16 to 1024 pixels was expected", short(size));
                TokenizerError::Scaling { name, found }
            })?;
        }
        let mean = three(&config, "image_mean", -10.0..=10.0)?;
        let deviation = three(&config, "image_std", 1e-3..=10.0)?;
        for (c, (of_mean, of_deviation)) in scaling.channels.iter_mut().enumerate() {
            *of_mean = mean.map_or(*of_mean, |mean| mean[c]);
            *of_deviation = deviation.map_or(*of_deviation, |deviation| deviation[c]);
        }
        Ok(scaling)
    }

    /// The planes of an image, standardised. Squares are expected: others are stretched to one.
    pub(super) fn planes(&self, image: &Image) -> Result<Vec<f32>, VisionError> {
        check(image)?;
        let mut fitted = image.resized(self.side, self.side);
        for (c, (mean, deviation)) in self.channels.into_iter().enumerate() {
            fitted.plane_mut(c).iter_mut().for_each(|v| *v = (*v - mean) / deviation);
        }
        Ok(fitted.data)
    }
}

/// What a `preprocessor_config.json` of another model says it is for; `None` where it may be CLIP's.
pub(super) fn other_model(bytes: &[u8]) -> Option<String> {
    let config: Value = serde_json::from_slice(bytes).ok()?;
    let names = ["image_processor_type", "feature_extractor_type"];
    let found: Vec<&str> = names.iter().filter_map(|name| config.get(name)?.as_str()).collect();
    let other = found.first().filter(|_| !found.iter().any(|name| name.contains("CLIP")))?;
    Some(other.chars().take(40).filter(|c| !c.is_control()).collect())
}

/// Three numbers of an entry; `None` where it is not there.
fn three(
    config: &Value,
    name: &'static str,
    range: std::ops::RangeInclusive<f64>,
) -> Result<Option<[f32; 3]>, TokenizerError> {
    let Some(entry) = config.get(name) else { return Ok(None) };
    let number = |value: &Value| value.as_f64().filter(|v| range.contains(v)).map(|v| v as f32);
    let numbers: Option<Vec<f32>> = entry.as_array().and_then(|all| all.iter().map(number).collect());
    match numbers.and_then(|numbers| <[f32; 3]>::try_from(numbers).ok()) {
        Some(numbers) => Ok(Some(numbers)),
        None => {
            let (least, most) = range.into_inner();
            let found = format!("{}; three numbers from {least} to {most} were expected", short(entry));
            Err(TokenizerError::Scaling { name, found })
        }
    }
}

/// The start of a value's text.
fn short(value: &Value) -> String {
    value.to_string().chars().take(60).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_beside_the_networks_says_how_images_are_scaled() {
        let of = |text: &str| ClipScaling::of_json(text.as_bytes(), None);
        assert_eq!(of("{}").unwrap(), ClipScaling::default());
        for text in [r#"{"crop_size": {"height": 336, "width": 336}}"#, r#"{"crop_size": 336, "size": 512}"#]
        {
            assert_eq!(of(text).unwrap().side, 336, "{text}");
        }
        assert_eq!(of(r#"{"size": {"shortest_edge": 256}}"#).unwrap().side, 256);
        let half = of(r#"{"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.25]}"#).unwrap();
        assert_eq!(half.channels, [(0.5, 0.5), (0.5, 0.5), (0.5, 0.25)]);
        for (text, word) in [
            (r#"{"crop_size": 9000000}"#, "`crop_size` is 9000000"),
            (r#"{"size": {"longest_edge": 256}}"#, "`size`"),
            (r#"{"image_std": [0.0, 1.0, 1.0]}"#, "`image_std`"),
            (r#"{"image_mean": [0.5]}"#, "`image_mean` is [0.5]"),
            ("[", "CLIP"),
        ] {
            let words = of(text).unwrap_err().to_string();
            assert!(words.contains(word), "{words}");
        }
    }

    #[test]
    fn a_file_of_sam_says_nothing_of_clip() {
        let sam = br#"{"image_processor_type": "SamImageProcessor", "size": {"longest_edge": 1024}}"#;
        assert_eq!(other_model(sam).as_deref(), Some("SamImageProcessor"));
        for text in [
            r#"{"image_processor_type": "CLIPImageProcessor"}"#,
            r#"{"feature_extractor_type": "CLIPFeatureExtractor"}"#,
            r#"{"image_processor_type": "BlipImageProcessor", "feature_extractor_type": "CLIPFeatureExtractor"}"#,
            r#"{"size": 224}"#,
            "[",
        ] {
            assert_eq!(other_model(text.as_bytes()), None, "{text}");
        }
        // A network that fixes the side needs no size.
        assert_eq!(ClipScaling::of_json(sam, Some(336)).unwrap().side, 336);
        assert!(ClipScaling::of_json(sam, None).is_err());
    }
}
