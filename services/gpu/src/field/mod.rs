//! The feature field on the device (`objective/src/field/`): features, their decoder and their losses.

mod feature_target;
mod pairs;
mod rows;
mod sums;

pub(crate) use feature_target::GpuFeatureTarget;
pub(crate) use rows::GpuRows;
pub(crate) use sums::GpuSums;

use crate::GpuError;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer, lock};
use crate::groups::GROUP;
use crate::nets::{GpuTape, GpuWeights, Link, NetworkPlan};
use crate::packing::{at_once, gathered_at_once, parts_of};
use crate::shaders::{AREA_AVERAGE, AREA_SPREAD, EMBEDDING_LOSS};
use crate::view::GpuView;
use pairs::Pairs;
use segwild_objective::field::{
    DeviceRefinement, FeatureTarget, FieldLosses, FieldRefinement, FieldWeights, RefinedFeatures,
    SampledPixels,
};
use segwild_raster::{Channels, Projected, RasterError};
use std::slice;
use std::sync::{Arc, Mutex};

/// Features on the device, and the decoder that learns beside them.
pub(crate) struct GpuField {
    pub device: Arc<GpuDevice>,
    pub rows: GpuRows,
    decoder: Option<GpuDecoder>,
    weights: FieldWeights,
    /// Partial sums of the last step's losses.
    last: Mutex<Option<Last>>,
}

/// The learned decoder: a dense layer whose offsets are the last of its rows.
struct GpuDecoder {
    rows: GpuRows,
    inputs: usize,
    outputs: usize,
}

struct Last {
    /// Partial sums of the embedding loss, and their number.
    parts: (PooledBuffer, usize),
    share: f32,
    /// Losses of the sampled pixels.
    pairs: Option<(PooledBuffer, usize)>,
}

impl GpuField {
    /// Bytes that it takes, and a step's gradients beside it.
    pub fn bytes(field: &FieldRefinement) -> u64 {
        let Channels { count, values } = field.channels();
        GpuRows::bytes(values.len() / count.max(1), count, at_once(count))
    }

    /// Uploads it.
    pub fn upload(device: &Arc<GpuDevice>, field: &FieldRefinement) -> Result<GpuField, GpuError> {
        let channels = field.channels();
        let rows = GpuRows::upload(device, &channels, field.weights().rate, at_once(channels.count))?;
        let decoder = field.decoder().map(|decoder| {
            let (inputs, outputs) = decoder.size();
            let numbers = Channels { count: outputs, values: decoder.numbers() };
            let rows = GpuRows::upload(device, &numbers, decoder.rate(), outputs.div_ceil(4))?;
            Ok(GpuDecoder { rows, inputs, outputs })
        });
        let (weights, decoder) = (field.weights(), decoder.transpose()?);
        Ok(GpuField { device: device.clone(), rows, decoder, weights, last: Mutex::default() })
    }

