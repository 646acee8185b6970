//! The feature field: one feature vector per splat, beside its colour.

use crate::{FeatureDecoder, FeatureError, Pca};
use segwild_raster::{Channels, ResidentChannels};
use wincode::{SchemaRead, SchemaWrite};

/// Features of a scene's splats, and the maps between features and embeddings.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct FeatureField {
    /// Numbers per splat.
    pub channels: usize,
    /// `[splat][channel]`, flat. A splat that no photo sees has zeros.
    pub values: Vec<f32>,
    /// The compression that targets went through.
    pub pca: Pca,
    /// From features to embeddings: the components' transpose, or the learned one.
    pub decoder: FeatureDecoder,
}

impl FeatureField {
    /// Refuses a field whose parts do not fit each other: one that comes out of a file may be damaged.
    ///
    /// # Errors
    /// Says what does not fit.
    pub fn check(&self) -> Result<(), FeatureError> {
        let FeatureDecoder { channels, embedding_channels, weights, bias } = &self.decoder;
        let (c, e) = (self.channels, *embedding_channels);
        let weighs = |n: usize| c.checked_mul(e) == Some(n);
        let fits = c > 0
            && self.values.len().is_multiple_of(c)
            && (*channels, self.pca.channels, self.pca.embedding_channels) == (c, c, e)
            && weighs(weights.len())
            && weighs(self.pca.basis.len())
            && (bias.len(), self.pca.mean.len()) == (e, e);
        match fits {
            true => Ok(()),
            false => Err(FeatureError::Shape(
                "the feature field is damaged: its parts do not fit each other".into(),
            )),
        }
    }

    /// The features as the rasteriser blends them.
    pub fn channels(&self) -> Channels<'_> {
        Channels { count: self.channels, values: &self.values }
    }

    /// The same, to be blended into many views.
    pub fn resident_channels(&self) -> ResidentChannels<'_> {
        ResidentChannels::new(self.channels, &self.values)
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.values.len() / self.channels.max(1)
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Feature of a splat.
    pub fn feature(&self, splat: usize) -> &[f32] {
        &self.values[splat * self.channels..(splat + 1) * self.channels]
    }

    /// One over each feature's length, 0 for a zero feature: a cosine is a dot product times this.
    pub fn inverse_lengths(&self) -> Vec<f32> {
        let inverse = |f: &[f32]| {
            let square: f32 = f.iter().map(|v| v * v).sum();
            if square > 0.0 && square.is_finite() { 1.0 / square.sqrt() } else { 0.0 }
        };
        self.values.chunks_exact(self.channels.max(1)).map(inverse).collect()
    }
}
