//! What happens, as events for every listener: progress bars, `--json`, the ledger.
//!
//! Sending never blocks a worker. Each listener has a queue of its own; when it falls behind, progress and
//! metrics are dropped first (the next ones say the same better), and only a listener that has stopped reading
//! loses the rest, counted.
//!
//! ```
//! use segwild_flow::{Event, Events};
//! let events = Events::new();
//! let listener = events.subscribe();
//! let mut stage = events.stage("masks", Some(2));
//! stage.advance(2);
//! stage.finish();
//! let events: Vec<_> = std::iter::from_fn(|| listener.try_next()).map(|r| r.event).collect();
//! assert!(matches!(&events[0], Event::StageStarted { stage, total: Some(2) } if stage == "masks"));
//! assert!(matches!(events.last(), Some(Event::StageFinished { done: 2, .. })));
//! ```

use std::collections::VecDeque;
use std::io::Write;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use crate::clock::now;
use crate::lock;

/// How much a message matters.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EventLevel {
    /// For the curious.
    Detail,
    /// For everybody.
    Info,
    /// Something is not as it should be; the work goes on.
    Warning,
    /// Something failed.
    Error,
}

/// What happened. As JSON: one object, `{"event": "stage_progress", "stage": "masks", ..}`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// A stage starts.
    StageStarted {
        /// The stage.
        stage: String,
        /// How many units of work it has, if that is known.
        total: Option<u64>,
    },
    /// A stage has come further.
    StageProgress {
        /// The stage.
        stage: String,
        /// The part of the stage that the units are of, where it has parts with units of their own.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        part: Option<String>,
        /// Units of work done, failed and found ones included.
        done: u64,
        /// Units of work in all, if known.
        total: Option<u64>,
        /// Units per second, lately.
        rate: f64,
        /// Seconds to go, if that is known.
        eta_s: Option<f64>,
    },
    /// A stage is done.
    StageFinished {
        /// The stage.
        stage: String,
        /// Units of work done.
        done: u64,
        /// Units of work that failed.
        failed: u64,
        /// Units of work that were in the cache.
        cached: u64,
        /// How long it took, in seconds.
        wall_s: f64,
        /// Processor seconds of the whole process meanwhile, if the system reports it.
        cpu_s: Option<f64>,
    },
    /// A stage was done before under the same key.
    StageSkipped {
        /// The stage.
        stage: String,
        /// Its key.
        key: String,
    },
    /// A stage could not be done.
    StageFailed {
        /// The stage.
        stage: String,
        /// Why.
        error: String,
    },
    /// An actor gave up a message. Its sender is informed as well, and reports what that means for the photo or the stage.
    GivenUp {
        /// The actor.
        actor: String,
        /// The message's label.
        label: String,
        /// Why its last attempt failed.
        error: String,
        /// How often it was tried.
        attempts: u32,
    },
    /// One view's work failed for good; the rest goes on.
    ViewFailed {
        /// The stage or actor.
        stage: String,
        /// The view.
        view: String,
        /// Why.
        error: String,
        /// How often it was tried.
        attempts: u32,
    },
    /// An actor was restarted.
    ActorRestarted {
        /// The actor.
        actor: String,
        /// Which of its workers.
        worker: u32,
        /// Why.
        cause: String,
        /// How many restarts the actor has had.
        restarts: u64,
        /// How long it waits first, in seconds.
        delay_s: f64,
    },
    /// An actor has ended with an error.
    ActorFailed {
        /// The actor.
        actor: String,
        /// Why.
        error: String,
    },
    /// A worker shows no progress.
    ActorStuck {
        /// The actor.
        actor: String,
        /// Which of its workers.
        worker: u32,
        /// What it is working on.
        label: String,
        /// For how long, in seconds.
        seconds: f64,
    },
    /// A worker that was stuck moves again.
    ActorRecovered {
        /// The actor.
        actor: String,
        /// Which of its workers.
        worker: u32,
    },
    /// Shutdown waits for these.
    ShutdownWaits {
        /// The actors that still run.
        actors: Vec<String>,
        /// Seconds until the deadline.
        left_s: f64,
    },
    /// Something the user should know.
    Warning {
        /// The stage it is about.
        stage: Option<String>,
        /// A sentence.
        message: String,
    },
    /// A measured number.
    Metric {
        /// The stage it is about.
        stage: Option<String>,
        /// Its name, with the unit: `loss`, `psnr_db`, `splats`.
        name: String,
        /// The number.
        value: f64,
        /// Where on the stage's own scale (a step, an iteration).
        step: Option<u64>,
    },
    /// Anything else.
    Message {
        /// How much it matters.
        level: EventLevel,
        /// The stage it is about.
        stage: Option<String>,
        /// A sentence.
        message: String,
    },
}

