//! Lifting on the device: sums per splat over views (`objective/src/field/lifting.rs`).

use super::rows::states;
use crate::GpuError;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer};
use crate::groups::GROUP;
use crate::packing::gathered_at_once;
use crate::shaders::ROW_ADD;
use crate::view::GpuView;
use segwild_objective::field::DeviceLifting;
use segwild_raster::{Projected, RasterError};
use segwild_scene::Image;
use std::sync::Arc;

/// Sums over views.
pub(crate) struct GpuSums {
    pub device: Arc<GpuDevice>,
    rows: usize,
    /// Numbers of a row, without its weight.
    row: usize,
    /// Parts of as many numbers as a view gathers at once; the weight follows the last number.
    parts: Vec<PooledBuffer>,
}

impl GpuSums {
    /// Bytes that sums of so many rows of numbers take, with the sums of one view.
    pub fn bytes(rows: usize, row: usize) -> u64 {
        (2 * 4 * rows * (row + 1).next_multiple_of(4 * gathered_at_once(row + 1))) as u64
    }

    pub fn new(device: &Arc<GpuDevice>, rows: usize, row: usize) -> Result<GpuSums, GpuError> {
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

    /// Numbers of a view per row, with the weight.
    pub fn count(&self) -> usize {
        self.row + 1
    }

    /// Adds the sums of a view, each of so many vec4 of every row.
    pub fn add_view(
        &self,
        work: &mut DeviceWork,
        results: &[PooledBuffer],
        blocks: usize,
    ) -> Result<(), GpuError> {
        let Some(last) = results.last() else { return Ok(()) };
        let states = states(work, self.rows, results, blocks)?;
        let job = [self.rows, blocks, self.row % (blocks * 4), 0].map(|n| n as u32);
        for (results, sums) in results.iter().zip(&self.parts) {
            work.run(&ROW_ADD, 1, job, &[results, &states, last, sums], self.rows.div_ceil(GROUP));
        }
        work.hand_in();
        Ok(())
    }

    /// Adds the sums of an image over a view.
    fn try_add(&self, view: &GpuView, image: &Image) -> Result<(), GpuError> {
        if view.on.pairs == 0 {
            return Ok(());
        }
        let work = &mut view.device.work();
        let (results, blocks) = view.gathered(work, image)?;
        self.add_view(work, &results, blocks)
    }
}

impl DeviceLifting for GpuSums {
    fn download(&self) -> Result<(Vec<f32>, Vec<f32>), RasterError> {
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

    fn add(&self, view: &dyn Projected, image: &Image) -> Result<(), RasterError> {
        let view = GpuView::of(view, &self.device);
        view.assert_image(image, self.count(), "lift");
        assert_eq!(self.rows, view.splats(), "splats");
        Ok(self.try_add(view, image)?)
    }
}
