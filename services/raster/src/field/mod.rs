//! What splats are told apart by, learnt from views: the feature field's sums over photos, its losses (method, section 4;
//! paper Eq. 9-14), of which no gradient reaches the geometry, and how much a click resembles it (section 6, Eq. 27).

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

use crate::{Channels, Engine, Projected, RasterError};
use segwild_scene::Image;
use std::any::Any;

/// What a photo asks of the features that are seen in it.
#[derive(Clone, Copy)]
pub struct FeatureTarget<'a> {
    /// What they should be, on the embedding's grid: codes, or where a decoder learns, the embedding.
    pub target: &'a Image,
    /// By how much its numbers are multiplied first.
    pub scale: f32,
    /// How far each of its cells is to be trusted (VM), in [0, 1].
    pub validity: &'a [f32],
    /// From the view's pixels to its cells.
    pub average: &'a AreaAverage,
    /// What [`Engine::upload_target`] gave for it.
    pub on_device: Option<&'a (dyn Any + Send + Sync)>,
}

/// Pixels drawn of a view, which are compared with one another.
#[derive(Clone, Copy)]
pub struct Rendered<'a> {
    /// Their numbers, row by row; none twice.
    pub pixels: &'a [u32],
    /// Which masks hold them.
    pub membership: &'a Membership,
}

/// What the losses weigh and how fast features learn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldRule {
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
    /// L_Com; 0 where no pixels were drawn.
    pub compact: f32,
}

/// Features that are refined, one row per splat, and perhaps a decoder beside them. They learn by
/// [`Projected::refine`](crate::Projected::refine), where they were settled.
pub struct Refining {
    values: Vec<f32>,
    adam: RowAdam,
    channels: usize,
    decoder: Option<LearnedDecoder>,
    rule: FieldRule,
    losses: FieldLosses,
    on_device: Option<Box<dyn DeviceRefinement>>,
}

/// Features where an engine computes.
pub trait DeviceRefinement: Send + Sync {
    /// The features, `[splat][channel]`, and the decoder's numbers.
    fn fetch(&self) -> Result<Refined, RasterError>;

    /// The losses of the last step.
    fn losses(&self) -> Result<FieldLosses, RasterError>;

    /// For the engine to know its own.
    fn as_any(&self) -> &dyn Any;
}

/// What was learnt.
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// `[splat][channel]`.
    pub values: Vec<f32>,
    /// [`LearnedDecoder::numbers`], if there is one.
    pub decoder: Option<Vec<f32>>,
}

impl Refining {
    /// Features of so many channels, `[splat][channel]`, of which nothing was learnt yet.
    pub fn new(
        channels: usize,
        values: Vec<f32>,
        decoder: Option<LearnedDecoder>,
        rule: FieldRule,
    ) -> Refining {
        let adam = RowAdam::new(values.len() / channels.max(1), channels, rule.rate);
        Refining { values, adam, channels, decoder, rule, losses: FieldLosses::default(), on_device: None }
    }

    /// Takes them to where an engine computes, if it has room for them there.
    pub fn settle(&mut self, engine: &dyn Engine) -> Result<(), RasterError> {
        self.on_device = engine.settle_refining(self)?;
        Ok(())
    }

    /// The features, as long as they are here.
    ///
    /// # Panics
    /// If they are elsewhere.
    pub fn channels(&self) -> Channels<'_> {
        assert!(self.on_device.is_none(), "features where another engine computes");
        Channels { count: self.channels, values: &self.values }
    }

    /// The decoder that learns beside them, as it was when they settled.
    pub fn decoder(&self) -> Option<&LearnedDecoder> {
        self.decoder.as_ref()
    }

    /// What the losses weigh and how fast features learn.
    pub fn rule(&self) -> FieldRule {
        self.rule
    }

    /// The features where an engine computes.
    pub fn on_device(&self) -> Option<&dyn DeviceRefinement> {
        self.on_device.as_deref()
    }

    /// One step of the features here: what [`Projected::refine`] does unless an engine does it where it computes.
    pub fn learn<P: Projected + ?Sized>(
        &mut self,
        view: &P,
        feature_target: &FeatureTarget,
        view_pixels: &Rendered,
    ) -> Result<(), RasterError> {
        let frame = view.blend(&self.channels())?;
        let grad = self.compute_losses(&frame.image, feature_target, view_pixels);
        let grads = view.gather(&grad)?;
        self.adam.step(&mut self.values, &grads);
        Ok(())
    }

    /// Compares a view of the features here with what its photo asks; the decoder learns, and the gradient with respect to the
    /// image is returned.
    ///
    /// # Panics
    /// If sizes differ.
    pub fn compute_losses(
        &mut self,
        image: &Image,
        feature_target: &FeatureTarget,
        view_pixels: &Rendered,
    ) -> Image {
        let mut grad = Image::zeros(image.width, image.height, image.channels);
        let rendered = feature_target.average.forward(image);
        let mut cell_grad = Image::zeros(rendered.width, rendered.height, image.channels);
        let target = (feature_target.target, feature_target.scale);
        let embedding = match &mut self.decoder {
            Some(decoder) => decoder.step(&rendered, target, feature_target.validity, &mut cell_grad),
            None => embedding_loss(&rendered, target, feature_target.validity, &mut cell_grad),
        };
        feature_target.average.transposed(&cell_grad, self.rule.embedding, &mut grad);
        let compact =
            if view_pixels.pixels.is_empty() { 0.0 } else { self.compare(image, view_pixels, &mut grad) };
        self.losses = FieldLosses { embedding, compact };
        grad
    }

    /// Adds the weighted gradient of the drawn pixels' compactness and returns the loss.
    fn compare(&self, image: &Image, Rendered { pixels, membership }: &Rendered, grad: &mut Image) -> f32 {
        let (n, c) = (image.pixels(), image.channels);
        let mut features = Vec::with_capacity(pixels.len() * c);
        for &p in *pixels {
            features.extend((0..c).map(|k| image.data[k * n + p as usize]));
        }
        let groups: Vec<u32> = pixels.iter().map(|&p| membership.groups[p as usize]).collect();
        let mut pull = vec![0.0; features.len()];
        let result = compactness(&features, c, &groups, membership, &mut pull);
        for (pull, &p) in pull.chunks_exact(c).zip(*pixels) {
            for (k, g) in pull.iter().enumerate() {
                grad.data[k * n + p as usize] += self.rule.compact * g;
            }
        }
        result.loss
    }

    /// The losses of the last step, wherever it was.
    pub fn losses(&self) -> Result<FieldLosses, RasterError> {
        self.on_device.as_ref().map_or(Ok(self.losses), |on_device| on_device.losses())
    }

    /// What was learnt, wherever it is.
    pub fn finish(self) -> Result<Refined, RasterError> {
        match &self.on_device {
            Some(on_device) => on_device.fetch(),
            None => Ok(Refined {
                values: self.values,
                decoder: self.decoder.map(|decoder| decoder.numbers().to_vec()),
            }),
        }
    }
}