    /// Starts a step.
    pub fn start<'s>(
        &'s self,
        work: &mut DeviceWork,
        feature_target: &'s GpuFeatureTarget,
        sampled: &SampledPixels,
    ) -> Result<FieldStep<'s>, GpuError> {
        let channels = self.rows.count();
        let (plan, wanted) = match &self.decoder {
            Some(decoder) => (decoder.plan(feature_target.cells), decoder.outputs),
            None => (NetworkPlan::of_points(&[], channels, feature_target.cells), channels),
        };
        assert_eq!(feature_target.planes, wanted, "planes of the feature target");
        let pairs =
            (!sampled.pixels.is_empty()).then(|| Pairs::upload(work, sampled, channels)).transpose()?;
        // Of all cells there are.
        let count = work.upload("how many cells there are", &[feature_target.cells as u32])?;
        Ok(FieldStep { field: self, feature_target, tape: GpuTape::new(work, &plan)?, plan, pairs, count })
    }

    /// A step of the features in a view.
    fn try_step(
        &self,
        view: &GpuView,
        feature_target: &FeatureTarget,
        sampled: &SampledPixels,
    ) -> Result<(), GpuError> {
        let work = &mut view.device.work();
        let kept =
            feature_target.on_device.and_then(|on_device| on_device.downcast_ref::<GpuFeatureTarget>());
        let up;
        let feature_target = match kept.filter(|feature_target| view.is_on(&feature_target.device)) {
            Some(feature_target) => feature_target,
            None => {
                up = GpuFeatureTarget::upload(&view.device, work, feature_target)?;
                &up
            }
        };
        let count = self.rows.count();
        let step = self.start(work, feature_target, sampled)?;
        let (grads, blocks) = view.with_transmittances(work, |work, transmittances| {
            let blocks = at_once(count);
            let alpha = work.take::<f32>("alpha", view.pixels())?;
            for first in parts_of(count) {
                let image =
                    view.on.blend(work, blocks, self.rows.part(first), false, &alpha, transmittances)?;
                step.take(work, first / 4, blocks, &image);
            }
            step.compute_losses(work)?;
            let blocks = gathered_at_once(count);
            let grads = (0..count).step_by(blocks * 4).map(|first| {
                let image = step.gradients(work, first / 4, blocks)?;
                view.on.gather(work, blocks, &image, transmittances)
            });
            Ok((grads.collect::<Result<Vec<_>, _>>()?, blocks))
        })?;
        step.finish(work, &grads, blocks)
    }
}

impl GpuDecoder {
    /// Its kernels, for so many cells.
    fn plan(&self, cells: usize) -> NetworkPlan {
        let (inputs, outputs) = (self.inputs, self.outputs.next_multiple_of(4));
        let weights = 0..(inputs + 1) * outputs;
        let link = Link {
            weights,
            input: inputs,
            output: outputs,
            from: 0,
            to: inputs,
            relu: false,
            wanted: inputs,
        };
        NetworkPlan::of_points(&[link], inputs + outputs, cells)
    }
}

/// A step of the field, in this order: [`FieldStep::take`] for every part of the image, [`FieldStep::compute_losses`],
/// then [`FieldStep::gradients`] for every part.
pub(crate) struct FieldStep<'s> {
    field: &'s GpuField,
    feature_target: &'s GpuFeatureTarget,
    plan: NetworkPlan,
    /// Planes of cells: features, and what they are decoded to.
    tape: GpuTape,
    pairs: Option<Pairs>,
    count: PooledBuffer,
}

