//! Stopping, in order or at once.

use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;
use tokio_util::sync::CancellationToken;

use crate::lock;

/// How far the shutdown of a system was requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Phase {
    /// It runs.
    Running,
    /// Sources stop; what is under way is finished, actor by actor.
    Draining,
    /// Everybody stops at the next point where the work can be resumed; mailboxes are discarded.
    Stopping,
}

pub(crate) struct Control {
    phase: AtomicU8,
    token: CancellationToken,
    /// Counts changes that somebody may wait for.
    changes: Mutex<u64>,
    changed: Condvar,
}

/// Asks a system to stop; cheap to clone, callable from any thread and from a signal's task.
///
/// ```
/// use segwild_flow::{Phase, Stopper};
/// let stopper = Stopper::new();
/// assert_eq!(stopper.phase(), Phase::Running);
/// stopper.drain();
/// stopper.stop();
/// stopper.drain();
/// assert_eq!(stopper.phase(), Phase::Stopping, "never goes back");
/// ```
#[derive(Clone)]
pub struct Stopper(pub(crate) Arc<Control>);

impl Default for Stopper {
    fn default() -> Self {
        Self::new()
    }
}

impl Stopper {
    /// A stopper, to be handed to a system by its options.
    pub fn new() -> Self {
        Self(Arc::new(Control {
            phase: AtomicU8::new(0),
            token: CancellationToken::new(),
            changes: Mutex::new(0),
            changed: Condvar::new(),
        }))
    }

    /// Sources stop, the rest drains.
    pub fn drain(&self) {
        self.0.raise(Phase::Draining);
    }

    /// Everybody stops at the next point where the work can be resumed.
    pub fn stop(&self) {
        self.0.raise(Phase::Stopping);
    }

    /// The phase that was requested.
    pub fn phase(&self) -> Phase {
        self.0.phase()
    }

    /// Waits until [`Stopper::stop`] was called; for async tasks.
    pub async fn stopped(&self) {
        self.0.token.cancelled().await;
    }
}

impl Control {
    pub fn phase(&self) -> Phase {
        match self.phase.load(Ordering::Acquire) {
            0 => Phase::Running,
            1 => Phase::Draining,
            _ => Phase::Stopping,
        }
    }

    fn raise(&self, phase: Phase) {
        self.phase.fetch_max(phase as u8, Ordering::AcqRel);
        if phase == Phase::Stopping {
            self.token.cancel();
        }
        self.notify();
    }

    /// Wakes everybody who waits here.
    pub fn notify(&self) {
        *lock(&self.changes) += 1;
        self.changed.notify_all();
    }

    /// Waits until `done` or the time is over; returns whether it is done. `done` is checked again after every
    /// change.
    pub fn wait(&self, time: Duration, done: impl Fn() -> bool) -> bool {
        let deadline = Instant::now().checked_add(time);
        let mut changes = lock(&self.changes);
        loop {
            if done() {
                return true;
            }
            let left =
                deadline.map_or(Duration::from_secs(3600), |d| d.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return false;
            }
            changes = self.changed.wait_timeout(changes, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}
