//! The names of network files: which part of which pair a file is.
//!
//! `STEM_encoder.onnx` and `STEM_decoder.onnx` are a pair, with `_`, `.` or `-` in the middle. A word for the numbers' precision may
//! follow (`_int8`, `_fp16`, `.quant`). Other exports have names of their own, which are known as well.

use crate::family::is_known;

/// The part of a pair.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum SamPart {
    Encoder,
    Decoder,
}

impl SamPart {
    pub fn name(self) -> &'static str {
        match self {
            SamPart::Encoder => "encoder",
            SamPart::Decoder => "decoder",
        }
    }

    pub fn other(self) -> SamPart {
        match self {
            SamPart::Encoder => SamPart::Decoder,
            SamPart::Decoder => SamPart::Encoder,
        }
    }
}

/// The precision of a file's numbers, going by its name. The first one is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum NamedPrecision {
    Full,
    Half,
    Quantised,
}

/// What a file's name says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct PartName {
    pub stem: String,
    pub part: SamPart,
    pub precision: NamedPrecision,
    /// Names of one part and precision: the lower one is taken.
    pub style: usize,
}

/// Separators of the stem, the part and the precision.
const JOINTS: [char; 3] = ['_', '.', '-'];

/// Stems of exports whose files have no stem of their own.
const VISION: &str = "vision";
const IMAGE: &str = "image";

/// Ends of names, the longer ones first: the part, and the stem of files that are named so and no more.
const ENDINGS: [(&str, SamPart, Option<&str>); 6] = [
    ("prompt_encoder_mask_decoder", SamPart::Decoder, Some(VISION)),
    ("vision_encoder", SamPart::Encoder, Some(VISION)),
    ("image_encoder", SamPart::Encoder, Some(IMAGE)),
    ("image_decoder", SamPart::Decoder, Some(IMAGE)),
    ("encoder", SamPart::Encoder, None),
    ("decoder", SamPart::Decoder, None),
];

/// Words for a precision.
const PRECISIONS: [(&str, NamedPrecision); 15] = [
    ("fp32", NamedPrecision::Full),
    ("fp16", NamedPrecision::Half),
    ("f16", NamedPrecision::Half),
    ("half", NamedPrecision::Half),
    ("quantized", NamedPrecision::Quantised),
    ("quantised", NamedPrecision::Quantised),
    ("quant", NamedPrecision::Quantised),
    ("uint8", NamedPrecision::Quantised),
    ("int8", NamedPrecision::Quantised),
    ("qint8", NamedPrecision::Quantised),
    ("q8", NamedPrecision::Quantised),
    ("q4f16", NamedPrecision::Quantised),
    ("q4", NamedPrecision::Quantised),
    ("int4", NamedPrecision::Quantised),
    ("bnb4", NamedPrecision::Quantised),
];

/// A name without the word for its precision at the end.
fn without_precision(name: &str) -> (&str, NamedPrecision) {
    PRECISIONS
        .iter()
        .find_map(|(word, precision)| Some((name.strip_suffix(*word)?.strip_suffix(JOINTS)?, *precision)))
        .unwrap_or((name, NamedPrecision::Full))
}

/// Whether files of this stem have no stem of their own.
pub(crate) fn is_bare(stem: &str) -> bool {
    [VISION, IMAGE].contains(&stem)
}

/// Which part a file is, going by its name; `None` of a name that is no part's.
pub(crate) fn part_name(file: &str) -> Option<PartName> {
    let (name, precision) = without_precision(file.strip_suffix(".onnx")?);
    for (style, (ending, part, bare)) in ENDINGS.into_iter().enumerate() {
        let Some(rest) = name.strip_suffix(ending) else { continue };
        let joint = JOINTS.iter().position(|&joint| rest.ends_with(joint));
        let stem = match joint {
            Some(_) => rest.strip_suffix(JOINTS),
            None => bare.filter(|_| rest.is_empty()),
        };
        let Some(stem) = stem.filter(|stem| !stem.is_empty()) else { continue };
        let (stem, before) = without_precision(stem);
        let style = JOINTS.len() * (ENDINGS.len() - style) + joint.unwrap_or(0);
        return Some(PartName { stem: stem.to_owned(), part, precision: precision.max(before), style });
    }
    // sam-cpp-macos: `sam2.1_tiny_preprocess.onnx` and `sam2.1_tiny.onnx`. MobileSAM's own script: `mobile_sam.onnx`.
    let (stem, part) = match name.strip_suffix("_preprocess") {
        Some(stem) => (stem, SamPart::Encoder),
        None => (name, SamPart::Decoder),
    };
    let style = JOINTS.len() * (ENDINGS.len() + 1);
    is_known(stem).then(|| PartName { stem: stem.to_owned(), part, precision, style })
}

