//! Channels that stay on the device: blended by many views, or compared with clicks.

use crate::GpuError;
use crate::device::{DeviceWork, GpuDevice, PooledBuffer};
use crate::groups::GROUP;
use crate::memory::channels_fit;
use crate::packing::{at_once, pack_splats, parts_of};
use crate::shaders::{COSINES, FUSE};
use segwild_objective::field::Queries;
use segwild_raster::Channels;
use std::sync::Arc;

/// Channels that stay on a device.
pub(crate) struct GpuChannels {
    device: Arc<GpuDevice>,
    rows: usize,
    count: usize,
    /// Parts of as many channels as a view blends at once.
    parts: Vec<PooledBuffer>,
}

impl GpuChannels {
    /// Whether `count` channels of `n` splats take no more than their share of a device's memory.
    pub fn fit(n: usize, count: usize, budget: u64) -> bool {
        let bytes = (4 * n as u64).saturating_mul(count.next_multiple_of(4 * at_once(count)) as u64);
        channels_fit(bytes, budget)
    }

    /// `None` where they would take more than their share of the device's memory ([`GpuChannels::fit`]).
    pub fn upload(device: &Arc<GpuDevice>, channels: &Channels) -> Result<Option<GpuChannels>, GpuError> {
        let Channels { count, values } = *channels;
        let n = values.len() / count.max(1);
        let wide = at_once(count) * 4;
        let mut work = device.work();
        if !GpuChannels::fit(n, count, work.budget()) {
            return Ok(None);
        }
        let parts = parts_of(count)
            .map(|first| {
                let packed = pack_splats(values, n, count, first, wide / 4, false);
                work.upload("channels that are kept", &packed)
            })
            .collect::<Result<_, _>>()?;
        drop(work);
        Ok(Some(GpuChannels { device: device.clone(), rows: n, count, parts }))
    }

    /// Whether they are on this device.
    pub fn is_on(&self, device: &Arc<GpuDevice>) -> bool {
        Arc::ptr_eq(&self.device, device)
    }

    /// The channels from one on, as many as a view blends at once.
    pub fn part(&self, first: usize) -> &PooledBuffer {
        &self.parts[first / (4 * at_once(self.count))]
    }

    /// Fused similarity of each row to the queries.
    pub fn similarity(&self, queries: &Queries) -> Result<Vec<f32>, GpuError> {
        let mut work = self.device.work();
        let fused = self.resemblance(&mut work, queries)?;
        work.read(&fused, self.rows)
    }

    /// The same, kept on the device.
    pub fn resemblance(&self, work: &mut DeviceWork, queries: &Queries) -> Result<PooledBuffer, GpuError> {
        let (rows, clicks, blocks) = (self.rows, queries.units.len(), at_once(self.count));
        assert_eq!(queries.channels, self.count, "numbers of a query");
        let wide = self.parts.len() * blocks;
        let mut units = vec![0.0; 4 * wide * clicks];
        for (out, unit) in units.chunks_exact_mut(4 * wide).zip(queries.units) {
            out[..unit.len()].copy_from_slice(unit);
        }
        let units = work.upload("the queries", &units)?;
        let sums = work.take::<f32>("products with the queries", rows * (clicks + 1))?;
        let fused = work.take::<f32>("the similarity of splats", rows)?;
        work.clear(&sums);
        let groups = rows.div_ceil(GROUP);
        for (k, part) in self.parts.iter().enumerate() {
            let job = [rows, clicks, wide, k * blocks].map(|n| n as u32);
            work.run(&COSINES, blocks as u32, job, &[part, &units, &sums], groups);
        }
        let job = [rows as u32, clicks as u32, queries.sharpness.to_bits(), 0];
        work.run(&FUSE, 1, job, &[&sums, &fused], groups);
        Ok(fused)
    }
}
