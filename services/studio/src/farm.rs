//! The farm that a server shows: read once for all its viewers.

use segwild_farm::EngineError;
use segwild_flow::lock;
use segwild_monitor::ViewError;
use segwild_monitor::view::{BatchView, FarmTarget};
use std::sync::{Arc, Mutex, TryLockError};
use std::time::{Duration, Instant};

/// For so long a view serves all who request it.
const FRESH: Duration = Duration::from_secs(1);

/// A view of a farm, or why there is none.
type SeenFarm = Result<Arc<BatchView>, Arc<ViewError>>;

/// A farm that a server shows.
pub(crate) struct ServedFarm {
    target: FarmTarget,
    /// Held by who reads it.
    reading: Mutex<()>,
    /// What was read last, and when.
    last: Mutex<Option<(Instant, SeenFarm)>>,
}

impl ServedFarm {
    pub fn new(target: FarmTarget) -> ServedFarm {
        ServedFarm { target, reading: Mutex::default(), last: Mutex::default() }
    }

    /// How it is. While somebody reads it, the others get what was read before: a queue that does not answer is waited for long,
    /// and may not take the threads of those who click.
    ///
    /// # Errors
    /// When the farm cannot be read.
    pub fn view(&self) -> SeenFarm {
        let fresh = || self.seen().filter(|(at, _)| at.elapsed() <= FRESH);
        if let Some((_, seen)) = fresh() {
            return seen;
        }
        let _reader = match (self.reading.try_lock(), self.seen()) {
            (Ok(reader), _) => reader,
            (Err(TryLockError::Poisoned(reader)), _) => reader.into_inner(),
            (Err(TryLockError::WouldBlock), Some((_, seen))) => return seen,
            (Err(TryLockError::WouldBlock), None) => lock(&self.reading),
        };
        // Who waited for the first reader has its answer.
        if let Some((_, seen)) = fresh() {
            return seen;
        }
        let seen = self.target.view().map(Arc::new).map_err(Arc::new);
        *lock(&self.last) = Some((Instant::now(), seen.clone()));
        seen
    }

    fn seen(&self) -> Option<(Instant, SeenFarm)> {
        lock(&self.last).clone()
    }

    /// Lets a scene that was given up try again.
    ///
    /// # Errors
    /// [`EngineError::Unknown`] when no scene of that name was given up; when the farm cannot be read or written.
    pub fn retry(&self, scene: &str) -> Result<(), EngineError> {
        self.target.engine.revive(scene)?;
        // The next view shows it.
        *lock(&self.last) = None;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_farm::{EmbeddedEngine, ErrorClass, Job, JobEngine, Needs, WorkerOffer};
    use segwild_monitor::view::SceneState;

    #[test]
    fn viewers_share_what_one_of_them_read_and_a_retry_is_shown_at_once() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let engine = Arc::new(EmbeddedEngine::open(dir.path().join("jobs.sqlite")).expect("an engine"));
        let farm = ServedFarm::new(FarmTarget { name: "farm".into(), engine: engine.clone() });
        engine.publish(&Job::new("b/dead", "{}", Needs::default())).expect("it is published");
        let lease = engine.claim(&WorkerOffer::all("w", Needs::default(), 60.0)).expect("it answers");
        engine.fail(&lease.expect("a lease"), ErrorClass::Fatal, "bad input").expect("it is held");
        let view = farm.view().expect("a view");
        assert_eq!(view.scenes[0].state, SceneState::Dead);
        // It is fresh, however long this machine makes the test wait.
        *lock(&farm.last) = Some((Instant::now() + 60 * FRESH, Ok(view.clone())));
        assert!(Arc::ptr_eq(&view, &farm.view().expect("a view")), "it is read once");
        // Who comes while another one reads has what was read before, however old that is.
        let old = Instant::now().checked_sub(2 * FRESH).expect("this machine runs for seconds");
        *lock(&farm.last) = Some((old, Ok(view.clone())));
        let reader = lock(&farm.reading);
        assert!(Arc::ptr_eq(&view, &farm.view().expect("a view")), "nobody waits for the reader");
        drop(reader);
        assert!(matches!(farm.retry("b/none"), Err(EngineError::Unknown(_))));
        farm.retry("b/dead").expect("it was given up");
        assert_eq!(farm.view().expect("a view").scenes[0].state, SceneState::Waiting);
    }
}
