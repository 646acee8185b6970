//! Running sums and the sort.

use crate::engine::{scan, sort};
use crate::{GpuEngine, GpuError};

/// For each number the sum of those before it; sums that do not fit stay at the largest number.
///
/// # Errors
/// When the device refuses or fails.
pub fn running_sums(engine: &GpuEngine, numbers: &[u32]) -> Result<Vec<u32>, GpuError> {
    let mut work = engine.device.work();
    let data = work.upload("numbers", numbers)?;
    scan(&mut work, &data, numbers.len())?;
    work.read(&data, numbers.len())
}

/// The items in the order of the lowest `bits` of their keys; items of equal keys keep their order.
///
/// # Errors
/// When the device refuses or fails.
pub fn sorted(engine: &GpuEngine, keys: &[u32], items: &[u32], bits: u32) -> Result<Vec<u32>, GpuError> {
    let mut work = engine.device.work();
    let (held, order) = (work.upload("keys", keys)?, work.upload("items", items)?);
    let (_, order) = sort(&mut work, held, order, items.len(), bits)?;
    work.read(&order, items.len())
}
