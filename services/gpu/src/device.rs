//! The device: a pool of buffers, kernels that are built once, work in order.
//!
//! A lock gives one caller at a time access to the device ([`DeviceWork`]). A thread of its own would do the same, but
//! would copy borrowed data. The lock also keeps a buffer that was returned during a run from being overwritten by
//! another caller before that run is submitted.

use crate::GpuError;
use crate::adapter::{Adapter, AdapterChoice, open};
use crate::clock::KernelClock;
use crate::groups::rows_of;
use crate::shaders::{Kernel, source};
use crate::work_counts::WorkCounts;
use bytemuck::Pod;
use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use wgpu::{BufferUsages, ComputePipeline};

/// Kernels between two submissions; each has its four numbers in the arena.
const JOBS: usize = 256;
/// Distance of two jobs' numbers in the arena.
const JOB_STRIDE: u64 = 256;

/// Locks even after a panic of another thread: no state here is left half written.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Edit of a kernel's text before it is compiled.
pub(crate) type Edit = Box<dyn Fn(&Kernel, String) -> String + Send + Sync>;

type Free = Arc<Mutex<Vec<wgpu::Buffer>>>;

/// A buffer of the pool, returned when it is dropped. It may be longer than requested, and its content is arbitrary.
pub(crate) struct PooledBuffer {
    buffer: Option<wgpu::Buffer>,
    /// Bytes requested.
    bytes: u64,
    free: Free,
}

impl PooledBuffer {
    fn raw(&self) -> &wgpu::Buffer {
        self.buffer.as_ref().expect("it is taken out in drop only")
    }
}

impl Drop for PooledBuffer {
    fn drop(&mut self) {
        lock(&self.free).extend(self.buffer.take());
    }
}

