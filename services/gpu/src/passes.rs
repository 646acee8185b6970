//! The passes over binned splats: blending, sums over pixels, gradients. All buffers stay on the device.
//!
//! Channels are stored in blocks of whole vec4: `[splat][block]` and `[pixel][block]`, filled up with zeros.

use crate::GpuError;
use crate::bin::Binned;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::shaders::{BACKWARD, BLEND, BUCKET_STATES, GATHER, PROJECT_BACKWARD, SUM_SLOTS};

/// Pixels of a tile.
pub(crate) const PIXELS: usize = 256;
/// Most vec4 that `bucket_states` and `backward` hold in registers; more are read from memory as they come.
const NEAR: usize = 2;

/// Output of `project_backward.wgsl` per splat, four vec4.
pub(crate) type ShapeGrads = [[f32; 4]; 4];

impl Binned {
    /// A buffer for the transmittance at the buckets, which [`Binned::blend`] fills for later passes.
    pub fn transmittances(&self, work: &mut DeviceWork) -> Result<PooledBuffer, GpuError> {
        work.take::<f32>("the transmittance at the buckets", self.bucket_bound * PIXELS)
    }

    /// The image of `blocks` vec4 of channels; the `first` of several runs writes alpha and transmittances too.
    pub fn blend(
        &self,
        work: &mut DeviceWork,
        blocks: usize,
        values: &PooledBuffer,
        first: bool,
        alpha: &PooledBuffer,
        transmittances: &PooledBuffer,
    ) -> Result<PooledBuffer, GpuError> {
        let image = work.take::<[f32; 4]>("the image", self.pixels * blocks)?;
        work.run(
            &BLEND,
            blocks as u32,
            [u32::from(first), 0, 0, 0],
            &[
                &self.view,
                &self.footprints,
                &self.entries,
                &self.tiles,
                values,
                &image,
                alpha,
                transmittances,
            ],
            self.tile_count,
        );
        Ok(image)
    }

    /// Sums over pixels of what each splat contributes times the image, of `blocks` (1 or 2) vec4.
    pub fn gather(
        &self,
        work: &mut DeviceWork,
        blocks: usize,
        image: &PooledBuffer,
        transmittances: &PooledBuffer,
    ) -> Result<PooledBuffer, GpuError> {
        let sums = work.take::<[f32; 4]>("the sums per splat", self.splats * blocks)?;
        if self.pairs == 0 {
            work.clear(&sums);
            return Ok(sums);
        }
        let slots = work.take::<[f32; 4]>("the sums per splat and tile", self.pairs * blocks)?;
        // Pairs that belong to no tile write nothing.
        work.clear(&slots);
        work.run(
            &GATHER,
            blocks as u32,
            [self.bucket_bound as u32, 0, 0, 0],
            &[&self.view, &self.footprints, &self.entries, &self.buckets, image, transmittances, &slots],
            self.bucket_bound,
        );
        let job = [self.splats as u32, blocks as u32, 0, 0];
        let groups = (self.splats * blocks).div_ceil(GROUP);
        work.run(&SUM_SLOTS, 1, job, &[&self.slots, &slots, &sums], groups);
        Ok(sums)
    }

    /// Gradients of the geometry ([`ShapeGrads`]), from those of an image of `blocks` vec4.
    pub fn backward(
        &self,
        work: &mut DeviceWork,
        blocks: usize,
        values: &PooledBuffer,
        image: &PooledBuffer,
    ) -> Result<PooledBuffer, GpuError> {
        let out = work.take::<ShapeGrads>("the gradients", self.splats)?;
        if self.pairs == 0 {
            work.clear(&out);
            return Ok(out);
        }
        let built = if blocks <= NEAR { blocks as u32 } else { 0 };
        let states = work.take::<[f32; 2]>("the state at the buckets", self.bucket_bound * PIXELS)?;
        let totals = work.take::<f32>("the pixels' totals", self.tile_count * PIXELS)?;
        let job = [blocks as u32, self.bucket_bound as u32, 0, 0];
        work.run(
            &BUCKET_STATES,
            built,
            job,
            &[&self.view, &self.footprints, &self.entries, &self.tiles, values, image, &states, &totals],
            self.tile_count,
        );
        let moments = work.take::<[f32; 8]>("the moments per splat and tile", self.pairs)?;
        work.clear(&moments);
        let reads = [
            &self.view,
            &self.footprints,
            &self.entries,
            &self.buckets,
            values,
            image,
            &states,
            &totals,
            &moments,
        ];
        work.run(&BACKWARD, built, job, &reads, self.bucket_bound);
        let job = [self.splats as u32, 0, 0, 0];
        let cloud = &self.cloud;
        let reads =
            [&self.view, &cloud.means, &cloud.log_scales, &cloud.rotations, &self.slots, &moments, &out];
        work.run(&PROJECT_BACKWARD, 1, job, &reads, self.splats.div_ceil(64));
        Ok(out)
    }
}
