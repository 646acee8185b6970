//! Rows of numbers, one per splat, that are learnt from views, or added up over them, where they are
//! (`raster/src/learning.rs`, `raster/src/lifting.rs`).

use crate::GpuError;
use crate::device::{Device, Lent, Work};
use crate::engine::GROUP;
use crate::shaders::{ROW_ADD, ROW_STATE, ROW_STEP};
use crate::view::{at_once, gathered_at_once, pack_splats, parts_of};
use segwild_raster::{Channels, LearningAway, LiftingAway, RasterError};
use std::any::Any;
use std::sync::Arc;

/// Rows, and what their optimiser knows of them.
pub(crate) struct GpuRows {
    pub device: Arc<Device>,
    count: usize,
    rows: usize,
    rate: f32,
    /// As many numbers at once as a view blends.
    parts: Vec<Part>,
    /// Steps of every row.
    steps: Lent,
}

struct Part {
    values: Lent,
    first: Lent,
    second: Lent,
}

impl GpuRows {
    pub fn upload(device: &Arc<Device>, channels: &Channels, rate: f32) -> Result<GpuRows, GpuError> {
        let Channels { count, values } = *channels;
        let (rows, wide) = (values.len() / count.max(1), at_once(count) * 4);
        let mut work = device.work();
        let mut parts = Vec::new();
        for first in parts_of(count) {
            let packed = pack_splats(values, rows, count, first, wide / 4, false);
            let values = work.upload("rows that learn", &packed)?;
            let [first, second] = [
                work.take::<f32>("their moments", rows * wide)?,
                work.take::<f32>("their moments", rows * wide)?,
            ];
            work.clear(&first);
            work.clear(&second);
            parts.push(Part { values, first, second });
        }
        let steps = work.take::<u32>("steps of the rows", rows)?;
        work.clear(&steps);
        work.hand_in();
        drop(work);
        Ok(GpuRows { device: device.clone(), count, rows, rate, parts, steps })
    }

    /// Numbers of a row.
    pub fn count(&self) -> usize {
        self.count
    }

    /// The values from a number on, as many as a view blends at once.
    pub fn part(&self, first: usize) -> &Lent {
        &self.parts[first / (at_once(self.count) * 4)].values
    }

    /// One step by these gradients, each of so many vec4 of every row: the first numbers', and so on.
    pub fn step(&self, work: &mut Work, grads: &[Lent], blocks: usize) -> Result<(), GpuError> {
        let states = states(work, self.rows, grads, blocks)?;
        let each = self.rows.div_ceil(GROUP);
        let wide = at_once(self.count);
        for (k, grads) in grads.iter().enumerate() {
            let (part, within) = (k * blocks / wide, k * blocks % wide);
            let Part { values, first, second } = &self.parts[part];
            let is_first = if k == 0 { 1 << 31 } else { 0 };
            let place = (wide | within << 16) as u32;
            let job = [self.rows as u32, blocks as u32, place, self.rate.to_bits() | is_first];
            work.run(&ROW_STEP, 1, job, &[grads, &states, values, first, second, &self.steps], each);
        }
        work.hand_in();
        Ok(())
    }
}

impl LearningAway for GpuRows {
    fn fetch(&self) -> Result<Vec<f32>, RasterError> {
        let wide = at_once(self.count) * 4;
        let mut out = vec![0.0; self.rows * self.count];
        for (part, first) in self.parts.iter().zip(parts_of(self.count)) {
            let values: Vec<f32> = self.device.work().read(&part.values, self.rows * wide)?;
            let many = (self.count - first).min(wide);
            for (out, values) in out.chunks_exact_mut(self.count).zip(values.chunks_exact(wide)) {
                out[first..first + many].copy_from_slice(&values[..many]);
            }
        }
        Ok(out)
    }

    fn as_any(&self) -> &dyn Any {
        self
    }
}

/// Whether something is said of each row, and whether all of it is a number.
fn states(work: &mut Work, rows: usize, said: &[Lent], blocks: usize) -> Result<Lent, GpuError> {
    let states = work.take::<u32>("what is said of the rows", rows)?;
    work.clear(&states);
    for said in said {
        work.run(&ROW_STATE, 1, [rows as u32, blocks as u32, 0, 0], &[said, &states], rows.div_ceil(GROUP));
    }
    Ok(states)
}

/// Sums over views.
pub(crate) struct GpuSums {
    pub device: Arc<Device>,
    rows: usize,
    /// Numbers of a row, without its weight.
    row: usize,
    /// As many numbers at once as a view gathers, the weight behind the last.
    parts: Vec<Lent>,
}

impl GpuSums {
    pub fn new(device: &Arc<Device>, rows: usize, row: usize) -> Result<GpuSums, GpuError> {
        let mut work = device.work();
        let wide = gathered_at_once(row + 1) * 4;
        let mut parts = Vec::new();
        for _ in (0..=row).step_by(wide) {
            let part = work.take::<f32>("sums over views", rows * wide)?;
            work.clear(&part);
            parts.push(part);
        }
        work.hand_in();
        drop(work);
        Ok(GpuSums { device: device.clone(), rows, row, parts })
    }

    /// Numbers that a view says of each row, its weight among them.
    pub fn count(&self) -> usize {
        self.row + 1
    }

    /// Splats that there are sums of.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Adds what a view says, each of so many vec4 of every row.
    pub fn add(&self, work: &mut Work, said: &[Lent], blocks: usize) -> Result<(), GpuError> {
        let Some(last) = said.last() else { return Ok(()) };
        let states = states(work, self.rows, said, blocks)?;
        let job = [self.rows, blocks, self.row % (blocks * 4), 0].map(|n| n as u32);
        for (said, sums) in said.iter().zip(&self.parts) {
            work.run(&ROW_ADD, 1, job, &[said, &states, last, sums], self.rows.div_ceil(GROUP));
        }
        work.hand_in();
        Ok(())
    }
}

impl LiftingAway for GpuSums {
    fn fetch(&self) -> Result<(Vec<f32>, Vec<f32>), RasterError> {
        let wide = gathered_at_once(self.count()) * 4;
        let (mut sums, mut weights) = (vec![0.0; self.rows * self.row], Vec::new());
        for (k, part) in self.parts.iter().enumerate() {
            let values: Vec<f32> = self.device.work().read(part, self.rows * wide)?;
            let first = k * wide;
            let many = (self.row - first.min(self.row)).min(wide);
            for (sums, values) in sums.chunks_exact_mut(self.row.max(1)).zip(values.chunks_exact(wide)) {
                sums[first..first + many].copy_from_slice(&values[..many]);
            }
            if many < wide {
                weights = values.chunks_exact(wide).map(|values| values[many]).collect();
            }
        }
        Ok((sums, weights))
    }

    fn as_any(&self) -> &dyn Any {
        self
    }
}
