//! The farm that a server shows: connected to and read on a thread of its own, once for all its viewers. A queue that does
//! not answer is waited for long; no request does that.

use axum::body::Bytes;
use segwild_farm::EngineError;
use segwild_flow::lock;
use segwild_monitor::view::{BatchView, FarmTarget};
use std::fmt;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, Condvar, Mutex, OnceLock, PoisonError, TryLockError};
use std::time::{Duration, Instant};
use tokio::sync::watch;
use tokio::time::timeout_at;

/// For so long a view serves all who request it.
const FRESH: Duration = Duration::from_secs(1);

/// For so long a request waits for a fresh view, without a thread, before it takes the one that was read last.
const WAITS: Duration = Duration::from_secs(1);

/// Connects to a farm.
type ConnectToFarm = dyn Fn() -> Result<FarmTarget, EngineError> + Send + Sync;

/// A farm that a server shows once it is reached.
#[derive(Clone)]
pub struct FarmSource {
    name: String,
    connect: Arc<ConnectToFarm>,
}

impl FarmSource {
    /// The farm of an address, for people, that is connected to in the background once somebody wants to see it. Where that
    /// fails, it is tried again.
    pub fn new(
        name: impl Into<String>,
        connect: impl Fn() -> Result<FarmTarget, EngineError> + Send + Sync + 'static,
    ) -> FarmSource {
        FarmSource { name: name.into(), connect: Arc::new(connect) }
    }
}

impl From<FarmTarget> for FarmSource {
    fn from(target: FarmTarget) -> FarmSource {
        FarmSource::new(target.name.clone(), move || Ok(target.clone()))
    }
}

impl fmt::Debug for FarmSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FarmSource({})", self.name)
    }
}

/// A farm as it was read.
pub(crate) struct SeenFarm {
    pub view: BatchView,
    /// The view as JSON: with thousands of scenes it is not written for each viewer.
    pub json: Bytes,
}

/// What was read of a farm, or why it cannot be read.
pub(crate) type ReadFarm = Result<Arc<SeenFarm>, Arc<str>>;

/// What was read last.
#[derive(Clone)]
struct FarmReading {
    at: Instant,
    /// How many retries were done before it began.
    retries: u64,
    farm: ReadFarm,
}

impl FarmReading {
    fn is_fresh(&self, retries: u64) -> bool {
        self.retries >= retries && self.at.elapsed() <= FRESH
    }
}

/// What the thread that reads is to do.
#[derive(Default)]
struct ReadOrder {
    /// Whether somebody wants a view.
    wanted: bool,
    /// How many retries were done: a view that was begun before the last one does not show it.
    retries: u64,
    /// Whether nobody wants a view any more.
    ended: bool,
}

struct FarmReader {
    source: FarmSource,
    target: OnceLock<FarmTarget>,
    order: Mutex<ReadOrder>,
    ordered: Condvar,
    last: watch::Sender<Option<FarmReading>>,
    /// Held by the one retry at a time.
    retrying: Mutex<()>,
}

impl FarmReader {
    /// Reads whenever somebody wants a view, until nobody does any more.
    fn run(&self) {
        loop {
            let mut order = lock(&self.order);
            while !order.wanted && !order.ended {
                order = self.ordered.wait(order).unwrap_or_else(PoisonError::into_inner);
            }
            if order.ended {
                return;
            }
            order.wanted = false;
            let retries = order.retries;
            drop(order);
            // Many may have wanted the view that was read meanwhile.
            if !self.last.borrow().as_ref().is_some_and(|last| last.is_fresh(retries)) {
                let farm = catch_unwind(AssertUnwindSafe(|| self.read()));
                let farm = farm.unwrap_or_else(|_| Err("its view could not be made".into()));
                self.last.send_replace(Some(FarmReading { at: Instant::now(), retries, farm }));
            }
        }
    }

    fn read(&self) -> ReadFarm {
        let target = match self.target.get() {
            Some(target) => target,
            None => {
                let reached = (self.source.connect)().map_err(|e| format!("it is not reached: {e}"))?;
                self.target.get_or_init(|| reached)
            }
        };
        let view = target.view().map_err(|e| e.to_string())?;
        let json = serde_json::to_vec(&view).map_err(|e| e.to_string())?;
        Ok(Arc::new(SeenFarm { view, json: json.into() }))
    }

    fn order(&self, change: impl FnOnce(&mut ReadOrder)) {
        change(&mut lock(&self.order));
        self.ordered.notify_all();
    }
}

/// Why a scene is not tried again.
#[derive(Debug, thiserror::Error)]
pub(crate) enum FarmRetryError {
    /// One retry at a time may wait for the farm.
    #[error("the farm is still at another retry; try again in a moment")]
    Busy,
    /// There is no connection yet.
    #[error("the farm {0} is not reached yet; try again in a moment")]
    NotReached(String),
    /// The farm refuses, or does not answer.
    #[error(transparent)]
    Engine(#[from] EngineError),
}

/// A farm that a server shows.
pub(crate) struct ServedFarm(Arc<FarmReader>);

impl ServedFarm {
    pub fn new(source: FarmSource) -> ServedFarm {
        let reader = Arc::new(FarmReader {
            source,
            target: OnceLock::new(),
            order: Mutex::default(),
            ordered: Condvar::new(),
            last: watch::Sender::new(None),
            retrying: Mutex::new(()),
        });
        let reads = reader.clone();
        if let Err(e) = std::thread::Builder::new().name("farm view".into()).spawn(move || reads.run()) {
            let farm = Err(format!("no thread can be started to read it: {e}").into());
            reader.last.send_replace(Some(FarmReading { at: Instant::now(), retries: 0, farm }));
        }
        ServedFarm(reader)
    }

