//! Runs CLIP's encoders.

use super::scaling::ClipScaling;
use super::tokenizer::ClipTokenizer;
use crate::clip_file_error::{ClipFileError, TokenizerError};
use crate::clip_files::{ClipFiles, TokenizerFiles};
use crate::clip_interface::{ClipInterface, ImageInterface, MOST_DIMS, TextInterface};
use crate::model_file::TensorSpec;
use crate::onnx::{NetworkDevice, NetworkModel, NetworkOutput, Options, Runtime, floats};
use crate::{VisionError, VisionSettings};
use ort::session::SessionInputValue;
use ort::value::{Tensor, TensorElementType};
use segwild_scene::Image;
use std::path::Path;
use std::time::Duration;

/// Changes whenever the same files would give other bytes for the same image.
const VERSION: &str = "clip-1";
/// Images per run of an encoder, where its file allows several.
const IMAGES_AT_ONCE: usize = 8;
/// Tokens of a text where the file leaves them open: CLIP's positions.
const CONTEXT: usize = 77;
/// Most bytes of a tokenizer's file, and of one that says how images are scaled. CLIP's tokenizers have 1 to 4 MiB.
const MOST_BYTES: u64 = 64 << 20;

/// A loaded model.
pub(super) struct ClipEncoders {
    images: NetworkModel,
    image_interface: ImageInterface,
    /// `None` where the file of the images has both.
    texts: Option<NetworkModel>,
    text_interface: TextInterface,
    /// What the image encoder's file takes for texts, if it has both.
    beside_images: Option<TextInterface>,
    /// What the text encoder's file takes for images, if it has both.
    beside_texts: Option<ImageInterface>,
    tokenizer: ClipTokenizer,
    scaling: ClipScaling,
    key: String,
}

/// Integers as an input of a network.
fn integers(
    kind: Option<TensorElementType>,
    shape: [usize; 2],
    data: &[i64],
) -> ort::Result<SessionInputValue<'static>> {
    Ok(match kind {
        Some(TensorElementType::Int32) => {
            let data: Vec<i32> = data.iter().map(|&v| i32::try_from(v).unwrap_or(i32::MAX)).collect();
            Tensor::from_array((shape, data))?.into()
        }
        _ => Tensor::from_array((shape, data.to_vec()))?.into(),
    })
}

/// The first 16 digits of the hash of files' bytes.
fn digest(files: &[&[u8]]) -> String {
    let mut hasher = blake3::Hasher::new();
    for bytes in files {
        hasher.update(&(bytes.len() as u64).to_le_bytes());
        hasher.update(bytes);
    }
    hasher.finalize().to_hex()[..16].to_owned()
}

pub(super) fn read(file: &Path) -> Result<Vec<u8>, VisionError> {
    segwild_files::read_within(file, MOST_BYTES).map_err(|e| refused(file, TokenizerError::Unreadable(e)))
}

fn refused(file: &Path, reason: TokenizerError) -> VisionError {
    VisionError::Tokenizer { file: file.to_owned(), reason: Box::new(reason) }
}

/// A tokenizer, and the hash of its files.
fn tokenizer(files: &TokenizerFiles) -> Result<(ClipTokenizer, String), VisionError> {
    match files {
        TokenizerFiles::Whole(file) => {
            let bytes = read(file)?;
            let found = ClipTokenizer::of_json(&bytes).map_err(|reason| refused(file, reason))?;
            Ok((found, digest(&[&bytes])))
        }
        TokenizerFiles::Parts { vocabulary, merges } => {
            let bytes = [read(vocabulary)?, read(merges)?];
            let found = ClipTokenizer::of_parts(&bytes[0], &bytes[1]);
            let of_merges = |reason: &TokenizerError| {
                matches!(
                    reason,
                    TokenizerError::Merge { .. } | TokenizerError::NoText | TokenizerError::NoWordEnds
                )
            };
            let found = found
                .map_err(|reason| refused(if of_merges(&reason) { merges } else { vocabulary }, reason))?;
            Ok((found, digest(&[&bytes[0], &bytes[1]])))
        }
    }
}

fn interface(model: &NetworkModel) -> Result<ClipInterface, VisionError> {
    let refused =
        |reason: ClipFileError| VisionError::Clip { file: model.name().into(), reason: Box::new(reason) };
    match ClipInterface::of(&model.inputs, &model.outputs) {
        Some(found) => found.map_err(refused),
        None => Err(model.wrong("is none of CLIP's encoders")),
    }
}

impl ClipEncoders {
    /// Loads a model. The error names the file and says what does not fit.
    pub fn load(
        runtime: &Runtime,
        files: &ClipFiles,
        settings: &VisionSettings,
    ) -> Result<ClipEncoders, VisionError> {
        let options = Options {
            threads: settings.network_threads,
            device: NetworkDevice::Cpu,
            limit: Duration::from_secs(settings.network_limit.max(1).into()),
            memory_mib: settings.network_memory,
        };
        // What costs least is checked first.
        let (tokenizer, of_tokenizer) = tokenizer(&files.tokenizer)?;
        let images = NetworkModel::load(runtime, &files.images, options)?;
        let texts = match files.texts == files.images {
            true => None,
            false => Some(NetworkModel::load(runtime, &files.texts, options)?),
        };
        let of_images = interface(&images)?;
        let of_texts = texts.as_ref().map_or_else(|| Ok(of_images.clone()), interface)?;
        let Some(image_interface) = of_images.images else {
            return Err(images.wrong("embeds no images"));
        };
        let side = image_interface.side;
        let scaling = match &files.scaling {
            Some(file) => ClipScaling::of_json(&read(file)?, side).map_err(|reason| refused(file, reason))?,
            None => ClipScaling::with_side(side),
        };
        let text_model = texts.as_ref().unwrap_or(&images);
        let Some(text_interface) = of_texts.texts else { return Err(text_model.wrong("embeds no texts")) };
        let key = format!(
            "{VERSION}-{}-{}-{of_tokenizer}-{}-{}",
            images.key(),
            text_model.key(),
            scaling.side,
            digest(&[format!("{:?}", scaling.channels).as_bytes()])
        );
        Ok(ClipEncoders {
            images,
            image_interface,
            texts,
            text_interface,
            beside_images: of_images.texts,
            beside_texts: of_texts.images,
            tokenizer,
            scaling,
            key,
        })
    }

