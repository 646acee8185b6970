//! Running sums, and the sort by them: what binning and the sampling of maps stand on.

use crate::GpuError;
use crate::device::{DeviceWork, PooledBuffer};
use crate::groups::GROUP;
use crate::shaders::{HISTOGRAM, SCAN, SCAN_ADD, SCATTER};

/// Numbers that a group of the scan and of the sort holds.
const BLOCK: usize = 1024;
/// Bits of one pass of the radix sort.
const DIGIT: u32 = 4;

/// Replaces numbers by the sum of those before each.
pub(crate) fn scan(work: &mut DeviceWork, data: &PooledBuffer, count: usize) -> Result<(), GpuError> {
    let blocks = count.div_ceil(BLOCK);
    let sums = work.take::<u32>("a running sum", blocks)?;
    let job = [count as u32, 0, 0, 0];
    work.run(&SCAN, 1, job, &[data, &sums], blocks);
    if blocks > 1 {
        scan(work, &sums, blocks)?;
        work.run(&SCAN_ADD, 1, job, &[data, &sums], count.div_ceil(GROUP));
    }
    Ok(())
}

/// Stable radix sort of items by the lowest `bits` of their keys.
pub(crate) fn sort(
    work: &mut DeviceWork,
    keys: PooledBuffer,
    items: PooledBuffer,
    count: usize,
    bits: u32,
) -> Result<(PooledBuffer, PooledBuffer), GpuError> {
    if count == 0 {
        return Ok((keys, items));
    }
    let blocks = count.div_ceil(BLOCK);
    let (mut from, mut to) =
        ((keys, items), (work.take::<u32>("sort keys", count)?, work.take::<u32>("sorted items", count)?));
    let counts = work.take::<u32>("digits", blocks << DIGIT)?;
    for pass in 0..bits.div_ceil(DIGIT) {
        let job = [count as u32, pass * DIGIT, blocks as u32, 0];
        work.run(&HISTOGRAM, 1, job, &[&from.0, &counts], blocks);
        scan(work, &counts, blocks << DIGIT)?;
        work.run(&SCATTER, 1, job, &[&from.0, &from.1, &counts, &to.0, &to.1], blocks);
        std::mem::swap(&mut from, &mut to);
    }
    Ok(from)
}
