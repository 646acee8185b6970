//! Running sums and the sort.

use crate::sort::{scan, sort};
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
    let (key_buffer, order) = (work.upload("keys", keys)?, work.upload("items", items)?);
    let (_, order) = sort(&mut work, key_buffer, order, items.len(), bits)?;
    work.read(&order, items.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    /// Numbers that a group holds.
    const BLOCK: usize = 1024;

    #[test]
    fn running_sums_go_over_three_levels_of_blocks() {
        for engine in crate::test_adapter::either_way("running_sums_go_over_three_levels_of_blocks") {
            let by = engine.adapter().subgroups;
            for count in [1, 1023, 1024, 1025, BLOCK * BLOCK + 7] {
                let mut random = Random::new(3);
                let numbers: Vec<u32> = (0..count).map(|_| random.below(4) as u32).collect();
                let before = |sum: &mut u32, n: &u32| Some(std::mem::replace(sum, *sum + *n));
                let right: Vec<u32> = numbers.iter().scan(0, before).collect();
                let got = running_sums(engine, &numbers).expect("it runs");
                assert!(got == right, "{count} numbers, by subgroups of {by:?}");
            }
        }
    }

    #[test]
    fn a_running_sum_that_does_not_fit_stays_at_the_largest_number() {
        for engine in
            crate::test_adapter::either_way("a_running_sum_that_does_not_fit_stays_at_the_largest_number")
        {
            let by = engine.adapter().subgroups;
            let sums_of = |numbers: &[u32]| running_sums(engine, numbers).expect("it runs");
            let sums = sums_of(&[1 << 20; 5000]);
            assert_eq!((sums[4095], sums[4096], sums[4999]), (4095 << 20, u32::MAX, u32::MAX), "{by:?}");
            // Inside one block: between the numbers of a thread, and between threads.
            let sums = sums_of(&[u32::MAX - 1, 1, 1, 0, 7, u32::MAX, 0, 0, 1]);
            let most = u32::MAX;
            assert_eq!(sums, [0, most - 1, most, most, most, most, most, most, most], "{by:?}");
            let sums = sums_of(&[0xffff_8001; 1000]);
            assert_eq!((sums[1], sums[2], sums[999]), (0xffff_8001, most, most), "{by:?}");
        }
    }

    #[test]
    fn the_sort_keeps_the_order_of_equal_keys() {
        for engine in crate::test_adapter::either_way("the_sort_keeps_the_order_of_equal_keys") {
            let by = engine.adapter().subgroups;
            for (count, bits) in [(0, 8), (1, 4), (1024, 4), (5000, 13), (70_000, 32)] {
                let mut random = Random::new(count as u64);
                let key = |_| (random.bits() as u32) >> (u32::BITS - bits) & !6;
                let keys: Vec<u32> = (0..count).map(key).collect();
                let mut items: Vec<u32> = (0..count as u32).collect();
                let got = sorted(engine, &keys, &items, bits).expect("it runs");
                items.sort_by_key(|&i| keys[i as usize]);
                assert!(got == items, "{count} items, by subgroups of {by:?}");
            }
        }
    }
}
