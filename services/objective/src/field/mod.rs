//! The feature field, which distinguishes splats by features learnt from views: lifting over photos, its losses
//! (method, section 4; paper Eq. 9-14), whose gradients do not reach the geometry, and the similarity of splats to a
//! click (section 6, Eq. 27).

mod area;
mod compact;
mod embedding;
mod lifting;
mod membership;
mod rows;
mod similarity;

pub use area::{AreaAverage, Window};
pub use compact::{Compactness, SHORTEST, compactness};
pub use embedding::{LearnedDecoder, embedding_loss};
pub use lifting::{DeviceLifting, Lifting};
pub use membership::Membership;
pub use rows::{BETA1, BETA2, EPSILON, RowAdam};
pub use similarity::{Queries, dot, score};

use segwild_raster::{Channels, Projected, RasterError};
use segwild_scene::Image;
use std::any::Any;

/// The target of the features in a view: the embedding of its photo.
#[derive(Clone, Copy)]
pub struct FeatureTarget<'a> {
    /// The target on the embedding's grid: compressed channels, or the embedding itself where a decoder learns.
    pub target: &'a Image,
    /// Factor on the target.
    pub scale: f32,
    /// Validity of each of its cells (VM), in [0, 1].
    pub validity: &'a [f32],
    /// From the view's pixels to its cells.
    pub average: &'a AreaAverage,
    /// Handle that [`upload_target`](crate::FieldBackend::upload_target) returned for it.
    pub on_device: Option<&'a (dyn Any + Send + Sync)>,
}

/// Sampled pixels of a view, for the compactness loss.
#[derive(Clone, Copy)]
pub struct SampledPixels<'a> {
    /// Their numbers, row by row; none twice.
    pub pixels: &'a [u32],
    /// Which masks hold them.
    pub membership: &'a Membership,
}

/// Weights of the losses, and the learning rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldWeights {
    /// Weight of the embedding loss.
    pub embedding: f32,
    /// Weight of the compactness loss.
    pub compact: f32,
    /// Learning rate of the features.
    pub rate: f32,
}

/// The losses of a step, before weighting.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FieldLosses {
    /// L_FE.
    pub embedding: f32,
    /// L_Com; 0 where no pixels were sampled.
    pub compact: f32,
}

/// Features that are refined, one row per splat, and perhaps a decoder beside them.
/// [`FieldRefinement::step`] steps them, on the host or on the device.
pub struct FieldRefinement {
    values: Vec<f32>,
    adam: RowAdam,
    channels: usize,
    decoder: Option<LearnedDecoder>,
    weights: FieldWeights,
    losses: FieldLosses,
    pub(crate) on_device: Option<Box<dyn DeviceRefinement>>,
}

/// Features on a device.
pub trait DeviceRefinement: Send + Sync {
    /// One step by the feature target of a view and by the compactness loss of sampled pixels.
    ///
    /// # Panics
    /// If the view is of another device, or sizes differ.
    fn step(
        &self,
        view: &dyn Projected,
        feature_target: &FeatureTarget,
        sampled: &SampledPixels,
    ) -> Result<(), RasterError>;

    /// The features, `[splat][channel]`, and the decoder's numbers.
    fn download(&self) -> Result<RefinedFeatures, RasterError>;

    /// The losses of the last step.
    fn losses(&self) -> Result<FieldLosses, RasterError>;
}

/// Refined features.
#[derive(Clone, Debug, PartialEq)]
pub struct RefinedFeatures {
    /// `[splat][channel]`.
    pub values: Vec<f32>,
    /// [`LearnedDecoder::numbers`], if there is one.
    pub decoder: Option<Vec<f32>>,
}

impl FieldRefinement {
    /// Features of so many channels, `[splat][channel]`, before the first step.
    pub fn new(
        channels: usize,
        values: Vec<f32>,
        decoder: Option<LearnedDecoder>,
        weights: FieldWeights,
    ) -> FieldRefinement {
        let adam = RowAdam::new(values.len() / channels.max(1), channels, weights.rate);
        FieldRefinement {
            values,
            adam,
            channels,
            decoder,
            weights,
            losses: FieldLosses::default(),
            on_device: None,
        }
    }