/// An opened accelerator.
pub(crate) struct GpuDevice {
    pub adapter: Adapter,
    device: wgpu::Device,
    queue: wgpu::Queue,
    limit: u64,
    kernels: Mutex<HashMap<(&'static str, u32), Arc<ComputePipeline>>>,
    free: Free,
    staging: Free,
    /// Bytes of all buffers there are, and how many there may be; 0 sets no limit.
    allocated: AtomicU64,
    budget: AtomicU64,
    counts: Mutex<WorkCounts>,
    arena: wgpu::Buffer,
    /// The first failure.
    failed: Arc<Mutex<Option<String>>>,
    turn: Mutex<()>,
    clock: Mutex<Option<KernelClock>>,
    edit: Edit,
}

impl GpuDevice {
    pub fn open(choice: &AdapterChoice, subgroups: bool, edit: Edit) -> Result<GpuDevice, GpuError> {
        let (adapter, device, queue) = open(choice, subgroups)?;
        let failed = Arc::new(Mutex::new(None));
        let note = Arc::clone(&failed);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            lock(&note).get_or_insert(error.to_string());
        }));
        let note = Arc::clone(&failed);
        device.set_device_lost_callback(move |reason, text| {
            lock(&note).get_or_insert(format!("the device was lost ({reason:?}): {text}"));
        });
        let arena = device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("jobs"),
            size: JOBS as u64 * JOB_STRIDE,
            usage: BufferUsages::UNIFORM | BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        let limits = device.limits();
        Ok(GpuDevice {
            adapter,
            limit: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
            device,
            queue,
            kernels: Mutex::default(),
            free: Free::default(),
            staging: Free::default(),
            allocated: AtomicU64::new(0),
            budget: AtomicU64::new(0),
            counts: Mutex::default(),
            arena,
            failed,
            turn: Mutex::new(()),
            clock: Mutex::new(None),
            edit,
        })
    }

    /// Starts work; waits for the lock.
    pub fn work(&self) -> DeviceWork<'_> {
        let turn = lock(&self.turn);
        let encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        DeviceWork { device: self, pass: None, encoder, jobs: Vec::new(), dirty: false, _turn: turn }
    }

    /// Times every kernel from now on, if the device has a clock of its own.
    pub fn start_clock(&self) {
        if self.device.features().contains(wgpu::Features::TIMESTAMP_QUERY) {
            *lock(&self.clock) = Some(KernelClock::new(&self.device, &self.queue, JOBS));
        }
    }

    /// Milliseconds of each kernel since; none where the device has no clock.
    pub fn stop_clock(&self) -> BTreeMap<&'static str, f64> {
        lock(&self.clock).take().map_or_else(BTreeMap::new, KernelClock::spent)
    }

    fn check(&self) -> Result<(), GpuError> {
        match &*lock(&self.failed) {
            Some(why) => Err(self.failure(why.clone())),
            None => Ok(()),
        }
    }

    fn failure(&self, why: String) -> GpuError {
        GpuError::Failed { adapter: self.adapter.name.clone(), why }
    }

    fn kernel(&self, kernel: &Kernel, blocks: u32) -> Arc<ComputePipeline> {
        let mut kernels = lock(&self.kernels);
        let built = kernels.entry((kernel.name, blocks)).or_insert_with(|| {
            let text = (self.edit)(kernel, source(kernel, blocks, self.adapter.subgroups.is_some()));
            let module = wgpu::ShaderModuleDescriptor {
                label: Some(kernel.name),
                source: wgpu::ShaderSource::Wgsl(text.into()),
            };
            // A counter in every loop keeps drivers from unrolling it: an NVIDIA H200 blends 16 channels in a third of
            // the time without. Reads and writes are bounds-checked in any case.
            let checks = wgpu::ShaderRuntimeChecks {
                force_loop_bounding: false,
                ..wgpu::ShaderRuntimeChecks::checked()
            };
            // SAFETY: the kernels are this crate's own, and every loop of theirs ends (`tests/shaders.rs`).
            let module = unsafe { self.device.create_shader_module_trusted(module, checks) };
            Arc::new(self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(kernel.name),
                layout: None,
                module: &module,
                entry_point: Some(kernel.entry),
                compilation_options: wgpu::PipelineCompilationOptions {
                    zero_initialize_workgroup_memory: false,
                    ..Default::default()
                },
                cache: None,
            }))
        });
        Arc::clone(built)
    }

    /// Holds buffers of so many bytes at the most from now on; 0 sets no limit.
    pub fn keep_within(&self, bytes: u64) {
        self.budget.store(bytes, Ordering::Relaxed);
    }

    /// Bytes of the device's memory that are taken.
    pub fn allocated_bytes(&self) -> u64 {
        self.allocated.load(Ordering::Relaxed)
    }

    /// What it was given to do since it was opened.
    pub fn work_counts(&self) -> WorkCounts {
        *lock(&self.counts)
    }

    fn count(&self, add: impl FnOnce(&mut WorkCounts)) {
        add(&mut lock(&self.counts));
    }

    /// How many there may be; 0 sets no limit.
    pub fn budget(&self) -> u64 {
        self.budget.load(Ordering::Relaxed)
    }

    /// The shortest free buffer that holds so many bytes and is not much longer, or a new one.
    fn pick(
        &self,
        free: &Free,
        what: &'static str,
        bytes: u64,
        usage: BufferUsages,
    ) -> Result<PooledBuffer, GpuError> {
        let mut buffers = lock(free);
        let fits = |size: u64| size >= bytes && size <= 2 * bytes + (1 << 16);
        let best = (0..buffers.len()).filter(|&i| fits(buffers[i].size())).min_by_key(|&i| buffers[i].size());
        let buffer = best.map(|i| buffers.swap_remove(i));
        drop(buffers);
        let buffer = match buffer {
            Some(buffer) => buffer,
            None => {
                let size = self.free_memory(what, bytes)?;
                self.allocated.fetch_add(size, Ordering::Relaxed);
                self.device.create_buffer(&wgpu::BufferDescriptor {
                    label: Some(what),
                    size,
                    usage,
                    mapped_at_creation: false,
                })
            }
        };
        Ok(PooledBuffer { buffer: Some(buffer), bytes, free: Arc::clone(free) })
    }

    /// Size of a new buffer for so many bytes; within a budget, free buffers are dropped for it.
    fn free_memory(&self, what: &'static str, bytes: u64) -> Result<u64, GpuError> {
        // A quarter more, so that the next view's array, which is about as long, fits.
        let ample = (bytes + bytes / 4).min(self.limit.max(bytes)).next_multiple_of(256);
        let (least, budget) = (bytes.next_multiple_of(256), self.budget());
        if budget == 0 || self.allocated_bytes() + ample <= budget {
            return Ok(ample);
        }
        for free in [&self.free, &self.staging] {
            let mut free = lock(free);
            free.sort_by_key(wgpu::Buffer::size);
            while self.allocated_bytes() + least > budget
                && let Some(longest) = free.pop()
            {
                self.allocated.fetch_sub(longest.size(), Ordering::Relaxed);
            }
        }
        if self.allocated_bytes() + least > budget {
            let adapter = self.adapter.name.clone();
            return Err(GpuError::OverBudget {
                adapter,
                what,
                bytes,
                allocated: self.allocated_bytes(),
                budget,
            });
        }
        Ok(least)
    }
}

