//! Writes what a run is doing into its ledger about once a second, for other processes to read.
//!
//! ```
//! use segwild_flow::*;
//! let folder = tempfile::tempdir().unwrap();
//! let ledger = Ledger::open(folder.path().join("run.sqlite")).unwrap();
//! let events = Events::new();
//! let recorder = Recorder::start(&ledger, &events).unwrap();
//! let system = System::new(SystemOptions { events: events.clone(), ..SystemOptions::default() }).unwrap();
//! recorder.watch(system.observer());
//! system.source("photos", ActorOptions::default(), |_| Ok(())).unwrap();
//! let mut stage = events.stage("embed", Some(3));
//! stage.advance(3);
//! system.join();
//! drop(recorder); // the last word stays in the ledger
//! let seen = ledger.live().unwrap().unwrap();
//! assert_eq!((seen.actors[0].name.as_str(), seen.actors[0].exit.as_str()), ("photos", "finished"));
//! assert_eq!((seen.stages[0].done, seen.stages[0].total), (3, Some(3)));
//! ```

use std::collections::BTreeSet;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use crate::cache::Cache;
use crate::clock;
use crate::cpu;
use crate::events::{Event, Events, Sink};
use crate::ledger::{Ledger, LiveActor, LiveMailbox, LiveMetric, LiveSample, LiveStage, LiveWorker};
use crate::lock;
use crate::mailbox::{AnyMailbox, MailboxStats, Receiver};
use crate::message::Message;
use crate::process;
use crate::report::{ActorReport, Exit, StorageFailure};
use crate::system::Observer;

/// Time between two samples.
const EVERY: Duration = Duration::from_secs(1);

#[derive(Default)]
struct WatchedRun {
    observer: Option<Observer>,
    mailboxes: Vec<Arc<dyn AnyMailbox>>,
    cache: Option<Cache>,
    stages: Vec<LiveStage>,
    metrics: Vec<LiveMetric>,
    /// Actors and workers that the supervisor considers stuck.
    stuck: BTreeSet<(String, u32)>,
    ended: bool,
}

#[derive(Default)]
struct RecorderShared {
    watched: Mutex<WatchedRun>,
    changed: Condvar,
}

/// Samples a run until it is dropped; the drop writes the last sample, which stays.
pub struct Recorder {
    shared: Arc<RecorderShared>,
    sink: Option<Sink>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Starts to sample. Stages, rates and measured numbers come from `events`.
    ///
    /// # Errors
    /// When a thread cannot be started.
    pub fn start(ledger: &Ledger, events: &Events) -> std::io::Result<Self> {
        let shared = Arc::new(RecorderShared::default());
        let observed = shared.clone();
        let sink = events.sink("live", move |record| lock(&observed.watched).apply(&record.event))?;
        let (mine, ledger) = (shared.clone(), ledger.clone());
        let thread = thread::Builder::new().name("recorder".into()).spawn(move || record(&mine, &ledger))?;
        Ok(Self { shared, sink: Some(sink), thread: Some(thread) })
    }

    /// Looks at the actors of a system from now on.
    pub fn watch(&self, observer: Observer) {
        lock(&self.shared.watched).observer = Some(observer);
    }

    /// Looks at a mailbox that belongs to no actor.
    pub fn mailbox<M: Message>(&self, inbox: &Receiver<M>) {
        lock(&self.shared.watched).mailboxes.push(inbox.handle());
    }

    /// Looks at what a cache does.
    pub fn cache(&self, cache: &Cache) {
        lock(&self.shared.watched).cache = Some(cache.clone());
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        drop(self.sink.take()); // hands over the events of before
        lock(&self.shared.watched).ended = true;
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            // A recorder that panicked has written that to stderr already.
            let _ = thread.join();
        }
    }
}

impl WatchedRun {
    fn stage(&mut self, name: &str) -> &mut LiveStage {
        let at = self.stages.iter().position(|s| s.stage == name).unwrap_or_else(|| {
            self.stages.push(LiveStage::new(name, None));
            self.stages.len() - 1
        });
        &mut self.stages[at]
    }

    fn apply(&mut self, event: &Event) {
        match event {
            Event::StageStarted { stage, total } => {
                *self.stage(stage) = LiveStage::new(stage, *total);
            }
            Event::StageProgress { stage, part, done, total, rate, eta_s } => {
                let now = self.stage(stage);
                now.part.clone_from(part);
                (now.done, now.total, now.rate, now.eta_s) = (*done, *total, *rate, *eta_s);
            }
            Event::StageFinished { stage, done, .. } => {
                let now = self.stage(stage);
                (now.done, now.rate, now.eta_s) = (*done, 0.0, Some(0.0));
            }
            Event::StageSkipped { stage, .. } => {
                let now = self.stage(stage);
                (now.rate, now.eta_s) = (0.0, Some(0.0));
            }
            Event::StageFailed { stage, .. } => {
                let now = self.stage(stage);
                (now.rate, now.eta_s) = (0.0, None);
            }
            Event::Metric { stage, name, value, step } => {
                let stage = stage.clone().unwrap_or_default();
                self.metrics.retain(|m| m.stage != stage || m.name != *name);
                self.metrics.push(LiveMetric { stage, name: name.clone(), value: *value, step: *step });
            }
            Event::ActorStuck { actor, worker, .. } => {
                self.stuck.insert((actor.clone(), *worker));
            }
            Event::ActorRecovered { actor, worker } => {
                self.stuck.remove(&(actor.clone(), *worker));
            }
            _ => {}
        }
    }

