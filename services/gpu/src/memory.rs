//! What may stay on an accelerator within a budget for everything.

/// Bytes of photos that stay from step to step, unless a budget sets less: least, and most.
pub const LEAST_PHOTOS: u64 = 8 << 20;
const MOST_PHOTOS: u64 = 1 << 30;

/// How many bytes of photos stay on the device within a budget for everything; 0 is none.
pub(crate) fn photo_cache_bytes(budget: u64) -> u64 {
    if budget == 0 { MOST_PHOTOS } else { (budget / 8).clamp(LEAST_PHOTOS, MOST_PHOTOS) }
}

/// Whether channels of so many bytes may stay on the device: they may take a quarter of a budget for everything, so
/// that views fit beside them.
pub(crate) fn channels_fit(bytes: u64, budget: u64) -> bool {
    budget == 0 || bytes <= budget / 4
}

/// Whether features in refinement, or sums over views, may take so many bytes of the device: half of a budget for
/// everything.
pub(crate) fn field_fits(bytes: u64, budget: u64) -> bool {
    budget == 0 || bytes <= budget / 2
}
