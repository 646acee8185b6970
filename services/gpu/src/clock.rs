//! How long each kernel takes by the device's own clock: asked for by the benchmark alone, since what was handed in is waited
//! for to read it.

use std::collections::BTreeMap;
use wgpu::{BufferDescriptor, BufferUsages, CommandEncoder, ComputePassTimestampWrites};

/// When each kernel of a hand-in began and ended, and what all of them took so far.
pub(crate) struct Clock {
    moments: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    /// Kernels that were recorded since the last hand-in.
    kernels: Vec<&'static str>,
    spent: BTreeMap<&'static str, f64>,
    /// Milliseconds of a tick.
    tick: f64,
}

impl Clock {
    /// For so many kernels of a hand-in at the most.
    pub fn new(device: &wgpu::Device, queue: &wgpu::Queue, kernels: usize) -> Clock {
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
        Clock {
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

    /// What a kernel's pass writes down.
    pub fn moments_of(&mut self, kernel: &'static str) -> ComputePassTimestampWrites<'_> {
        let first = 2 * self.kernels.len() as u32;
        self.kernels.push(kernel);
        ComputePassTimestampWrites {
            query_set: &self.moments,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        }
    }

    /// Ends what is to be handed in.
    pub fn close(&self, encoder: &mut CommandEncoder) {
        let count = 2 * self.kernels.len() as u32;
        if count > 0 {
            encoder.resolve_query_set(&self.moments, 0..count, &self.resolved, 0);
            encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, u64::from(count) * 8);
        }
    }

    /// Waits for what was handed in, and adds up. What cannot be read is left out.
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
