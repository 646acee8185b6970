//! The interfaces of CLIP's files, by the names, types and shapes of their inputs and outputs: what `segwild doctor` lists and what
//! a query by text loads are decided here.
//!
//! | export | takes | answers |
//! |---|---|---|
//! | image encoder (`vision_model.onnx`) | `pixel_values` [N, 3, s, s] | `image_embeds` [N, D] |
//! | text encoder (`text_model.onnx`) | `input_ids` [N, L], perhaps `attention_mask` | `text_embeds` [N, D] |
//! | both (`model.onnx`) | all of these | both |

use crate::clip_file_error::ClipFileError;
use crate::model_file::TensorSpec;
use ort::value::TensorElementType;
use std::ops::RangeInclusive;

const PIXELS: &str = "pixel_values";
const IDS: &str = "input_ids";
const ATTENTION: &str = "attention_mask";
const IMAGE_EMBEDDINGS: &[&str] = &["image_embeds", "image_embeddings"];
const TEXT_EMBEDDINGS: &[&str] = &["text_embeds", "text_embeddings"];

/// Sides of an image that an encoder may fix, in pixels.
pub(crate) const SIDES: RangeInclusive<usize> = 16..=1024;
/// Numbers of an embedding at most; CLIP has 512 to 1024.
pub(crate) const MOST_DIMS: usize = 8192;
/// Tokens of a text that an encoder may fix: its start, its end and at least one more.
const LENGTHS: RangeInclusive<usize> = 3..=1024;

/// What a file takes and answers.
#[derive(Clone, Debug)]
pub(crate) struct ClipInterface {
    pub images: Option<ImageInterface>,
    pub texts: Option<TextInterface>,
}

/// The part of a file that embeds images.
#[derive(Clone, Debug)]
pub(crate) struct ImageInterface {
    pub pixels: TensorSpec,
    /// Side of the images, where the file fixes it.
    pub side: Option<usize>,
    pub output: TensorSpec,
}

/// The part of a file that embeds texts.
#[derive(Clone, Debug)]
pub(crate) struct TextInterface {
    pub ids: TensorSpec,
    /// Which tokens count.
    pub attention: Option<TensorSpec>,
    /// Tokens of a text, where the file fixes them.
    pub length: Option<usize>,
    pub output: TensorSpec,
}

/// An output of two dimensions under one of these names, if the input is there.
fn answer<'a>(
    inputs: &[TensorSpec],
    outputs: &'a [TensorSpec],
    input: &str,
    names: &[&str],
) -> Option<&'a TensorSpec> {
    inputs.iter().find(|spec| spec.name == input)?;
    outputs.iter().find(|spec| names.contains(&spec.name.as_str()) && spec.shape.len() == 2)
}

fn input(inputs: &[TensorSpec], name: &str) -> Option<TensorSpec> {
    inputs.iter().find(|spec| spec.name == name).cloned()
}

fn wrong(spec: &TensorSpec, expected: &'static str) -> ClipFileError {
    ClipFileError::Input { name: spec.name.clone(), found: spec.words(), expected }
}

/// Whether a number of images or texts at a time can be served: one, or any.
fn any_count(count: Option<usize>) -> bool {
    matches!(count, None | Some(1))
}

impl ClipInterface {
    /// Recognises a file; `None` where it is none of CLIP. An encoder of text for a decoder, such as SAM 3's, answers a vector per
    /// token and is none.
    pub fn of(inputs: &[TensorSpec], outputs: &[TensorSpec]) -> Option<Result<ClipInterface, ClipFileError>> {
        let images = answer(inputs, outputs, PIXELS, IMAGE_EMBEDDINGS);
        let texts = answer(inputs, outputs, IDS, TEXT_EMBEDDINGS);
        match (images, texts) {
            (None, None) => None,
            _ => Some(ClipInterface::checked(inputs, images, texts)),
        }
    }

    fn checked(
        inputs: &[TensorSpec],
        images: Option<&TensorSpec>,
        texts: Option<&TensorSpec>,
    ) -> Result<ClipInterface, ClipFileError> {
        let known = |name: &str| match name {
            PIXELS => images.is_some(),
            IDS | ATTENTION => texts.is_some(),
            _ => false,
        };
        let others: Vec<String> =
            inputs.iter().filter(|s| !known(&s.name)).map(|s| format!("`{}`", s.name)).collect();
        if !others.is_empty() {
            return Err(ClipFileError::Inputs { names: others.join(", ") });
        }
        let images = match (images, input(inputs, PIXELS)) {
            (Some(output), Some(pixels)) => Some(ImageInterface::new(pixels, output.clone())?),
            _ => None,
        };
        let texts = match (texts, input(inputs, IDS)) {
            (Some(output), Some(ids)) => {
                Some(TextInterface::new(ids, input(inputs, ATTENTION), output.clone())?)
            }
            _ => None,
        };
        Ok(ClipInterface { images, texts })
    }

