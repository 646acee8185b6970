//! Checks running sums and the sort against known results.

use crate::kernel_check::KernelCheck;
use crate::mismatch::Mismatch;
use segwild_gpu::probe::{running_sums, sorted};
use segwild_gpu::{GpuEngine, GpuError};
use segwild_raster::RasterError;
use segwild_scene::Random;

/// Compares running sums and the sort.
pub fn check_sums(engine: &GpuEngine) -> Result<Vec<KernelCheck>, RasterError> {
    let checked = |kernels, off: Result<(), Mismatch>| KernelCheck { kernels, off: off.err() };
    Ok(vec![
        // Over three levels of blocks.
        checked(&["scan", "scan_add"], sums(engine, (1 << 20) + 7)?),
        checked(&["histogram", "scatter"], sort(engine, 70_000, u32::BITS)?),
    ])
}

/// Running sums of so many numbers.
fn sums(engine: &GpuEngine, count: usize) -> Result<Result<(), Mismatch>, GpuError> {
    let mut random = Random::new(3);
    let numbers: Vec<u32> = (0..count).map(|_| random.below(4) as u32).collect();
    let before = |sum: &mut u32, n: &u32| Some(std::mem::replace(sum, *sum + *n));
    Ok(equal("running sums", &running_sums(engine, &numbers)?, numbers.iter().scan(0, before)))
}

/// So many items sorted by keys of so many bits, of which many are equal.
fn sort(engine: &GpuEngine, count: usize, bits: u32) -> Result<Result<(), Mismatch>, GpuError> {
    let mut random = Random::new(count as u64);
    let keys: Vec<u32> = (0..count).map(|_| (random.bits() as u32) >> (u32::BITS - bits) & !6).collect();
    let mut items: Vec<u32> = (0..count as u32).collect();
    let order = sorted(engine, &keys, &items, bits)?;
    items.sort_by_key(|&i| keys[i as usize]);
    Ok(equal("sorted items", &order, items.into_iter()))
}

fn equal(what: &str, got: &[u32], wanted: impl Iterator<Item = u32>) -> Result<(), Mismatch> {
    match got.iter().zip(wanted).enumerate().find(|(_, (g, w))| **g != *w) {
        Some((index, (&got, wanted))) => Err(Mismatch::Integer { what: what.into(), index, got, wanted }),
        None => Ok(()),
    }
}
