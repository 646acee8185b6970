//! The traits of 2D models. Images are sRGB in [0, 1], three planes; masks have the image's size.

use crate::clip_file_error::{ClipFileError, TokenizerError};
use crate::model_file::ModelFileError;
use crate::sam_file_error::SamFileError;
use crate::service_error::ServiceError;
use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};
use std::path::PathBuf;

/// Why a provider could not answer.
#[derive(Debug, thiserror::Error)]
pub enum VisionError {
    /// The network runtime or a model file cannot be used.
    #[error("{0}")]
    Model(String),
    /// A network file is refused before the runtime reads it.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: Box<ModelFileError>,
    },
    /// A network file is none that answers clicks, or none that is known.
    #[error("{}: {reason}", file.display())]
    Sam {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: Box<SamFileError>,
    },
    /// A network file is none of CLIP's encoders.
    #[error("{}: {reason}", file.display())]
    Clip {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: Box<ClipFileError>,
    },
    /// A file beside CLIP's encoders cannot be used.
    #[error("{}: {reason}", file.display())]
    Tokenizer {
        /// The file.
        file: PathBuf,
        /// What is wrong with it.
        reason: Box<TokenizerError>,
    },
    /// Nothing embeds texts.
    #[error(
        "no model of texts is here{found}. Put the two encoders of a CLIP model as ONNX files and their tokenizer \
         (`vision_model.onnx`, `text_model.onnx`, `tokenizer.json`) into the folder of `--models`: Hugging Face has exports, such as \
         Xenova/clip-vit-base-patch32, and `optimum-cli export onnx` makes them of other CLIP models. Check the licence of the \
         weights. `segwild doctor --models FOLDER` lists what a folder has"
    )]
    NoTexts {
        /// What is there and not used, in brackets after a space; empty where nothing is.
        found: String,
    },
    /// Texts and images are embedded in two spaces.
    #[error(
        "the model embeds a text as {texts} numbers and an image as {images}: put the two encoders of one CLIP model into the \
         folder of `--models`"
    )]
    EmbeddingLengths {
        /// Numbers per text.
        texts: usize,
        /// Numbers per image.
        images: usize,
    },
    /// A vision service does not serve.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// The image does not fit the provider.
    #[error("{0}")]
    Image(String),
}

/// Counters of a network's work so far, for reports of its speed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Work {
    /// Images encoded; one whose embedding is still in memory is not encoded again.
    pub encoded: u64,
    /// Seconds spent encoding.
    pub encode_s: f64,
    /// Prompts answered.
    pub prompts: u64,
    /// Seconds spent decoding, the masks' scaling to the photo included.
    pub decode_s: f64,
}

impl Work {
    /// Seconds per encoded image; `None` before the first.
    pub fn seconds_per_image(&self) -> Option<f64> {
        (self.encoded > 0).then(|| self.encode_s / self.encoded as f64)
    }

    /// Prompts per second; `None` before the first.
    pub fn prompts_per_second(&self) -> Option<f64> {
        (self.prompts > 0 && self.decode_s > 0.0).then(|| self.prompts as f64 / self.decode_s)
    }
}

/// Dense descriptors for the feature field.
pub trait Embedder: Send + Sync {
    /// Names the model and its parameters; part of every cache key made with it (docs/method.md, section 8).
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// Descriptors of an image.
    fn embed(&self, image: &Image) -> Result<Embedding, VisionError>;
}

/// Embeds images and texts in one space, where the cosine of two embeddings grows with how well the text describes the image
/// (CLIP, Radford et al. 2021).
pub trait TextEmbedder: Send + Sync {
    /// Names the model and its parameters.
    ///
    /// # Errors
    /// When its files cannot be loaded: they are at the first call.
    fn key(&self) -> Result<String, VisionError>;
    /// Embeddings of images, unit vectors of one length. Squares are expected: other images are stretched to one.
    fn embed_images(&self, images: &[Image]) -> Result<Vec<Vec<f32>>, VisionError>;
    /// Embeddings of texts, unit vectors of the same length.
    fn embed_texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>, VisionError>;
}

