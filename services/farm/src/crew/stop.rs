//! How a stop of a batch is requested.

use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

use segwild_flow::lock;

/// How far a stop of a batch is requested.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum StopLevel {
    /// It runs.
    Run,
    /// No further scenes; those that run stop where they can go on.
    Stop,
    /// Their processes are ended; what they have committed stays.
    AtOnce,
}

/// Requests the stop of a batch; clones are of the same one. Levels only rise.
///
/// ```
/// use segwild_farm::{StopBatch, StopLevel};
/// let stop = StopBatch::default();
/// stop.raise(StopLevel::AtOnce);
/// stop.clone().raise(StopLevel::Stop);
/// assert_eq!(stop.level(), StopLevel::AtOnce);
/// ```
#[derive(Clone)]
pub struct StopBatch(Arc<(Mutex<StopLevel>, Condvar)>);

impl Default for StopBatch {
    fn default() -> Self {
        Self(Arc::new((Mutex::new(StopLevel::Run), Condvar::new())))
    }
}

impl StopBatch {
    /// Requests at least this level.
    pub fn raise(&self, level: StopLevel) {
        let mut now = lock(&self.0.0);
        *now = level.max(*now);
        self.0.1.notify_all();
    }

    /// The level that was requested.
    pub fn level(&self) -> StopLevel {
        *lock(&self.0.0)
    }

    /// Waits so long, but no longer than until more is requested.
    pub(crate) fn wait(&self, time: Duration) {
        let level = lock(&self.0.0);
        let before = *level;
        // A panic elsewhere leaves the level whole.
        drop(self.0.1.wait_timeout_while(level, time, |now| *now == before));
    }
}
