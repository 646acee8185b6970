//! The time that leases and retries are measured by.
//!
//! Stored are times of the wall clock: they are for people and for other processes to read. Every change of the store
//! compares how far the wall clock and the steady clock have come since the change before. Where they disagree, the wall
//! clock was set or the machine slept, and every time that is still to come moves along with the wall clock
//! (`embedded.rs`). So a rest lasts as long as it was meant to, whatever the wall clock does.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use segwild_flow::clock::{self, Steady};

/// Tells the time.
pub trait JobClock: Send + Sync {
    /// Seconds since 1970. May jump.
    fn now(&self) -> f64;

    /// A clock that never jumps.
    fn steady(&self) -> Steady;
}

/// The machine's clocks.
#[derive(Clone, Copy, Debug, Default)]
pub struct SystemClock;

impl JobClock for SystemClock {
    fn now(&self) -> f64 {
        clock::now()
    }

    fn steady(&self) -> Steady {
        clock::steady()
    }
}

/// A clock that is set by hand; clones are the same clock.
///
/// ```
/// use segwild_farm::{JobClock, SimulatedClock};
/// let clock = SimulatedClock::new(100.0);
/// clock.clone().pass(2.5);
/// assert_eq!(clock.now(), 102.5);
/// clock.jump(-60.0);
/// assert_eq!((clock.now(), clock.steady().seconds), (42.5, 2.5));
/// ```
#[derive(Clone, Debug)]
pub struct SimulatedClock {
    /// What it showed when it was made, and how far it has been set since, as the bits of an `f64`.
    wall: Arc<AtomicU64>,
    /// The time that has passed.
    passed: Arc<AtomicU64>,
}

impl SimulatedClock {
    /// A clock that shows a time.
    pub fn new(now: f64) -> Self {
        let of = |value: f64| Arc::new(AtomicU64::new(value.to_bits()));
        Self { wall: of(now), passed: of(0.0) }
    }

    /// Lets time pass.
    pub fn pass(&self, seconds: f64) {
        add(&self.passed, seconds);
    }

    /// Sets the wall clock ahead, or back, while no time passes.
    pub fn jump(&self, seconds: f64) {
        add(&self.wall, seconds);
    }
}

fn read(of: &AtomicU64) -> f64 {
    f64::from_bits(of.load(Ordering::Acquire))
}

fn add(to: &AtomicU64, seconds: f64) {
    to.store((read(to) + seconds).to_bits(), Ordering::Release);
}

impl JobClock for SimulatedClock {
    fn now(&self) -> f64 {
        read(&self.wall) + read(&self.passed)
    }

    fn steady(&self) -> Steady {
        Steady { since: "the simulation".into(), seconds: read(&self.passed) }
    }
}