impl Event {
    /// The stage or actor it is about.
    pub fn stage(&self) -> Option<&str> {
        use Event::*;
        match self {
            StageStarted { stage, .. }
            | StageProgress { stage, .. }
            | StageFinished { stage, .. }
            | StageSkipped { stage, .. }
            | StageFailed { stage, .. }
            | ViewFailed { stage, .. } => Some(stage),
            GivenUp { actor, .. }
            | ActorRestarted { actor, .. }
            | ActorFailed { actor, .. }
            | ActorStuck { actor, .. }
            | ActorRecovered { actor, .. } => Some(actor),
            ShutdownWaits { .. } => None,
            Warning { stage, .. } | Metric { stage, .. } | Message { stage, .. } => stage.as_deref(),
        }
    }

    /// How much it matters.
    pub fn level(&self) -> EventLevel {
        use Event::*;
        match self {
            StageProgress { .. } | GivenUp { .. } | Metric { .. } => EventLevel::Detail,
            StageStarted { .. } | StageFinished { .. } | StageSkipped { .. } | ActorRecovered { .. } => {
                EventLevel::Info
            }
            ViewFailed { .. }
            | ActorRestarted { .. }
            | ActorStuck { .. }
            | ShutdownWaits { .. }
            | Warning { .. } => EventLevel::Warning,
            StageFailed { .. } | ActorFailed { .. } => EventLevel::Error,
            Message { level, .. } => *level,
        }
    }

    /// Whether a later one makes it worthless.
    fn is_passing(&self) -> bool {
        matches!(self, Event::StageProgress { .. } | Event::Metric { .. })
    }
}

/// An event and its time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EventRecord {
    /// Seconds since 1970.
    pub time: f64,
    /// What happened.
    #[serde(flatten)]
    pub event: Event,
}

/// Passing events wait in a queue up to this length, the others up to the second one.
const PASSING_LIMIT: usize = 1024;
const HARD_LIMIT: usize = 65_536;

#[derive(Default)]
struct Backlog {
    records: VecDeque<Arc<EventRecord>>,
    dropped: u64,
    closed: bool,
}

#[derive(Default)]
struct EventQueue {
    backlog: Mutex<Backlog>,
    arrived: Condvar,
}

impl EventQueue {
    fn push(&self, record: &Arc<EventRecord>) {
        let mut backlog = lock(&self.backlog);
        if backlog.closed {
            return;
        }
        let length = backlog.records.len();
        if record.event.is_passing() && length >= PASSING_LIMIT {
            backlog.dropped += 1;
            return;
        }
        if length >= HARD_LIMIT {
            backlog.records.pop_front();
            backlog.dropped += 1;
        }
        backlog.records.push_back(record.clone());
        drop(backlog);
        self.arrived.notify_one();
    }

    fn close(&self) {
        lock(&self.backlog).closed = true;
        self.arrived.notify_all();
    }

    /// The next record; waits until there is one, the queue is closed, or the deadline.
    fn next(&self, deadline: Option<Instant>) -> Option<Arc<EventRecord>> {
        let mut backlog = lock(&self.backlog);
        loop {
            if let Some(record) = backlog.records.pop_front() {
                return Some(record);
            }
            if backlog.closed {
                return None;
            }
            backlog = match deadline {
                None => self.arrived.wait(backlog).unwrap_or_else(PoisonError::into_inner),
                Some(deadline) => {
                    let left = deadline.saturating_duration_since(Instant::now());
                    if left.is_zero() {
                        return None;
                    }
                    self.arrived.wait_timeout(backlog, left).unwrap_or_else(PoisonError::into_inner).0
                }
            };
        }
    }
}

#[derive(Default)]
struct Hub {
    queues: Mutex<Vec<Arc<EventQueue>>>,
}

