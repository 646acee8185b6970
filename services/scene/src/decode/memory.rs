//! Memory that decoding may take at once, in the whole process.
//!
//! The memory that an image takes is known from its head. Photos are decoded by many threads; a thread that finds the budget
//! used up waits until another is done. An image larger than the budget is decoded alone.

use segwild_files::lock;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Default budget, in bytes.
const DEFAULT: u64 = 1 << 30;

struct DecodingBudget {
    /// Bytes in use, and the budget in bytes.
    state: Mutex<(u64, u64)>,
    freed: Condvar,
}

static BUDGET: DecodingBudget = DecodingBudget { state: Mutex::new((0, DEFAULT)), freed: Condvar::new() };

impl DecodingBudget {
    fn state(&self) -> MutexGuard<'_, (u64, u64)> {
        lock(&self.state)
    }
}

/// Sets how many bytes all decoding of this process may take at once; `None`: as many as at the start, 1 GiB.
///
/// An image that alone takes more is still decoded, while no other is.
pub fn limit_decoding(bytes: Option<u64>) {
    BUDGET.state().1 = bytes.unwrap_or(DEFAULT);
    BUDGET.freed.notify_all();
}

/// Memory of the budget that is held until this is dropped. Its holder must not wait for another thread's decoding.
pub(crate) struct Permit(u64);

/// Waits until the budget has so many bytes left, and takes them.
pub(crate) fn enter(bytes: u64) -> Permit {
    let full = |(used, limit): &mut (u64, u64)| *used > 0 && used.saturating_add(bytes) > *limit;
    let mut state = BUDGET.freed.wait_while(BUDGET.state(), full).unwrap_or_else(PoisonError::into_inner);
    state.0 = state.0.saturating_add(bytes);
    Permit(bytes)
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut state = BUDGET.state();
        state.0 = state.0.saturating_sub(self.0);
        drop(state);
        BUDGET.freed.notify_all();
    }
}
