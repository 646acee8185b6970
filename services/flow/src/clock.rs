//! The wall clock, for records only: it may jump, so nothing that matters is decided by it. Durations and deadlines
//! go by the monotonic clock.

use std::time::{SystemTime, UNIX_EPOCH};

use crate::fault;

/// Seconds since 1970.
pub(crate) fn now() -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64());
    now + fault::clock_jump()
}
