//! What the device can do at most: a copy, and a kernel that only multiplies and adds.

use super::device_passes::DevicePasses;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::shaders::MULTIPLY_ADD;
use crate::{GpuEngine, GpuError};

/// Threads of the kernel, and turns of each; a turn is 16 operations.
const THREADS: usize = 1 << 20;
const TURNS: u32 = 256;
const PER_TURN: f64 = 16.0;
/// Longest array that is copied, in bytes.
const COPY: u64 = 256 << 20;

/// The two passes.
pub struct RatePasses<'e> {
    work: DeviceWork<'e>,
    from: PooledBuffer,
    to: PooledBuffer,
    bytes: usize,
    sums: PooledBuffer,
}

impl<'e> RatePasses<'e> {
    /// Operations of [`RatePasses::multiply_add`].
    pub const OPERATIONS: f64 = THREADS as f64 * TURNS as f64 * PER_TURN;

    /// Allocates their memory.
    ///
    /// # Errors
    /// When it does not fit.
    pub fn new(engine: &'e GpuEngine) -> Result<RatePasses<'e>, GpuError> {
        let mut work = engine.device.work();
        let bytes = engine.adapter().binding.min(COPY) as usize / 16 * 16;
        let (from, to) = (work.take::<u8>("a copy's source", bytes)?, work.take::<u8>("a copy", bytes)?);
        let sums = work.take::<f32>("sums", THREADS)?;
        work.clear(&from);
        Ok(RatePasses { work, from, to, bytes, sums })
    }

    /// Copies an array.
    ///
    /// # Errors
    /// None by itself.
    pub fn copy(&mut self) -> Result<(), GpuError> {
        self.work.copy_to(&self.from, &self.to, 0, self.bytes);
        Ok(())
    }

    /// Bytes that a copy reads and writes.
    pub fn moved(&self) -> f64 {
        2.0 * self.bytes as f64
    }

    /// Multiplies and adds.
    ///
    /// # Errors
    /// None by itself.
    pub fn multiply_add(&mut self) -> Result<(), GpuError> {
        self.work.run(&MULTIPLY_ADD, 1, [THREADS as u32, TURNS, 0, 0], &[&self.sums], THREADS / GROUP);
        Ok(())
    }
}

impl DevicePasses for RatePasses<'_> {
    fn wait(&mut self) -> Result<(), GpuError> {
        self.work.wait()
    }
}
