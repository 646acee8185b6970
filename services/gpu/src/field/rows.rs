//! Rows of numbers, one per splat, and their optimiser (`objective/src/field/rows.rs`).

use crate::GpuError;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer};
use crate::groups::GROUP;
use crate::packing::pack_splats;
use crate::shaders::{ROW_STATE, ROW_STEP};
use segwild_raster::{Channels, RasterError};
use std::sync::Arc;

/// Rows with their optimiser state.
pub(crate) struct GpuRows {
    device: Arc<GpuDevice>,
    count: usize,
    rows: usize,
    rate: f32,
    /// Vec4 of a part's rows.
    wide: usize,
    parts: Vec<RowPart>,
    /// Steps of every row.
    steps: PooledBuffer,
}

struct RowPart {
    values: PooledBuffer,
    first: PooledBuffer,
    second: PooledBuffer,
}

impl GpuRows {
    /// Bytes that so many rows of numbers take, and a step's gradients beside them, in parts of so many vec4.
    pub fn bytes(rows: usize, count: usize, wide: usize) -> u64 {
        (4 * 4 * rows * count.next_multiple_of(4 * wide)) as u64
    }

    /// Uploads rows, in parts of so many vec4.
    pub fn upload(
        device: &Arc<GpuDevice>,
        channels: &Channels,
        rate: f32,
        wide: usize,
    ) -> Result<GpuRows, GpuError> {
        let Channels { count, values } = *channels;
        let rows = values.len() / count.max(1);
        let mut work = device.work();
        let mut parts = Vec::new();
        for first in (0..count).step_by(4 * wide) {
            let packed = pack_splats(values, rows, count, first, wide, false);
            let values = work.upload("rows that learn", &packed)?;
            let [first, second] = [
                work.take::<f32>("their moments", rows * wide * 4)?,
                work.take::<f32>("their moments", rows * wide * 4)?,
            ];
            work.clear(&first);
            work.clear(&second);
            parts.push(RowPart { values, first, second });
        }
        let steps = work.take::<u32>("steps of the rows", rows)?;
        work.clear(&steps);
        work.hand_in();
        drop(work);
        Ok(GpuRows { device: device.clone(), count, rows, rate, wide, parts, steps })
    }

    /// Numbers of a row.
    pub fn count(&self) -> usize {
        self.count
    }

    /// The values of the part that starts with a number.
    pub fn part(&self, first: usize) -> &PooledBuffer {
        &self.parts[first / (4 * self.wide)].values
    }

    /// One step by these gradients, each of so many vec4 of every row, in the order of the numbers.
    pub fn step(&self, work: &mut DeviceWork, grads: &[PooledBuffer], blocks: usize) -> Result<(), GpuError> {
        let states = states(work, self.rows, grads, blocks)?;
        let each = self.rows.div_ceil(GROUP);
        let wide = self.wide;
        for (k, grads) in grads.iter().enumerate() {
            let (part, within) = (k * blocks / wide, k * blocks % wide);
            let RowPart { values, first, second } = &self.parts[part];
            let is_first = if k == 0 { 1 << 31 } else { 0 };
            let position = (wide | within << 16) as u32;
            let job = [self.rows as u32, blocks as u32, position, self.rate.to_bits() | is_first];
            work.run(&ROW_STEP, 1, job, &[grads, &states, values, first, second, &self.steps], each);
        }
        work.hand_in();
        Ok(())
    }

    /// The values, `[row][number]`.
    pub fn download(&self) -> Result<Vec<f32>, RasterError> {
        let wide = 4 * self.wide;
        let mut out = vec![0.0; self.rows * self.count];
        for (part, first) in self.parts.iter().zip((0..self.count).step_by(wide)) {
            let values: Vec<f32> = self.device.work().read(&part.values, self.rows * wide)?;
            let many = (self.count - first).min(wide);
            for (out, values) in out.chunks_exact_mut(self.count).zip(values.chunks_exact(wide)) {
                out[first..first + many].copy_from_slice(&values[..many]);
            }
        }
        Ok(out)
    }
}

/// Flags per row: whether it has a gradient, and whether one is not finite.
pub fn states(
    work: &mut DeviceWork,
    rows: usize,
    results: &[PooledBuffer],
    blocks: usize,
) -> Result<PooledBuffer, GpuError> {
    let states = work.take::<u32>("the states of the rows", rows)?;
    work.clear(&states);
    for result in results {
        work.run(&ROW_STATE, 1, [rows as u32, blocks as u32, 0, 0], &[result, &states], rows.div_ceil(GROUP));
    }
    Ok(states)
}