    fn sample(&self) -> LiveSample {
        let now = clock::now();
        let reports = self.observer.as_ref().map(Observer::snapshot).unwrap_or_default();
        let own = reports.iter().filter_map(|a| a.mailbox.clone());
        let mailboxes = own.chain(self.mailboxes.iter().map(|m| m.stats())).map(live_mailbox).collect();
        let usage = process::usage();
        LiveSample {
            time: now,
            pid: std::process::id(),
            began: now,
            moved: now,
            rss_bytes: usage.map(|u| u.rss_bytes),
            peak_rss_bytes: usage.map(|u| u.peak_rss_bytes),
            threads: usage.map(|u| u.threads),
            cpu_s: cpu::process_seconds(),
            cache: self.cache.as_ref().map(Cache::counters).unwrap_or_default(),
            actors: reports.into_iter().map(|report| self.live_actor(report, now)).collect(),
            mailboxes,
            stages: self.stages.clone(),
            metrics: self.metrics.clone(),
        }
    }

    fn live_actor(&self, report: ActorReport, now: f64) -> LiveActor {
        let (exit, error) = match report.exit {
            Exit::Running => ("running", None),
            Exit::Finished => ("finished", None),
            Exit::Stopped => ("stopped", None),
            Exit::DownstreamClosed => ("downstream_closed", None),
            Exit::Failed(error) | Exit::Storage(StorageFailure { error, .. }) => ("failed", Some(error)),
            Exit::Late => ("late", None),
        };
        let worker = |(i, w): (usize, crate::report::WorkerStatus)| LiveWorker {
            state: w.state,
            item: w.label,
            since: now - w.since_s,
            stuck: self.stuck.contains(&(report.name.clone(), i as u32)),
        };
        LiveActor {
            workers: report.workers.into_iter().enumerate().map(worker).collect(),
            exit: exit.into(),
            error,
            messages: report.messages,
            retries: report.retries,
            restarts: report.restarts,
            quarantined: report.quarantined.len() as u64,
            last_error: report.quarantined.last().map(|q| format!("{}: {}", q.label, q.error)),
            starting_s: report.starting_s,
            busy_s: report.busy_s,
            waiting_s: report.waiting_s,
            blocked_s: report.blocked_s,
            back_off_s: report.back_off_s,
            cpu_s: report.cpu_s,
            name: report.name,
        }
    }
}

fn live_mailbox(m: MailboxStats) -> LiveMailbox {
    LiveMailbox {
        name: m.name,
        depth: m.depth as u64,
        bytes: m.bytes as u64,
        capacity: m.capacity as u64,
        capacity_bytes: m.capacity_bytes as u64,
        high_water: m.high_water as u64,
        high_water_bytes: m.high_water_bytes as u64,
        sent: m.sent,
        received: m.received,
        held_back: m.held_back,
        waiting_senders: m.waiting_senders as u64,
        back_pressure_s: m.back_pressure_s,
        closed: m.closed,
    }
}

fn record(shared: &RecorderShared, ledger: &Ledger) {
    let began = Instant::now();
    let (mut moved, mut seen) = (began, None);
    let mut past_every = EVERY;
    let mut past_at: Option<Instant> = None;
    loop {
        let (mut sample, ended) = {
            let watched = lock(&shared.watched);
            (watched.sample(), watched.ended)
        };
        let movement = sample.movement();
        if seen.is_some_and(|before| before != movement) {
            moved = Instant::now();
        }
        seen = Some(movement);
        // Time that passed, dated by the wall clock of this moment: a clock that jumps makes nobody look stuck.
        sample.began = sample.time - began.elapsed().as_secs_f64();
        sample.moved = sample.time - moved.elapsed().as_secs_f64();
        let past = ended || past_at.is_none_or(|at| at.elapsed() >= past_every);
        let written = ledger.record_live(&sample, past).and_then(|()| {
            if past && ledger.thin_past()? {
                past_every *= 2;
            }
            Ok(())
        });
        // The run matters more than the view of it; it meets the same disk, and says so itself.
        if let Err(error) = written {
            tracing::warn!("the live view could not be written: {error}");
        }
        if past {
            past_at = Some(Instant::now());
        }
        if ended {
            return;
        }
        let watched = lock(&shared.watched);
        let waited = shared.changed.wait_timeout_while(watched, EVERY, |w| !w.ended);
        drop(waited.unwrap_or_else(PoisonError::into_inner));
    }
}
