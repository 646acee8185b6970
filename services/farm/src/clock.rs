//! The time that leases and retries are measured by.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

/// Tells the time.
pub trait Clock: Send + Sync {
    /// Seconds since 1970. Leases are shared between processes, so this is no monotonic clock: when it jumps
    /// ahead, leases expire early and the fence keeps the work single; when it jumps back, they last longer.
    fn now(&self) -> f64;
}

/// The machine's clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemClock;

impl Clock for SystemClock {
    fn now(&self) -> f64 {
        SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
    }
}

/// A clock that is set by hand; clones are the same clock.
///
/// ```
/// use segwild_farm::{Clock, SimulatedClock};
/// let clock = SimulatedClock::new(100.0);
/// clock.clone().pass(2.5);
/// assert_eq!(clock.now(), 102.5);
/// ```
#[derive(Clone, Debug)]
pub struct SimulatedClock(Arc<AtomicU64>);

impl SimulatedClock {
    /// A clock that shows a time.
    pub fn new(now: f64) -> Self {
        Self(Arc::new(AtomicU64::new(now.to_bits())))
    }

    /// Lets time pass; negative seconds set it back.
    pub fn pass(&self, seconds: f64) {
        self.0.store((self.now() + seconds).to_bits(), Ordering::Release);
    }
}

impl Clock for SimulatedClock {
    fn now(&self) -> f64 {
        f64::from_bits(self.0.load(Ordering::Acquire))
    }
}
