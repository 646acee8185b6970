//! Times each kernel by the device's own clock. Only the benchmark uses it, since reading the times waits for the
//! submitted work.

use std::collections::BTreeMap;
use wgpu::{BufferDescriptor, BufferUsages, CommandEncoder, ComputePassTimestampWrites};

/// Start and end of each kernel of a submission, and the totals so far.
pub(crate) struct KernelClock {
    moments: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    /// Kernels that were recorded since the last hand-in.
    kernels: Vec<&'static str>,
    spent: BTreeMap<&'static str, f64>,
    /// Milliseconds of a tick.
    tick: f64,
}

impl KernelClock {
    /// For so many kernels of a hand-in at the most.
    pub fn new(device: &wgpu::Device, queue: &wgpu::Queue, kernels: usize) -> KernelClock {
        let count = 2 * kernels as u32;
        let buffer = |label, usage| {
            let size = u64::from(count) * 8;
            device.create_buffer(&BufferDescriptor {
                label: Some(label),
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        KernelClock {
            moments: device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("when kernels ran"),
                ty: wgpu::QueryType::Timestamp,
                count,
            }),
            resolved: buffer("moments", BufferUsages::QUERY_RESOLVE | BufferUsages::COPY_SRC),
            staging: buffer("moments, read back", BufferUsages::MAP_READ | BufferUsages::COPY_DST),
            kernels: Vec::new(),
            spent: BTreeMap::new(),
            tick: f64::from(queue.get_timestamp_period()) * 1e-6,
        }
    }

    /// Timestamps that a kernel's pass writes.
    pub fn moments_of(&mut self, kernel: &'static str) -> ComputePassTimestampWrites<'_> {
        let first = 2 * self.kernels.len() as u32;
        self.kernels.push(kernel);
        ComputePassTimestampWrites {
            query_set: &self.moments,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        }
    }

    /// Resolves the timestamps before the submission.
    pub fn close(&self, encoder: &mut CommandEncoder) {
        let count = 2 * self.kernels.len() as u32;
        if count > 0 {
            encoder.resolve_query_set(&self.moments, 0..count, &self.resolved, 0);
            encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, u64::from(count) * 8);
        }
    }

    /// Waits for the submission, and adds its times up. Times that cannot be read are left out.
    pub fn read(&mut self, device: &wgpu::Device) {
        let kernels = std::mem::take(&mut self.kernels);
        if kernels.is_empty() {
            return;
        }
        let slice = self.staging.slice(..kernels.len() as u64 * 16);
        slice.map_async(wgpu::MapMode::Read, |_| {});
        if device.poll(wgpu::PollType::wait_indefinitely()).is_err() {
            return;
        }
        if let Ok(view) = slice.get_mapped_range() {
            for (kernel, moments) in kernels.iter().zip(view.chunks_exact(16)) {
                let [began, ended] =
                    [0, 8].map(|at| u64::from_le_bytes(std::array::from_fn(|k| moments[at + k])));
                *self.spent.entry(kernel).or_default() += ended.saturating_sub(began) as f64 * self.tick;
            }
        }
        self.staging.unmap();
    }

    /// Milliseconds of each kernel so far.
    pub fn spent(self) -> BTreeMap<&'static str, f64> {
        self.spent
    }
}
