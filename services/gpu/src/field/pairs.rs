//! Pairs of sampled pixels: the compactness loss (`objective/src/field/compact.rs`).
//!
//! Cosines of all pairs are a product of the pixels' unit features with themselves, and their gradients are another:
//! layers of a network whose weights are the unit features. Pairs of many pixels are computed in pieces of some
//! columns.

use crate::GpuError;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::nets::{GpuTape, NetworkPlan};
use crate::shaders::{
    COMPACTNESS_LOSS, MASK_PAIR_COUNTS, SAMPLED_FEATURES, SAMPLED_FEATURES_BACKWARD, SUM_GROUPS,
    UNIT_FEATURES, UNIT_FEATURES_BACKWARD,
};
use segwild_objective::field::{Membership, SampledPixels};

/// Pairs of a piece, but for its last column.
const PIECE: usize = 1 << 20;

/// Sampled pixels of a view, on the device.
pub(super) struct Pairs {
    pixels: usize,
    channels: usize,
    /// Their positions in the view.
    positions: PooledBuffer,
    /// The set of masks that hold each.
    groups: PooledBuffer,
    /// Sets of masks as bits, so many words each.
    sets: PooledBuffer,
    words: usize,
    /// Plane after plane: features, later unit features.
    features: PooledBuffer,
    plan: NetworkPlan,
    tape: GpuTape,
    /// Gradients of the features, plane after plane.
    feature_grads: PooledBuffer,
    /// Loss of each pixel.
    losses: PooledBuffer,
}

impl Pairs {
    /// Uploads pixels.
    pub fn upload(
        work: &mut DeviceWork,
        sampled: &SampledPixels,
        channels: usize,
    ) -> Result<Pairs, GpuError> {
        let n = sampled.pixels.len();
        let Membership { groups, .. } = sampled.membership;
        let groups: Vec<u32> = sampled.pixels.iter().map(|&p| groups[p as usize]).collect();
        let (bits, words) = sampled.membership.bits();
        let bits: Vec<u32> = bits.iter().flat_map(|word| [*word as u32, (word >> 32) as u32]).collect();
        let plan = NetworkPlan::of_pairs(channels, n, PIECE / n + 1);
        Ok(Pairs {
            pixels: n,
            channels,
            positions: work.upload("the sampled pixels", sampled.pixels)?,
            groups: work.upload("the masks of the sampled pixels", &groups)?,
            sets: work.upload("sets of masks", &bits)?,
            words: 2 * words,
            features: work.take::<f32>("the sampled pixels' features", channels * n)?,
            tape: GpuTape::new(work, &plan)?,
            plan,
            feature_grads: work.take::<f32>("the gradients of the sampled pixels", channels * n)?,
            losses: work.take::<f32>("the losses of the sampled pixels", n)?,
        })
    }

    /// Takes the features of a part of the image, of so many vec4 from the vec4 `first` on.
    pub fn take(&self, work: &mut DeviceWork, first: usize, blocks: usize, image: &PooledBuffer) {
        let job = [first, self.channels, self.pixels, 0].map(|n| n as u32);
        let groups = (self.pixels * blocks).div_ceil(GROUP);
        work.run(&SAMPLED_FEATURES, blocks as u32, job, &[&self.positions, image, &self.features], groups);
    }

    /// Computes the compactness loss over all pairs, and its gradients.
    pub fn compute_losses(&self, work: &mut DeviceWork, weight: f32) -> Result<(), GpuError> {
        let (n, channels, words) = (self.pixels as u32, self.channels as u32, self.words as u32);
        let Pairs { groups, sets, features, tape, losses, .. } = self;
        let lengths = work.take::<f32>("the sampled pixels' lengths", self.pixels)?;
        let counts = work.take::<[f32; 2]>("how many share a mask", self.pixels)?;
        let results = work.upload("weight and pairs", &[weight, 0.0, 0.0])?;
        let each = self.pixels.div_ceil(GROUP);
        work.run(&UNIT_FEATURES, 1, [n, channels, 0, 0], &[groups, features, &tape.maps, &lengths], each);
        work.run(&MASK_PAIR_COUNTS, 1, [n, words, 0, 0], &[groups, sets, &lengths, &counts], self.pixels);
        work.run(&SUM_GROUPS, 1, [n, 2, 1, 0], &[&counts, &results], 2);
        work.clear(losses);
        for piece in 0..self.plan.pieces() {
            let layer = 2 * piece as u32;
            tape.forward_piece(work, &self.plan, piece, features, &lengths);
            let buffers = [&tape.layers, groups, sets, &results, &tape.maps, &tape.grads, losses];
            work.run(&COMPACTNESS_LOSS, 1, [n, words, layer, 0], &buffers, self.pixels);
            tape.backward_piece(work, &self.plan, piece, features, &lengths);
            let buffers = [&tape.layers, features, &lengths, &tape.grads, &self.feature_grads];
            work.run(&UNIT_FEATURES_BACKWARD, 1, [n, channels, layer, 0], &buffers, each);
        }
        Ok(())
    }

    /// Adds the gradients of the pixels to a part of the image's.
    pub fn add(&self, work: &mut DeviceWork, first: usize, blocks: usize, image: &PooledBuffer) {
        let job = [first, self.channels, self.pixels, 0].map(|n| n as u32);
        let groups = (self.pixels * blocks).div_ceil(GROUP);
        work.run(
            &SAMPLED_FEATURES_BACKWARD,
            blocks as u32,
            job,
            &[&self.positions, &self.feature_grads, image],
            groups,
        );
    }

    /// Loss of each pixel, and the number of pixels.
    pub fn into_losses(self) -> (PooledBuffer, usize) {
        (self.losses, self.pixels)
    }
}
