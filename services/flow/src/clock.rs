//! The two clocks. The wall clock is for records and for people: it may jump, so nothing that matters is decided by it.
//! Durations and deadlines go by the steady clock.

use std::sync::OnceLock;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use crate::fault;

/// The wall clock: seconds since 1970.
pub fn now() -> f64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64());
    now + fault::clock_jump()
}

/// A reading of the steady clock.
#[derive(Clone, Debug, PartialEq)]
pub struct Steady {
    /// Since when it has been running: readings of different ones have nothing to do with each other.
    pub since: String,
    /// Seconds since then.
    pub seconds: f64,
}

/// The steady clock: it cannot be set, and stands still while the machine sleeps. On Linux all processes between two
/// starts of the machine share one; elsewhere each has its own.
///
/// ```
/// use segwild_flow::clock::steady;
/// let (before, after) = (steady(), steady());
/// assert!(before.since == after.since && before.seconds <= after.seconds);
/// ```
pub fn steady() -> Steady {
    static SINCE: OnceLock<(String, Instant)> = OnceLock::new();
    let (since, began) = SINCE.get_or_init(|| {
        let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id");
        let shared = boot.ok().filter(|_| cfg!(target_os = "linux"));
        let own = || format!("process {} at {}", std::process::id(), now());
        (shared.map_or_else(own, |boot| boot.trim().to_owned()), Instant::now())
    });
    #[cfg(target_os = "linux")]
    if !since.starts_with("process") {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
        return Steady { since: since.clone(), seconds: time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9 };
    }
    Steady { since: since.clone(), seconds: began.elapsed().as_secs_f64() }
}