    /// The features, while they are on the host.
    ///
    /// # Panics
    /// If they are on a device.
    pub fn channels(&self) -> Channels<'_> {
        assert!(self.on_device.is_none(), "the features are on a device");
        Channels { count: self.channels, values: &self.values }
    }

    /// The decoder that learns beside them, as it was before the upload.
    pub fn decoder(&self) -> Option<&LearnedDecoder> {
        self.decoder.as_ref()
    }

    /// Weights of the losses, and the learning rate.
    pub fn weights(&self) -> FieldWeights {
        self.weights
    }

    /// Whether they are on a device.
    pub fn is_on_device(&self) -> bool {
        self.on_device.is_some()
    }

    /// One step of the features by the feature target of a view and by the compactness loss of sampled pixels.
    ///
    /// # Panics
    /// If the features are on the device of another engine than the view, or sizes differ.
    pub fn step(
        &mut self,
        view: &dyn Projected,
        feature_target: &FeatureTarget,
        sampled: &SampledPixels,
    ) -> Result<(), RasterError> {
        if let Some(on_device) = &self.on_device {
            return on_device.step(view, feature_target, sampled);
        }
        let frame = view.blend(&self.channels())?;
        let grad = self.compute_losses(&frame.image, feature_target, sampled);
        let grads = view.gather(&grad)?;
        self.adam.step(&mut self.values, &grads);
        Ok(())
    }

    /// Computes the losses of a rendered view of the features against its target. Steps the decoder, and returns the
    /// gradient with respect to the image.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn compute_losses(
        &mut self,
        image: &Image,
        feature_target: &FeatureTarget,
        sampled: &SampledPixels,
    ) -> Image {
        let mut grad = Image::zeros(image.width, image.height, image.channels);
        let rendered = feature_target.average.forward(image);
        let mut cell_grad = Image::zeros(rendered.width, rendered.height, image.channels);
        let target = (feature_target.target, feature_target.scale);
        let embedding = match &mut self.decoder {
            Some(decoder) => decoder.step(&rendered, target, feature_target.validity, &mut cell_grad),
            None => embedding_loss(&rendered, target, feature_target.validity, &mut cell_grad),
        };
        feature_target.average.transposed(&cell_grad, self.weights.embedding, &mut grad);
        let compact = if sampled.pixels.is_empty() {
            0.0
        } else {
            self.add_compactness_gradient(image, sampled, &mut grad)
        };
        self.losses = FieldLosses { embedding, compact };
        grad
    }

    /// Adds the weighted gradient of the sampled pixels' compactness and returns the loss.
    fn add_compactness_gradient(
        &self,
        image: &Image,
        SampledPixels { pixels, membership }: &SampledPixels,
        grad: &mut Image,
    ) -> f32 {
        let (n, c) = (image.pixels(), image.channels);
        let mut features = Vec::with_capacity(pixels.len() * c);
        for &p in *pixels {
            features.extend((0..c).map(|k| image.data[k * n + p as usize]));
        }
        let groups: Vec<u32> = pixels.iter().map(|&p| membership.groups[p as usize]).collect();
        let mut feature_grads = vec![0.0; features.len()];
        let result = compactness(&features, c, &groups, membership, &mut feature_grads);
        for (grads, &p) in feature_grads.chunks_exact(c).zip(*pixels) {
            for (k, g) in grads.iter().enumerate() {
                grad.data[k * n + p as usize] += self.weights.compact * g;
            }
        }
        result.loss
    }

    /// The losses of the last step, on the host or downloaded.
    pub fn losses(&self) -> Result<FieldLosses, RasterError> {
        self.on_device.as_ref().map_or(Ok(self.losses), |on_device| on_device.losses())
    }

    /// The refined features, on the host or downloaded.
    pub fn finish(self) -> Result<RefinedFeatures, RasterError> {
        match &self.on_device {
            Some(on_device) => on_device.download(),
            None => Ok(RefinedFeatures {
                values: self.values,
                decoder: self.decoder.map(|decoder| decoder.numbers().to_vec()),
            }),
        }
    }
}
