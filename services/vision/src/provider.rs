//! What a 2D model must do. Images are sRGB in [0, 1], three planes; masks have the image's size.

use segwild_scene::{Embedding, Image, Mask, Prompts, ScoredMask};

/// Why a provider could not answer.
#[derive(Debug, thiserror::Error)]
pub enum VisionError {
    /// The network runtime or a model file cannot be used.
    #[error("{0}")]
    Model(String),
    /// The image does not fit the provider.
    #[error("{0}")]
    Image(String),
}

/// Dense descriptors for the feature field.
pub trait Embedder: Send + Sync {
    /// Names the model and its parameters; part of every cache key made with it (method, section 8).
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// Describes an image.
    fn embed(&self, image: &Image) -> Result<Embedding, VisionError>;
}

/// Masks at given points, as SASM asks for them (method, section 5).
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
}

/// The mask a person's prompts mean.
pub trait PromptSegmenter: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// The mask that the prompts mean, with scores.
    fn segment(&self, image: &Image, prompts: &Prompts) -> Result<ScoredMask, VisionError>;
    /// Snaps a rough mask (a rendered selection, say) to the image's own boundaries. `certainty` has one
    /// number per pixel in [0, 1]: how likely the pixel belongs to the object.
    fn refine(&self, image: &Image, certainty: &Image) -> Result<ScoredMask, VisionError>;
}

/// Where the sky is.
pub trait SkyDetector: Send + Sync {
    /// Names the model and its parameters.
    fn key(&self) -> String;
    /// Whether it computes on the machine's accelerator, which then is held while it answers.
    fn accelerator(&self) -> bool {
        false
    }
    /// The sky's pixels.
    fn sky(&self, image: &Image) -> Result<Mask, VisionError>;
}
