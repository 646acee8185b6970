//! The feature field: its losses, the optimiser of rows, and the similarity to clicks.

use super::device_passes::DevicePasses;
use crate::channels::GpuChannels;
use crate::device::{DeviceWork, PooledBuffer};
use crate::field::{GpuFeatureTarget, GpuField, GpuRows};
use crate::packing::{at_once, gathered_at_once, pack_image, pack_splats, parts_of, unpack_image};
use crate::{GpuEngine, GpuError};
use segwild_objective::field::{
    DeviceRefinement, FeatureTarget, FieldLosses, FieldRefinement, Queries, RefinedFeatures, SampledPixels,
};
use segwild_raster::{Channels, RasterError};
use segwild_scene::Image;

/// The losses of a field, for one image after the other.
pub struct FieldGradients<'e> {
    engine: &'e GpuEngine,
    field: GpuField,
}

impl<'e> FieldGradients<'e> {
    /// Uploads a field.
    ///
    /// # Errors
    /// When it does not fit.
    pub fn upload(engine: &'e GpuEngine, field: &FieldRefinement) -> Result<FieldGradients<'e>, GpuError> {
        Ok(FieldGradients { engine, field: GpuField::upload(&engine.device, field)? })
    }

    /// Gradients of an image of features; the decoder learns, the features do not.
    ///
    /// # Errors
    /// When memory does not suffice, or the device fails.
    pub fn of(
        &mut self,
        image: &Image,
        feature_target: &FeatureTarget,
        sampled: &SampledPixels,
    ) -> Result<Image, GpuError> {
        let mut work = self.engine.device.work();
        let feature_target = GpuFeatureTarget::upload(&self.engine.device, &mut work, feature_target)?;
        let step = self.field.start(&mut work, &feature_target, sampled)?;
        let (pixels, count) = (image.pixels(), image.channels);
        for first in parts_of(count) {
            let blocks = at_once(count);
            let part = work.upload("the image", &pack_image(image, first, blocks, None))?;
            step.take(&mut work, first / 4, blocks, &part);
        }
        step.compute_losses(&mut work)?;
        let mut out = Image::zeros(image.width, image.height, count);
        let blocks = gathered_at_once(count);
        for first in (0..count).step_by(4 * blocks) {
            let part = step.gradients(&mut work, first / 4, blocks)?;
            let grads: Vec<f32> = work.read(&part, 4 * blocks * pixels)?;
            unpack_image(&grads, 4 * blocks, first, &mut out);
        }
        // No row learns, but the losses are kept.
        step.finish(&mut work, &[], blocks)?;
        Ok(out)
    }

    /// Losses of the last image.
    ///
    /// # Errors
    /// When the device fails.
    pub fn losses(&self) -> Result<FieldLosses, RasterError> {
        self.field.losses()
    }

    /// Features and decoder.
    ///
    /// # Errors
    /// When the device fails.
    pub fn download(&self) -> Result<RefinedFeatures, RasterError> {
        self.field.download()
    }
}

/// The losses of a field and their gradients, of one image.
pub struct FieldPasses<'e> {
    work: DeviceWork<'e>,
    field: GpuField,
    channels: usize,
    feature_target: GpuFeatureTarget,
    parts: Vec<(usize, PooledBuffer)>,
}

impl<'e> FieldPasses<'e> {
    /// Uploads a field, an image of its features, and their target.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn upload(
        engine: &'e GpuEngine,
        field: &FieldRefinement,
        image: &Image,
        feature_target: &FeatureTarget,
    ) -> Result<FieldPasses<'e>, GpuError> {
        let field = GpuField::upload(&engine.device, field)?;
        let mut work = engine.device.work();
        let feature_target = GpuFeatureTarget::upload(&engine.device, &mut work, feature_target)?;
        let (channels, blocks) = (image.channels, at_once(image.channels));
        let parts = parts_of(channels)
            .map(|first| Ok((first, work.upload("the image", &pack_image(image, first, blocks, None))?)))
            .collect::<Result<_, GpuError>>()?;
        Ok(FieldPasses { work, field, channels, feature_target, parts })
    }

    /// Losses of the image and of the sampled pixels, and the image's gradients.
    ///
    /// # Errors
    /// When memory does not suffice.
    pub fn losses(&mut self, sampled: &SampledPixels) -> Result<(), GpuError> {
        let FieldPasses { work, field, channels, feature_target, parts } = self;
        let step = field.start(work, feature_target, sampled)?;
        for (first, image) in parts.iter() {
            step.take(work, first / 4, at_once(*channels), image);
        }
        step.compute_losses(work)?;
        let blocks = gathered_at_once(*channels);
        for first in (0..*channels).step_by(4 * blocks) {
            step.gradients(work, first / 4, blocks)?;
        }
        Ok(())
    }
}

impl DevicePasses for FieldPasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}

/// The optimiser of rows of numbers, which rest where they have no gradient.
pub struct RowSteps<'e> {
    engine: &'e GpuEngine,
    rows: GpuRows,
    count: usize,
}

impl<'e> RowSteps<'e> {
    /// Uploads the rows of some channels, which learn at a rate.
    ///
    /// # Errors
    /// When they do not fit.
    pub fn upload(engine: &'e GpuEngine, channels: &Channels, rate: f32) -> Result<RowSteps<'e>, GpuError> {
        let rows = GpuRows::upload(&engine.device, channels, rate, at_once(channels.count))?;
        Ok(RowSteps { engine, rows, count: channels.count })
    }

    /// One step by the gradients of all rows, `[row][number]`.
    ///
    /// # Errors
    /// When memory does not suffice.
    pub fn step(&mut self, grads: &[f32]) -> Result<(), GpuError> {
        let (mut work, count) = (self.engine.device.work(), self.count);
        let (rows, blocks) = (grads.len() / count, gathered_at_once(count));
        let parts = (0..count)
            .step_by(4 * blocks)
            .map(|first| work.upload("gradients", &pack_splats(grads, rows, count, first, blocks, false)));
        let parts = parts.collect::<Result<Vec<_>, GpuError>>()?;
        self.rows.step(&mut work, &parts, blocks)
    }

    /// The rows, `[row][number]`.
    ///
    /// # Errors
    /// When the device fails.
    pub fn download(&self) -> Result<Vec<f32>, RasterError> {
        self.rows.download()
    }
}

/// The comparison of every splat's features with those of clicks.
pub struct SimilarityPasses<'e> {
    work: DeviceWork<'e>,
    channels: GpuChannels,
}

impl<'e> SimilarityPasses<'e> {
    /// Uploads the features; `None` where they would take more than their share of the device's memory.
    ///
    /// # Errors
    /// When the device fails.
    pub fn upload(
        engine: &'e GpuEngine,
        features: &Channels,
    ) -> Result<Option<SimilarityPasses<'e>>, GpuError> {
        let channels = GpuChannels::upload(&engine.device, features)?;
        Ok(channels.map(|channels| SimilarityPasses { work: engine.device.work(), channels }))
    }

    /// Compares them.
    ///
    /// # Errors
    /// When memory does not suffice.
    pub fn compare(&mut self, queries: &Queries) -> Result<(), GpuError> {
        self.channels.resemblance(&mut self.work, queries).map(drop)
    }
}

impl DevicePasses for SimilarityPasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}