    /// How it is, or was when it was last read: while it does not answer, nobody waits longer than a moment.
    ///
    /// # Errors
    /// Why the farm cannot be read, or that it was not read yet.
    pub async fn view(&self) -> ReadFarm {
        let ServedFarm(reader) = self;
        let (mut last, until) = (reader.last.subscribe(), tokio::time::Instant::now() + WAITS);
        let retries = lock(&reader.order).retries;
        loop {
            let reading = last.borrow_and_update().clone();
            let is_fresh = reading.as_ref().is_some_and(|reading| reading.is_fresh(retries));
            if !is_fresh {
                reader.order(|order| order.wanted = true);
                if matches!(timeout_at(until, last.changed()).await, Ok(Ok(()))) {
                    continue;
                }
            }
            let not_yet = || format!("{} was not read yet: it has not answered so far", reader.source.name);
            return reading.map_or_else(|| Err(not_yet().into()), |reading| reading.farm);
        }
    }

    /// Lets a scene that was given up try again. It waits for the farm.
    ///
    /// # Errors
    /// [`EngineError::Unknown`] when no scene of that name was given up; while another retry waits; when the farm is not
    /// reached, or cannot be read or written.
    pub fn retry(&self, scene: &str) -> Result<(), FarmRetryError> {
        let ServedFarm(reader) = self;
        let _turn = match reader.retrying.try_lock() {
            Ok(turn) => turn,
            Err(TryLockError::Poisoned(turn)) => turn.into_inner(),
            Err(TryLockError::WouldBlock) => return Err(FarmRetryError::Busy),
        };
        let not_reached = || FarmRetryError::NotReached(reader.source.name.clone());
        reader.target.get().ok_or_else(not_reached)?.engine.revive(scene)?;
        // The next view shows it.
        reader.order(|order| order.retries += 1);
        Ok(())
    }
}

impl Drop for ServedFarm {
    fn drop(&mut self) {
        self.0.order(|order| order.ended = true);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_farm::{EmbeddedEngine, ErrorClass, Job, JobEngine, Needs, WorkerOffer};
    use segwild_monitor::view::SceneState;
    use std::sync::mpsc;

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime")
    }

    fn dead_scene(folder: &std::path::Path) -> Arc<EmbeddedEngine> {
        let engine = Arc::new(EmbeddedEngine::open(folder.join("jobs.sqlite")).expect("an engine"));
        engine.publish(&Job::new("b/dead", "{}", Needs::default())).expect("it is published");
        let lease = engine.claim(&WorkerOffer::all("w", Needs::default(), 60.0)).expect("it answers");
        engine.fail(&lease.expect("a lease"), ErrorClass::Fatal, "bad input").expect("it is held");
        engine
    }

    #[test]
    fn viewers_share_what_was_read_and_a_retry_is_shown_at_once() {
        let (dir, runtime) = (tempfile::tempdir().expect("a temporary folder"), runtime());
        let farm = ServedFarm::new(FarmTarget::new("farm", dead_scene(dir.path())).into());
        // A view is not waited for longer than a moment, and a busy machine may take longer to read it.
        let view = || (0..100).find_map(|_| runtime.block_on(farm.view()).ok()).expect("a view");
        let first = view();
        assert_eq!(first.view.scenes[0].state, SceneState::Dead);
        assert_eq!(first.json, serde_json::to_vec(&first.view).expect("JSON"));
        // It is fresh, however long this machine makes the test wait.
        let at = |at: Instant, retries| Some(FarmReading { at, retries, farm: Ok(first.clone()) });
        farm.0.last.send_replace(at(Instant::now() + 60 * FRESH, 0));
        assert!(Arc::ptr_eq(&first, &view()), "it is read once");
        assert!(matches!(farm.retry("b/none"), Err(FarmRetryError::Engine(EngineError::Unknown(_)))));
        farm.retry("b/dead").expect("it was given up");
        let waits = |_| view().view.scenes[0].state == SceneState::Waiting;
        assert!((0..100).any(waits), "a view from before the retry is not fresh");
        let turn = lock(&farm.0.retrying);
        assert!(matches!(farm.retry("b/dead"), Err(FarmRetryError::Busy)));
        drop(turn);
    }

    #[test]
    fn nobody_waits_for_a_farm_that_does_not_answer() {
        let (dir, runtime) = (tempfile::tempdir().expect("a temporary folder"), runtime());
        let engine = dead_scene(dir.path());
        // Connecting ends when the test says how: at first with an error, then with the farm.
        let (answer, answers) = mpsc::channel::<bool>();
        let (answers, refused) = (Mutex::new(answers), dir.path().join("none"));
        let connect = move || match lock(&answers).recv() {
            Ok(true) => Ok(FarmTarget::new("farm", engine.clone())),
            _ => Err(EngineError::Missing { path: refused.clone() }),
        };
        let farm = ServedFarm::new(FarmSource::new("nats://queue/night", connect));
        let error = || runtime.block_on(farm.view()).err().expect("there is no view yet");
        assert!(error().contains("nats://queue/night was not read yet"), "{}", error());
        let retried = farm.retry("b/dead").expect_err("it is not reached").to_string();
        assert!(retried.contains("nats://queue/night is not reached"), "{retried}");
        answer.send(false).expect("it waits");
        assert!(error().contains("it is not reached: "), "{}", error());
        // It is tried again.
        farm.0.last.send_replace(None);
        answer.send(true).expect("it waits");
        let found = (0..100).find_map(|_| runtime.block_on(farm.view()).ok()).expect("a view");
        assert_eq!(found.view.scenes[0].state, SceneState::Dead);
    }
}
