//! Memory that decoding may take at once, in the whole process.
//!
//! What a picture takes is known from its head. Photos are decoded by many threads; who finds no room waits until another is
//! done. A picture larger than the room is decoded alone.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Bytes where nobody says otherwise.
const DEFAULT: u64 = 1 << 30;

struct Room {
    /// Bytes in use, and bytes there are.
    state: Mutex<(u64, u64)>,
    freed: Condvar,
}

static ROOM: Room = Room { state: Mutex::new((0, DEFAULT)), freed: Condvar::new() };

impl Room {
    fn state(&self) -> MutexGuard<'_, (u64, u64)> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Sets how many bytes all decoding of this process may take at once; `None`: as many as at the start, 1 GiB.
///
/// A picture that alone takes more is still decoded, while no other is.
pub fn limit_decoding(bytes: Option<u64>) {
    ROOM.state().1 = bytes.unwrap_or(DEFAULT);
    ROOM.freed.notify_all();
}

/// Room that is held until this is dropped. Whoever holds it must not wait for another thread's decoding.
pub(crate) struct Permit(u64);

/// Waits for room.
pub(crate) fn enter(bytes: u64) -> Permit {
    let full = |(used, limit): &mut (u64, u64)| *used > 0 && used.saturating_add(bytes) > *limit;
    let mut state = ROOM.freed.wait_while(ROOM.state(), full).unwrap_or_else(PoisonError::into_inner);
    state.0 = state.0.saturating_add(bytes);
    Permit(bytes)
}

impl Drop for Permit {
    fn drop(&mut self) {
        let mut state = ROOM.state();
        state.0 = state.0.saturating_sub(self.0);
        drop(state);
        ROOM.freed.notify_all();
    }
}
