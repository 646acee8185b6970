//! What a worker thread is doing: its state, its times, its heartbeat.

use std::cell::RefCell;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::cpu;
use crate::lock;
use crate::timeline::{SpanKind, Timeline};

/// What a worker is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WorkerState {
    /// Being built: loading a model, compiling.
    Starting,
    /// Waiting for a message.
    Waiting,
    /// Handling a message, or working between messages.
    Busy,
    /// Waiting for space in another mailbox, or for another's result.
    Blocked,
    /// Waiting before a restart or another attempt.
    BackOff,
    /// Gone.
    Ended,
}

const STATES: usize = 6;

struct Current {
    state: WorkerState,
    label: String,
    since: Instant,
    spent: [Duration; STATES],
}

/// One worker's state, shared with the supervisor.
pub(crate) struct Pulse {
    pub actor: Arc<str>,
    pub worker: u32,
    timeline: Timeline,
    /// Whether the timeline keeps only spans that are long enough to see: a thread that receives thousands of short
    /// messages would fill it.
    pub coarse: bool,
    current: Mutex<Current>,
    /// Counts signs of progress.
    beat: AtomicU64,
    /// How many busy zones the worker is in.
    pub zones: AtomicU32,
    cpu_us: AtomicU64,
}

/// What the supervisor reads of a worker.
pub(crate) struct WorkerObservation {
    pub state: WorkerState,
    pub label: String,
    pub since: Instant,
    pub spent: [Duration; STATES],
    pub beat: u64,
}

impl WorkerObservation {
    pub fn seconds(&self, state: WorkerState) -> f64 {
        self.spent[state as usize].as_secs_f64()
    }
}

impl Pulse {
    pub fn new(actor: Arc<str>, worker: u32, timeline: Timeline) -> Self {
        let current = Current {
            state: WorkerState::Starting,
            label: String::new(),
            since: Instant::now(),
            spent: [Duration::ZERO; STATES],
        };
        Self {
            actor,
            worker,
            timeline,
            coarse: false,
            current: Mutex::new(current),
            beat: AtomicU64::new(0),
            zones: AtomicU32::new(0),
            cpu_us: AtomicU64::new(0),
        }
    }

    /// Ends one state and starts another, or goes on in the same; their times add up to the thread's life.
    pub fn enter(&self, state: WorkerState, label: &str) -> (WorkerState, String) {
        self.progress();
        let now = Instant::now();
        let mut current = lock(&self.current);
        let (old, since) = (current.state, current.since);
        if old == state && current.label == label {
            return (old, current.label.clone());
        }
        current.spent[old as usize] += now - since;
        let old_label = std::mem::replace(&mut current.label, label.to_string());
        current.state = state;
        current.since = now;
        drop(current);
        // The moment between two messages is too short for a span.
        if old == WorkerState::Busy && old_label.is_empty() && now - since < Duration::from_micros(100) {
            return (old, old_label);
        }
        if self.coarse && (old != WorkerState::Busy || now - since < Duration::from_millis(1)) {
            return (old, old_label);
        }
        let kind = match old {
            WorkerState::Starting => SpanKind::Start,
            WorkerState::Waiting => SpanKind::Wait,
            WorkerState::Busy => SpanKind::Busy,
            WorkerState::Blocked => SpanKind::Blocked,
            WorkerState::BackOff => SpanKind::BackOff,
            WorkerState::Ended => return (old, old_label),
        };
        self.timeline.record(&self.actor, self.worker, &old_label, since, now, kind);
        (old, old_label)
    }

    pub fn progress(&self) {
        self.beat.fetch_add(1, Ordering::Relaxed);
    }

    /// Notes the calling thread's processor time; the worker calls it now and then.
    pub fn note_cpu(&self) {
        if let Some(seconds) = cpu::thread_seconds() {
            self.cpu_us.store((seconds * 1e6) as u64, Ordering::Relaxed);
        }
    }

    pub fn cpu_seconds(&self) -> f64 {
        self.cpu_us.load(Ordering::Relaxed) as f64 * 1e-6
    }

    pub fn span(&self, label: &str, since: Instant) {
        self.timeline.record(&self.actor, self.worker, label, since, Instant::now(), SpanKind::Step);
    }

    pub fn observe(&self) -> WorkerObservation {
        let current = lock(&self.current);
        let mut spent = current.spent;
        if current.state != WorkerState::Ended {
            spent[current.state as usize] += current.since.elapsed();
        }
        WorkerObservation {
            state: current.state,
            label: current.label.clone(),
            since: current.since,
            spent,
            beat: self.beat.load(Ordering::Relaxed),
        }
    }
}

thread_local! {
    static PULSE: RefCell<Option<Arc<Pulse>>> = const { RefCell::new(None) };
}

/// Makes a worker's pulse the calling thread's.
pub(crate) fn adopt(pulse: Option<Arc<Pulse>>) {
    PULSE.with_borrow_mut(|current| *current = pulse);
}

/// While it lives, the calling worker counts as blocked.
pub struct WaitingFor {
    pulse: Arc<Pulse>,
    before: (WorkerState, String),
}

/// Says that the calling worker waits for `what`: space in a mailbox, or a result that another actor makes. The
/// timeline then shows the wait and names it. `None` on a thread that is no worker.
pub fn waiting_for(what: &str) -> Option<WaitingFor> {
    PULSE.with_borrow(|current| {
        let pulse = current.clone()?;
        let before = pulse.enter(WorkerState::Blocked, what);
        Some(WaitingFor { pulse, before })
    })
}

/// A sign of life of the calling worker, from code that has no [`Context`](crate::Context); nothing on a thread that is no
/// worker.
pub fn sign_of_life() {
    PULSE.with_borrow(|current| current.iter().for_each(|pulse| pulse.progress()));
}

impl Drop for WaitingFor {
    fn drop(&mut self) {
        self.pulse.enter(self.before.0, &self.before.1);
    }
}