/// Exclusive access of one caller to the device.
pub(crate) struct DeviceWork<'d> {
    device: &'d GpuDevice,
    /// Kernels in a row share a pass; it ends before the encoder records anything else.
    pass: Option<wgpu::ComputePass<'static>>,
    encoder: wgpu::CommandEncoder,
    jobs: Vec<[u32; 4]>,
    dirty: bool,
    _turn: MutexGuard<'d, ()>,
}

impl DeviceWork<'_> {
    /// A buffer for `count` items.
    pub fn take<T>(&mut self, what: &'static str, count: usize) -> Result<PooledBuffer, GpuError> {
        // Never empty, and never shorter than a vec4, since kernels bind it.
        let bytes = (count as u64 * size_of::<T>() as u64).max(16);
        if bytes > self.device.limit {
            return Err(GpuError::TooLarge {
                adapter: self.device.adapter.name.clone(),
                what,
                bytes,
                limit: self.device.limit,
            });
        }
        let usage =
            BufferUsages::STORAGE | BufferUsages::UNIFORM | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        self.device.pick(&self.device.free, what, bytes, usage)
    }

    /// How many bytes buffers may have altogether; 0 sets no limit.
    pub fn budget(&self) -> u64 {
        self.device.budget()
    }

    /// Uploads items.
    pub fn upload<T: Pod>(&mut self, what: &'static str, items: &[T]) -> Result<PooledBuffer, GpuError> {
        // Uploads overtake work that has not been submitted, and such work may still use the buffer.
        self.hand_in();
        let pooled = self.take::<T>(what, items.len())?;
        if !items.is_empty() {
            self.device.count(|counts| {
                counts.uploads += 1;
                counts.uploaded_bytes += size_of_val(items) as u64;
            });
            self.device.queue.write_buffer(pooled.raw(), 0, bytemuck::cast_slice(items));
        }
        Ok(pooled)
    }

    /// Sets a buffer to 0.
    pub fn clear(&mut self, pooled: &PooledBuffer) {
        self.commands().clear_buffer(pooled.raw(), 0, Some(pooled.bytes));
    }

    /// Copies the first bytes of one buffer to another, from its byte `at` on.
    pub fn copy_to(&mut self, from: &PooledBuffer, to: &PooledBuffer, at: usize, bytes: usize) {
        self.commands().copy_buffer_to_buffer(from.raw(), 0, to.raw(), at as u64, bytes as u64);
    }

    /// The encoder, for a command that is no kernel.
    fn commands(&mut self) -> &mut wgpu::CommandEncoder {
        (self.pass, self.dirty) = (None, true);
        self.device.count(|counts| counts.copies += 1);
        &mut self.encoder
    }

    /// Runs a kernel in so many groups. Binding 0 is its job, the buffers follow.
    pub fn run(
        &mut self,
        kernel: &Kernel,
        blocks: u32,
        job: [u32; 4],
        buffers: &[&PooledBuffer],
        groups: usize,
    ) {
        if groups == 0 {
            return;
        }
        if self.jobs.len() == JOBS {
            self.hand_in();
        }
        let pipeline = self.device.kernel(kernel, blocks);
        let binding = |buffer, offset, size| {
            wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer,
                offset,
                size: wgpu::BufferSize::new(size),
            })
        };
        let at = self.jobs.len() as u64 * JOB_STRIDE;
        let mut entries =
            vec![wgpu::BindGroupEntry { binding: 0, resource: binding(&self.device.arena, at, 16) }];
        for (k, pooled) in buffers.iter().enumerate() {
            let resource = binding(pooled.raw(), 0, pooled.bytes);
            entries.push(wgpu::BindGroupEntry { binding: k as u32 + 1, resource });
        }
        let group = self.device.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(kernel.name),
            layout: &pipeline.get_bind_group_layout(0),
            entries: &entries,
        });
        self.jobs.push(job);
        self.dirty = true;
        self.device.count(|counts| {
            counts.launches += 1;
            counts.bound_bytes += buffers.iter().map(|pooled| pooled.bytes).sum::<u64>();
        });
        let mut clock = lock(&self.device.clock);
        // It times passes.
        if clock.is_some() {
            self.pass = None;
        }
        let (device, encoder) = (self.device, &mut self.encoder);
        let pass = self.pass.get_or_insert_with(|| {
            device.count(|counts| counts.passes += 1);
            let described = wgpu::ComputePassDescriptor {
                label: None,
                timestamp_writes: clock.as_mut().map(|clock| clock.moments_of(kernel.name)),
            };
            encoder.begin_compute_pass(&described).forget_lifetime()
        });
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &group, &[]);
        let [columns, rows] = rows_of(groups);
        pass.dispatch_workgroups(columns, rows, 1);
    }

    /// Submits the recorded kernels to the device, which runs them in this order.
    pub fn hand_in(&mut self) {
        if !self.dirty {
            return;
        }
        let mut bytes = vec![0u8; self.jobs.len() * JOB_STRIDE as usize];
        for (position, job) in bytes.chunks_exact_mut(JOB_STRIDE as usize).zip(&self.jobs) {
            position[..16].copy_from_slice(bytemuck::cast_slice(job));
        }
        if !bytes.is_empty() {
            self.device.queue.write_buffer(&self.device.arena, 0, &bytes);
        }
        self.pass = None;
        self.device.count(|counts| counts.submissions += 1);
        let next = self.device.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let mut encoder = std::mem::replace(&mut self.encoder, next);
        let mut clock = lock(&self.device.clock);
        if let Some(clock) = &*clock {
            clock.close(&mut encoder);
        }
        self.device.queue.submit([encoder.finish()]);
        if let Some(clock) = &mut *clock {
            clock.read(&self.device.device);
        }
        self.jobs.clear();
        self.dirty = false;
    }

    /// Submits, and waits until all is done.
    pub fn wait(&mut self) -> Result<(), GpuError> {
        self.hand_in();
        self.device.count(|counts| counts.waits += 1);
        let polled = self.device.device.poll(wgpu::PollType::wait_indefinitely());
        self.device.check()?;
        polled.map(drop).map_err(|error| self.device.failure(error.to_string()))
    }

    /// Submits, waits, and downloads the first `count` items.
    pub fn read<T: Pod>(&mut self, from: &PooledBuffer, count: usize) -> Result<Vec<T>, GpuError> {
        self.read_at(from, 0, count)
    }

    /// Submits, waits, and downloads `count` items, from item `first` on.
    pub fn read_at<T: Pod>(
        &mut self,
        from: &PooledBuffer,
        first: usize,
        count: usize,
    ) -> Result<Vec<T>, GpuError> {
        let mut out = vec![T::zeroed(); count];
        if count == 0 {
            return Ok(out);
        }
        let bytes = (count * size_of::<T>()) as u64;
        let start = (first * size_of::<T>()) as u64;
        debug_assert!(start + bytes <= from.bytes);
        let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let staging = self.device.pick(&self.device.staging, "read back", bytes, usage)?;
        self.device.count(|counts| counts.downloaded_bytes += bytes);
        self.commands().copy_buffer_to_buffer(from.raw(), start, staging.raw(), 0, bytes);
        self.hand_in();
        let slice = staging.raw().slice(..bytes);
        slice.map_async(wgpu::MapMode::Read, |_| {});
        self.wait()?;
        let view = slice.get_mapped_range().map_err(|error| self.device.failure(error.to_string()))?;
        bytemuck::cast_slice_mut::<T, u8>(&mut out).copy_from_slice(&view);
        drop(view);
        staging.raw().unmap();
        Ok(out)
    }
}