/// Ends of the names of CLIP's files, the longer ones first.
const CLIP_ENDINGS: [&str; 11] = [
    "vision_model",
    "text_model",
    "vision_encoder",
    "image_encoder",
    "text_encoder",
    "textual",
    "visual",
    "vision",
    "image",
    "text",
    "model",
];

/// The stem and the precision of a file of CLIP, whose inputs and outputs tell its part: two parts with one stem are a pair. The stem
/// is empty under the names of Hugging Face's exports.
pub(crate) fn clip_name(file: &str) -> (String, NamedPrecision) {
    let (name, precision) = without_precision(file.strip_suffix(".onnx").unwrap_or(file));
    let stem = CLIP_ENDINGS.iter().find_map(|ending| name.strip_suffix(ending)).unwrap_or(name);
    (stem.strip_suffix(JOINTS).unwrap_or(stem).to_owned(), precision)
}

/// The usual name of the other part, for a message.
pub(crate) fn usual_name(stem: &str, part: SamPart) -> String {
    match (stem, part) {
        (VISION, SamPart::Decoder) => "prompt_encoder_mask_decoder.onnx".to_owned(),
        _ => format!("{stem}_{}.onnx", part.name()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_clip_have_one_stem() {
        use NamedPrecision::{Full, Half, Quantised};
        for (file, stem, precision) in [
            ("vision_model.onnx", "", Full),
            ("text_model_quantized.onnx", "", Quantised),
            ("model_fp16.onnx", "", Half),
            ("clip-vit-b32-visual.onnx", "clip-vit-b32", Full),
            ("clip-vit-b32-textual.onnx", "clip-vit-b32", Full),
            ("clip_image_encoder.onnx", "clip", Full),
            ("clip_text_encoder_int8.onnx", "clip", Quantised),
            ("clip.onnx", "clip", Full),
        ] {
            assert_eq!(clip_name(file), (stem.to_owned(), precision), "{file}");
        }
    }

    #[test]
    fn names_of_the_exports_that_there_are_tell_part_stem_and_precision() {
        use NamedPrecision::{Full, Half, Quantised};
        use SamPart::{Decoder, Encoder};
        for (file, stem, part, precision) in [
            ("mobile_sam_encoder.onnx", "mobile_sam", Encoder, Full),
            ("own-decoder.onnx", "own", Decoder, Full),
            // samexporter
            ("sam2.1_hiera_tiny.encoder.onnx", "sam2.1_hiera_tiny", Encoder, Full),
            ("sam_vit_h_4b8939.decoder.quant.onnx", "sam_vit_h_4b8939", Decoder, Quantised),
            // onnxruntime's demo and its tool for SAM 2
            ("sam_vit_b-encoder-int8.onnx", "sam_vit_b", Encoder, Quantised),
            ("sam_vit_b_01ec64.decoder-fp16.onnx", "sam_vit_b_01ec64", Decoder, Half),
            ("sam2_hiera_large_image_decoder.onnx", "sam2_hiera_large", Decoder, Full),
            // Hugging Face
            ("vision_encoder.onnx", "vision", Encoder, Full),
            ("vision_encoder_q4f16.onnx", "vision", Encoder, Quantised),
            ("prompt_encoder_mask_decoder_fp16.onnx", "vision", Decoder, Half),
            ("sam3_vision_encoder.onnx", "sam3", Encoder, Full),
            // sam-cpp-macos
            ("sam2.1_tiny_preprocess.onnx", "sam2.1_tiny", Encoder, Full),
            ("sam2.1_tiny.onnx", "sam2.1_tiny", Decoder, Full),
            ("mobile_sam_int8_decoder.onnx", "mobile_sam", Decoder, Quantised),
        ] {
            let found = part_name(file).unwrap_or_else(|| panic!("{file}"));
            let seen = (found.stem.as_str(), found.part, found.precision);
            assert_eq!(seen, (stem, part, precision), "{file}");
        }
        for other in ["strange.onnx", "encoder.onnx", "_encoder.onnx", "edges_bsds.onnx", "sam.txt"] {
            assert_eq!(part_name(other), None, "{other}");
        }
        assert_eq!(usual_name("vision", Decoder), "prompt_encoder_mask_decoder.onnx");
        assert_eq!(usual_name("own", Encoder), "own_encoder.onnx");
    }
}