impl FieldStep<'_> {
    /// Takes a part of the image, of so many vec4 from the vec4 `first` on.
    pub fn take(&self, work: &mut DeviceWork, first: usize, blocks: usize, image: &PooledBuffer) {
        let job = [first as u32, self.field.rows.count() as u32, 0, 0];
        let groups = (self.feature_target.cells * blocks).div_ceil(GROUP);
        work.run(
            &AREA_AVERAGE,
            blocks as u32,
            job,
            &[&self.feature_target.windows, image, &self.tape.maps],
            groups,
        );
        if let Some(pairs) = &self.pairs {
            pairs.take(work, first, blocks, image);
        }
    }

    /// Computes the losses; the decoder learns.
    pub fn compute_losses(&self, work: &mut DeviceWork) -> Result<(), GpuError> {
        let FieldStep { field, feature_target, plan, tape, count, .. } = self;
        let cells = feature_target.cells;
        let first = field.decoder.as_ref().map_or(0, |decoder| decoder.inputs * cells);
        if let Some(decoder) = &field.decoder {
            tape.forward(work, plan, decoder.rows.part(0), count, 0);
        }
        // Planes that pad the decoded ones to whole vec4 have no gradient, and do not enter the mean.
        let planes = match field.decoder {
            Some(_) => feature_target.planes.next_multiple_of(4),
            None => feature_target.planes,
        };
        let numbers = planes * cells;
        let share = 1.0 / (feature_target.planes * cells).max(1) as f32;
        let groups = numbers.div_ceil(GROUP);
        let parts = work.take::<f32>("the embedding loss", groups)?;
        let job = [first as u32, numbers as u32, cells as u32, share.to_bits()];
        let buffers = [&tape.maps, &feature_target.target, &feature_target.trust, &tape.grads, &parts];
        work.run(&EMBEDDING_LOSS, 1, job, &buffers, groups);
        if let Some(decoder) = &field.decoder {
            let wide = decoder.outputs.div_ceil(4);
            let grads = work.take::<[f32; 4]>("the decoder's gradients", (decoder.inputs + 1) * wide)?;
            work.clear(&grads);
            let weights = GpuWeights { values: decoder.rows.part(0), grads: &grads };
            tape.backward(work, plan, weights, count, 0);
            decoder.rows.step(work, slice::from_ref(&grads), wide)?;
        }
        if let Some(pairs) = &self.pairs {
            pairs.compute_losses(work, field.weights.compact)?;
        }
        *lock(&field.last) = Some(Last { parts: (parts, groups), share, pairs: None });
        Ok(())
    }

    /// A part of the image's gradients.
    pub fn gradients(
        &self,
        work: &mut DeviceWork,
        first: usize,
        blocks: usize,
    ) -> Result<PooledBuffer, GpuError> {
        let [width, height] = self.feature_target.size;
        let image = work.take::<[f32; 4]>("the image's gradients", width * height * blocks)?;
        let weights = self.field.weights;
        let job = [first as u32, self.field.rows.count() as u32, weights.embedding.to_bits(), 0];
        let groups = (width * height * blocks).div_ceil(GROUP);
        work.run(
            &AREA_SPREAD,
            blocks as u32,
            job,
            &[&self.feature_target.windows, &self.tape.grads, &image],
            groups,
        );
        if let Some(pairs) = &self.pairs {
            pairs.add(work, first, blocks, &image);
        }
        Ok(image)
    }

    /// Steps the features by the gradients of every part.
    pub fn finish(
        self,
        work: &mut DeviceWork,
        grads: &[PooledBuffer],
        blocks: usize,
    ) -> Result<(), GpuError> {
        self.field.rows.step(work, grads, blocks)?;
        if let (Some(pairs), Some(last)) = (self.pairs, &mut *lock(&self.field.last)) {
            last.pairs = Some(pairs.into_losses());
        }
        Ok(())
    }
}

impl DeviceRefinement for GpuField {
    fn download(&self) -> Result<RefinedFeatures, RasterError> {
        let decoder = self.decoder.as_ref().map(|decoder| decoder.rows.download()).transpose()?;
        Ok(RefinedFeatures { values: self.rows.download()?, decoder })
    }

    fn losses(&self) -> Result<FieldLosses, RasterError> {
        // The device first, as in a step.
        let (mut work, last) = (self.device.work(), lock(&self.last));
        let Some(Last { parts, share, pairs }) = &*last else { return Ok(FieldLosses::default()) };
        let mut sum = |(results, count): &(PooledBuffer, usize)| -> Result<f64, GpuError> {
            let results: Vec<f32> = work.read(results, *count)?;
            Ok(results.iter().map(|&part| f64::from(part)).sum())
        };
        let embedding = (sum(parts)? * f64::from(*share)) as f32;
        let compact = pairs.as_ref().map_or(Ok(0.0), &mut sum)? as f32;
        Ok(FieldLosses { embedding, compact })
    }

    fn step(
        &self,
        view: &dyn Projected,
        feature_target: &FeatureTarget,
        sampled: &SampledPixels,
    ) -> Result<(), RasterError> {
        let view = GpuView::of(view, &self.device);
        assert_eq!(feature_target.average.from(), view.size(), "refine: width, height");
        Ok(self.try_step(view, feature_target, sampled)?)
    }
}