    /// What it is for.
    pub fn role(&self) -> &'static str {
        match (&self.images, &self.texts) {
            (Some(_), Some(_)) => "image and text encoder",
            (Some(_), None) => "image encoder",
            _ => "text encoder",
        }
    }
}

impl ImageInterface {
    fn new(pixels: TensorSpec, output: TensorSpec) -> Result<ImageInterface, ClipFileError> {
        const EXPECTED: &str = "float32 or float16 [N, 3, s, s] with 16 to 1024 pixels a side";
        let float = matches!(pixels.kind, Some(TensorElementType::Float32 | TensorElementType::Float16));
        let side = match pixels.shape[..] {
            [count, None | Some(3), rows, columns] if float && any_count(count) => {
                let same = rows.zip(columns).is_none_or(|(rows, columns)| rows == columns);
                same.then_some(rows.or(columns))
            }
            _ => None,
        };
        match side {
            Some(side) if side.is_none_or(|side| SIDES.contains(&side)) => {
                Ok(ImageInterface { pixels, side, output })
            }
            _ => Err(wrong(&pixels, EXPECTED)),
        }
    }
}

impl TextInterface {
    fn new(
        ids: TensorSpec,
        attention: Option<TensorSpec>,
        output: TensorSpec,
    ) -> Result<TextInterface, ClipFileError> {
        const EXPECTED: &str = "int32 or int64 [N, L] with 3 to 1024 tokens";
        let length_of = |spec: &TensorSpec| match (spec.kind, &spec.shape[..]) {
            (Some(TensorElementType::Int64 | TensorElementType::Int32), &[count, length])
                if any_count(count) && length.is_none_or(|length| LENGTHS.contains(&length)) =>
            {
                Ok(length)
            }
            _ => Err(wrong(spec, EXPECTED)),
        };
        let length = length_of(&ids)?;
        if let Some(attention) = &attention {
            let other = length_of(attention)?;
            if length.zip(other).is_some_and(|(length, other)| length != other) {
                return Err(wrong(attention, "the shape of `input_ids`"));
            }
        }
        Ok(TextInterface { ids, attention, length, output })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(name: &str, kind: TensorElementType, shape: &[Option<usize>]) -> TensorSpec {
        TensorSpec { name: name.into(), kind: Some(kind), shape: shape.to_vec() }
    }

    #[test]
    fn a_text_encoder_that_answers_a_vector_per_token_is_none_of_clip() {
        use TensorElementType::{Float32, Int64};
        let ids = [spec("input_ids", Int64, &[None, None])];
        let embeds = |shape: &[Option<usize>]| [spec("text_embeds", Float32, shape)];
        let found = ClipInterface::of(&ids, &embeds(&[None, Some(512)])).unwrap().unwrap();
        assert_eq!((found.role(), found.texts.unwrap().length), ("text encoder", None));
        assert!(ClipInterface::of(&ids, &embeds(&[None, Some(32), Some(256)])).is_none(), "SAM 3's");
        let other = [ids[0].clone(), spec("language_mask", Int64, &[None, None])];
        let refused = ClipInterface::of(&other, &embeds(&[None, Some(512)])).unwrap().unwrap_err();
        assert!(refused.to_string().contains("`language_mask`"), "{refused}");
        let floats = [spec("input_ids", Float32, &[None, None])];
        assert!(ClipInterface::of(&floats, &embeds(&[None, Some(512)])).unwrap().is_err());
    }

    #[test]
    fn an_image_encoder_takes_squares() {
        use TensorElementType::Float32;
        let side_of = |rows, columns| {
            let pixels = [spec("pixel_values", Float32, &[None, Some(3), rows, columns])];
            let embeds = [spec("image_embeds", Float32, &[None, Some(512)])];
            ClipInterface::of(&pixels, &embeds).unwrap().map(|found| found.images.unwrap().side).ok()
        };
        assert_eq!(side_of(None, None), Some(None));
        assert_eq!(
            (side_of(Some(224), None), side_of(Some(224), Some(224))),
            (Some(Some(224)), Some(Some(224)))
        );
        assert_eq!((side_of(Some(224), Some(336)), side_of(Some(4096), Some(4096))), (None, None));
    }
}