impl Drop for Hub {
    fn drop(&mut self) {
        lock(&self.queues).iter().for_each(|queue| queue.close());
    }
}

/// Where events are sent; clones have the same listeners.
#[derive(Clone, Default)]
pub struct Events(Arc<Hub>);

impl Events {
    /// One without listeners: sending costs next to nothing.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sends an event to all listeners. Never blocks on one.
    pub fn tell(&self, event: Event) {
        let queues = lock(&self.0.queues);
        if queues.is_empty() {
            return;
        }
        let record = Arc::new(EventRecord { time: now(), event });
        queues.iter().for_each(|queue| queue.push(&record));
    }

    /// Sends a warning.
    pub fn warn(&self, stage: Option<&str>, message: impl Into<String>) {
        self.tell(Event::Warning { stage: stage.map(Into::into), message: message.into() });
    }

    /// Sends a message of the level [`EventLevel::Info`].
    pub fn info(&self, stage: Option<&str>, message: impl Into<String>) {
        self.tell(Event::Message {
            level: EventLevel::Info,
            stage: stage.map(Into::into),
            message: message.into(),
        });
    }

    /// Sends a measured number.
    pub fn metric(&self, stage: &str, name: &str, value: f64, step: Option<u64>) {
        self.tell(Event::Metric { stage: Some(stage.into()), name: name.into(), value, step });
    }

    /// Listens to all events from now on.
    pub fn subscribe(&self) -> Subscription {
        let queue = Arc::new(EventQueue::default());
        lock(&self.0.queues).push(queue.clone());
        Subscription { hub: Arc::downgrade(&self.0), queue }
    }

    /// Hands every event to a function on a thread of its own, until the sink is closed.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn sink(
        &self,
        name: &str,
        mut take: impl FnMut(&EventRecord) + Send + 'static,
    ) -> std::io::Result<Sink> {
        let subscription = self.subscribe();
        let queue = subscription.queue.clone();
        let body = move || {
            while let Some(record) = subscription.queue.next(None) {
                take(&record);
            }
        };
        let thread = thread::Builder::new().name(format!("sink {name}")).spawn(body)?;
        Ok(Sink { queue, thread: Some(thread) })
    }

    /// Writes every event as one line of JSON. When the reader has gone (a broken pipe), it falls silent.
    ///
    /// # Errors
    /// When no thread can be started.
    pub fn json_lines(&self, mut out: impl Write + Send + 'static) -> std::io::Result<Sink> {
        let mut gone = false;
        self.sink("json", move |record| {
            if !gone {
                let line = serde_json::to_string(record).unwrap_or_default();
                gone = writeln!(out, "{line}").and_then(|()| out.flush()).is_err();
            }
        })
    }
}

/// A listener's queue. Dropping it ends listening.
pub struct Subscription {
    hub: std::sync::Weak<Hub>,
    queue: Arc<EventQueue>,
}

impl Subscription {
    /// The next event, if there is one now.
    pub fn try_next(&self) -> Option<EventRecord> {
        lock(&self.queue.backlog).records.pop_front().map(|record| (*record).clone())
    }

    /// The next event; `None` when nobody can tell any more.
    pub fn next(&self) -> Option<EventRecord> {
        self.queue.next(None).map(|record| (*record).clone())
    }

    /// The next event, if it comes within a time.
    pub fn next_within(&self, time: Duration) -> Option<EventRecord> {
        self.queue.next(Instant::now().checked_add(time)).map(|record| (*record).clone())
    }

    /// How many events were dropped because this listener was behind.
    pub fn dropped(&self) -> u64 {
        lock(&self.queue.backlog).dropped
    }
}

impl Drop for Subscription {
    fn drop(&mut self) {
        self.queue.close();
        if let Some(hub) = self.hub.upgrade() {
            lock(&hub.queues).retain(|queue| !Arc::ptr_eq(queue, &self.queue));
        }
    }
}

/// A running sink. Dropping it hands over the events of before, then ends its thread.
pub struct Sink {
    queue: Arc<EventQueue>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Sink {
    fn drop(&mut self) {
        self.queue.close();
        if let Some(thread) = self.thread.take() {
            // A sink that panicked has written that to stderr already.
            let _ = thread.join();
        }
    }
}
