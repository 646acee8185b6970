//! Channels that stay on the device: blended by many views, or compared with clicks.

use crate::GpuError;
use crate::device::{Device, Lent, Work};
use crate::engine::GROUP;
use crate::memory::keeps_channels;
use crate::shaders::{COSINES, FUSE};
use crate::view::{at_once, pack_splats, parts_of};
use segwild_raster::Channels;
use segwild_raster::field::Queries;
use std::sync::Arc;

/// Channels that stay on a device.
pub(crate) struct Brought {
    device: Arc<Device>,
    rows: usize,
    count: usize,
    /// As many at once as a view blends.
    parts: Vec<Lent>,
}

impl Brought {
    /// `None` where they would take more than their share of the device's memory.
    pub fn upload(device: &Arc<Device>, channels: &Channels) -> Result<Option<Brought>, GpuError> {
        let Channels { count, values } = *channels;
        let n = values.len() / count.max(1);
        let wide = at_once(count) * 4;
        let bytes = 4 * (n * count.next_multiple_of(wide)) as u64;
        let mut work = device.work();
        if !keeps_channels(bytes, work.budget()) {
            return Ok(None);
        }
        let parts = parts_of(count)
            .map(|first| {
                let packed = pack_splats(values, n, count, first, wide / 4, false);
                work.upload("channels that are kept", &packed)
            })
            .collect::<Result<_, _>>()?;
        drop(work);
        Ok(Some(Brought { device: device.clone(), rows: n, count, parts }))
    }

    /// Whether it is this device that they are on.
    pub fn is_on(&self, device: &Arc<Device>) -> bool {
        Arc::ptr_eq(&self.device, device)
    }

    /// The channels from one on, as many as a view blends at once.
    pub fn part(&self, first: usize) -> &Lent {
        &self.parts[first / (4 * at_once(self.count))]
    }

    /// How much each row resembles the queries.
    pub fn similarity(&self, queries: &Queries) -> Result<Vec<f32>, GpuError> {
        let mut work = self.device.work();
        let fused = self.resemblance(&mut work, queries)?;
        work.read(&fused, self.rows)
    }

    /// The same, which stays there.
    pub fn resemblance(&self, work: &mut Work, queries: &Queries) -> Result<Lent, GpuError> {
        let (rows, feature_target, blocks) = (self.rows, queries.units.len(), at_once(self.count));
        assert_eq!(queries.channels, self.count, "numbers of a query");
        let wide = self.parts.len() * blocks;
        let mut units = vec![0.0; 4 * wide * feature_target];
        for (out, unit) in units.chunks_exact_mut(4 * wide).zip(queries.units) {
            out[..unit.len()].copy_from_slice(unit);
        }
        let units = work.upload("what is asked", &units)?;
        let sums = work.take::<f32>("products with what is asked", rows * (feature_target + 1))?;
        let fused = work.take::<f32>("how much splats resemble it", rows)?;
        work.clear(&sums);
        let groups = rows.div_ceil(GROUP);
        for (k, part) in self.parts.iter().enumerate() {
            let job = [rows, feature_target, wide, k * blocks].map(|n| n as u32);
            work.run(&COSINES, blocks as u32, job, &[part, &units, &sums], groups);
        }
        let job = [rows as u32, feature_target as u32, queries.sharpness.to_bits(), 0];
        work.run(&FUSE, 1, job, &[&sums, &fused], groups);
        Ok(fused)
    }
}