/// Masks at given points, for SASM (docs/method.md, section 5).
pub trait MaskProposer: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// Masks that the points lie in, unfiltered; several nested ones per point are welcome. `points` are
    /// pixel positions.
    fn propose(&self, image: &Image, points: &[[f32; 2]]) -> Result<Vec<ScoredMask>, VisionError>;
    /// Counters of its work so far; `None` where it does not count.
    fn work(&self) -> Option<Work> {
        None
    }
}

/// The mask of a person's prompts in one photo.
#[derive(Clone, Debug, PartialEq)]
pub struct Prompted {
    /// The mask, with scores.
    pub answer: ScoredMask,
    /// Probability that a pixel is meant although the mask leaves it out, in [0, 1], one plane of the photo's size: the prompts
    /// point at the mask, but where it ends is a guess. 0 in the mask.
    pub open: Image,
}

impl Prompted {
    /// A mask that leaves nothing open.
    pub fn sure(answer: ScoredMask) -> Prompted {
        let (width, height) = (answer.mask.width() as usize, answer.mask.height() as usize);
        Prompted { answer, open: Image::zeros(width, height, 1) }
    }
}

/// Answers a person's prompts with a mask.
pub trait PromptSegmenter: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// The mask that the prompts mean, and what else they could mean.
    fn prompted(&self, image: &Image, prompts: &Prompts) -> Result<Prompted, VisionError>;
    /// The mask that the prompts mean, with scores.
    fn segment(&self, image: &Image, prompts: &Prompts) -> Result<ScoredMask, VisionError> {
        Ok(self.prompted(image, prompts)?.answer)
    }
    /// Snaps a rough mask (a rendered selection, say) to the image's own boundaries. `certainty` has one
    /// number per pixel in [0, 1]: how likely the pixel belongs to the object.
    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError>;
    /// The mask of [`PromptSegmenter::refine`] and its predicted IoU, for those who refine many photos and need not know how
    /// stable their masks are.
    fn refined_mask(&self, image: &Image, certainty: &Image) -> Result<(Mask, f32), VisionError> {
        let ScoredMask { mask, predicted_iou, .. } = self.refine(image, certainty)?;
        Ok((mask, predicted_iou))
    }
    /// Whether it finds whole objects by itself, as SAM does. Its prompted masks then come before the groups of the scene tree, and
    /// the tree is grown from the outlines of automatic masks (docs/method.md, section 13). Otherwise it has boundary strengths.
    fn finds_objects(&self) -> bool {
        true
    }
    /// Boundary strengths of a photo in [0, 1], one plane of its size, for the scene tree (docs/method.md, section 13). `None`
    /// where this model has none.
    fn boundary_strengths(&self, _image: &Image) -> Result<Option<Image>, VisionError> {
        Ok(None)
    }
    /// Computes in advance what every answer about this photo needs, if memory can hold it until then. No answer depends on it;
    /// an error here is dropped and returns with the answer itself.
    fn prepare(&self, _image: &Image) {}
    /// Whether what [`PromptSegmenter::prepare`] computes of a photo is in memory, so that an answer to a click costs little. A model
    /// that does not know has nothing.
    fn is_prepared(&self, _image: &Image) -> bool {
        false
    }
}

/// Refuses a certainty whose size is not its image's, for [`PromptSegmenter::refine`].
pub(crate) fn check_certainty(image: &Image, certainty: &Image) -> Result<(), VisionError> {
    if (certainty.width, certainty.height) != (image.width, image.height)
        || certainty.channels == 0
        || certainty.data.len() != certainty.pixels() * certainty.channels
    {
        return Err(VisionError::Image(format!(
            "the certainty is {} x {} x {} but the photo is {} x {}",
            certainty.width, certainty.height, certainty.channels, image.width, image.height
        )));
    }
    Ok(())
}

/// Finds transients: persons and vehicles.
pub trait TransientDetector: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Their pixels.
    fn transients(&self, image: &Image) -> Result<Mask, VisionError>;
}

/// Finds the sky.
pub trait SkyDetector: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// The sky's pixels.
    fn sky(&self, image: &Image) -> Result<Mask, VisionError>;
    /// Whether the points that lie in a photo change the answer, so that they are part of every key.
    fn by_points(&self) -> bool {
        false
    }
    /// The sky's pixels in a photo in which these points of the reconstruction lie (pixel positions): they are no sky.
    fn sky_above(&self, image: &Image, _seen: &[[f32; 2]]) -> Result<Mask, VisionError> {
        self.sky(image)
    }
}