    /// Names the files and how images are scaled.
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Unit vectors of images, one each.
    pub fn images(&self, images: &[Image]) -> Result<Vec<Vec<f32>>, VisionError> {
        let pixels = &self.image_interface.pixels;
        let at_once = if pixels.shape.first() == Some(&Some(1)) { 1 } else { IMAGES_AT_ONCE };
        let mut found = Vec::with_capacity(images.len());
        for some in images.chunks(at_once) {
            let mut planes = Vec::new();
            for image in some {
                planes.extend(self.scaling.planes(image)?);
            }
            let mut inputs = vec![self.pixels(&self.images, pixels, some.len(), planes)?];
            if let Some(texts) = &self.beside_images {
                inputs.extend(self.text(&self.images, texts, "")?);
            }
            let on = format!("{} images", some.len());
            found.extend(rows(&self.images, inputs, &self.image_interface.output, some.len(), &on)?);
        }
        Ok(found)
    }

    /// Unit vectors of texts, one each.
    pub fn texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>, VisionError> {
        let model = self.texts.as_ref().unwrap_or(&self.images);
        let mut found = Vec::with_capacity(texts.len());
        for text in texts {
            let mut inputs = self.text(model, &self.text_interface, text)?;
            if let Some(images) = &self.beside_texts {
                let nothing = vec![0.0; 3 * self.scaling.side * self.scaling.side];
                inputs.push(self.pixels(model, &images.pixels, 1, nothing)?);
            }
            found.extend(rows(model, inputs, &self.text_interface.output, 1, "a text")?);
        }
        Ok(found)
    }

    /// Planes of some images as an input.
    fn pixels<'a>(
        &self,
        model: &NetworkModel,
        spec: &'a TensorSpec,
        count: usize,
        planes: Vec<f32>,
    ) -> Result<(&'a str, SessionInputValue<'static>), VisionError> {
        let side = self.scaling.side;
        let value = floats(spec.kind, &[count, 3, side, side], planes);
        Ok((spec.name.as_str(), value.map_err(|e| model.wrong(format!("takes no images: {e}")))?))
    }

    /// A text as inputs: its tokens, and which of them count.
    fn text<'a>(
        &self,
        model: &NetworkModel,
        interface: &'a TextInterface,
        text: &str,
    ) -> Result<Vec<(&'a str, SessionInputValue<'static>)>, VisionError> {
        let failed = |e: ort::Error| model.wrong(format!("takes no text: {e}"));
        let tokens = self
            .tokenizer
            .tokens(text, interface.length.unwrap_or(CONTEXT))
            .map_err(|reason| model.wrong(format!("its tokenizer {reason}")))?;
        let length = interface.length.unwrap_or(tokens.len());
        let fill = |tokens: Vec<i64>, filler: i64| -> Vec<i64> {
            let left = length.saturating_sub(tokens.len());
            tokens.into_iter().chain(std::iter::repeat_n(filler, left)).collect()
        };
        let count = vec![1; tokens.len()];
        let ids = fill(tokens.into_iter().map(i64::from).collect(), i64::from(self.tokenizer.filler()));
        let shape = [1, length];
        let ids = integers(interface.ids.kind, shape, &ids).map_err(failed)?;
        let mut inputs = vec![(interface.ids.name.as_str(), ids)];
        if let Some(attention) = &interface.attention {
            let counted = integers(attention.kind, shape, &fill(count, 0)).map_err(failed)?;
            inputs.push((attention.name.as_str(), counted));
        }
        Ok(inputs)
    }
}

/// Runs a network that answers `[count, D]`, and scales each row to length 1.
fn rows(
    model: &NetworkModel,
    inputs: Vec<(&str, SessionInputValue)>,
    output: &TensorSpec,
    count: usize,
    on: &str,
) -> Result<Vec<Vec<f32>>, VisionError> {
    let answers = model.run(inputs, &[output.name.as_str()], on)?;
    let Some(NetworkOutput { shape, data }) = answers.into_iter().next() else {
        return Err(model.wrong("answered nothing"));
    };
    let dims = match shape[..] {
        [rows, dims] if rows == count && (1..=MOST_DIMS).contains(&dims) && data.len() == rows * dims => dims,
        _ => return Err(model.wrong(format!("answered {shape:?} on {on}; [{count}, D] was expected"))),
    };
    let unit = |row: &[f32]| -> Result<Vec<f32>, VisionError> {
        let length = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
        match length.is_finite() && length > 0.0 {
            true => Ok(row.iter().map(|v| (f64::from(*v) / length) as f32).collect()),
            false => Err(model.wrong(format!("answered an embedding without a direction on {on}"))),
        }
    };
    data.chunks_exact(dims).map(unit).collect()
}
