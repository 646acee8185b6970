//! The feature field: one feature vector per splat, beside its colour.

use crate::{FeatureDecoder, FeatureError, Pca};
use segwild_raster::ResidentChannels;
use segwild_scene::HalfRows;
use wincode::{SchemaRead, SchemaWrite};

/// Features of a scene's splats, and the maps between features and embeddings. In memory as in its record: a field that was just
/// made and the same one read back have equal numbers.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct FeatureField {
    /// The features, a row per splat. A splat that no photo sees has zeros.
    pub rows: HalfRows,
    /// The compression that targets went through.
    pub pca: Pca,
    /// From features to embeddings: the components' transpose, or the learned one.
    pub decoder: FeatureDecoder,
}

/// A feature field with numbers of 32 bits, as earlier versions of the program wrote it.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct WideFeatureField {
    /// Numbers per splat.
    pub channels: usize,
    /// `[splat][channel]`, flat.
    pub values: Vec<f32>,
    /// As [`FeatureField::pca`].
    pub pca: Pca,
    /// As [`FeatureField::decoder`].
    pub decoder: FeatureDecoder,
}

impl TryFrom<WideFeatureField> for FeatureField {
    type Error = FeatureError;

    fn try_from(wide: WideFeatureField) -> Result<FeatureField, FeatureError> {
        FeatureField::rounded(wide.channels, &wide.values, wide.pca, wide.decoder)
    }
}

impl FeatureField {
    /// Rounds the features `values[splat][channel]`, flat, to 16 bits. A splat with a number that is none, or that is much larger than
    /// those of the others ([`HalfRows::rounded`]), gets zeros.
    ///
    /// # Errors
    /// When the numbers do not fill rows of so many channels.
    pub fn rounded(
        channels: usize,
        values: &[f32],
        pca: Pca,
        decoder: FeatureDecoder,
    ) -> Result<FeatureField, FeatureError> {
        let Some(mut rows) = HalfRows::rounded(channels, values) else {
            return Err(FeatureError::Shape(format!(
                "{} feature values do not fit {channels} channels",
                values.len()
            )));
        };
        rows.clear_damaged();
        Ok(FeatureField { rows, pca, decoder })
    }

    /// Refuses a field whose parts do not fit each other: one that comes out of a file may be damaged.
    ///
    /// # Errors
    /// Says what does not fit.
    pub fn check(&self) -> Result<(), FeatureError> {
        let FeatureDecoder { channels, embedding_channels, weights, bias } = &self.decoder;
        let (c, e) = (self.channels(), *embedding_channels);
        let weighs = |n: usize| c.checked_mul(e) == Some(n);
        let fits = (*channels, self.pca.channels, self.pca.embedding_channels) == (c, c, e)
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

    /// Numbers per splat.
    pub fn channels(&self) -> usize {
        self.rows.channels()
    }

    /// The features in 32 bits, to be blended into many views.
    pub fn resident_channels(&self) -> ResidentChannels<'static> {
        ResidentChannels::new(self.channels(), self.values())
    }

    /// Number of splats.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no splat.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// All features in 32 bits, `[splat][channel]`, flat: twice the memory of the field.
    pub fn values(&self) -> Vec<f32> {
        self.rows.values()
    }

    /// Feature of a splat.
    pub fn feature(&self, splat: usize) -> Vec<f32> {
        self.rows.row(splat)
    }

    /// One over each feature's length, 0 for a zero feature: a cosine is a dot product times this.
    pub fn inverse_lengths(&self) -> Vec<f32> {
        let inverse = |splat: usize| {
            let square: f32 = self.feature(splat).iter().map(|v| v * v).sum();
            if square > 0.0 && square.is_finite() { 1.0 / square.sqrt() } else { 0.0 }
        };
        (0..self.len()).map(inverse).collect()
    }
}
