//! The system: spawns actors, watches them, stops them in order.
//!
//! Spawn actors in the order in which the data flows, sources first: a drain goes through them in that order.
//!
//! ```
//! use segwild_flow::*;
//! struct Count(u64);
//! impl Actor for Count {
//!     type Message = u64;
//!     fn handle(&mut self, n: u64, context: &Context) -> Result<(), ActorFailure> {
//!         let _span = context.span("add");
//!         self.0 += n;
//!         Ok(())
//!     }
//!     fn on_stop(&mut self, _: &Context) -> Result<(), ActorFailure> {
//!         assert_eq!(self.0, 45);
//!         Ok(())
//!     }
//! }
//! let system = System::new(SystemOptions::default()).unwrap();
//! let (numbers, inbox) = mailbox("count", Limits { count: 2, bytes: 1 << 20 });
//! system.source("numbers", ActorOptions::default(), move |context| {
//!     for n in 0..10u64 {
//!         context.check()?;
//!         numbers.blocking_send(n)?; // waits when `count` is behind
//!     }
//!     Ok(())
//! }).unwrap();
//! system.spawn(inbox, ActorOptions::default(), || Ok(Count(0))).unwrap();
//! let report = system.join();
//! assert!(report.finished(), "{report}");
//! ```

mod guest;
mod shared;
mod shutdown;
mod watch;

pub use guest::Guest;
pub use shared::{SpawnError, SystemOptions};

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Instant;

use shared::SystemShared;

use crate::actor::{Actor, ActorFailure, Context};
use crate::compute;
use crate::control::Stopper;
use crate::events::Event;
use crate::lock;
use crate::mailbox::Receiver;
use crate::meter::{self, Pulse, WorkerState};
use crate::report::{ActorReport, Exit, Report, StorageFailure};
use crate::supervise::{ActorCell, ActorOptions, panic_words, work};
use crate::timeline::Timeline;

/// Actors, their supervisor and their timeline. Dropped without [`System::join`], it stops them without waiting.
pub struct System {
    shared: Arc<SystemShared>,
    supervisor: Option<JoinHandle<()>>,
}

impl System {
    /// Starts a system without actors.
    ///
    /// # Errors
    /// When the supervisor's thread cannot be started.
    pub fn new(options: SystemOptions) -> Result<Self, SpawnError> {
        let shared = Arc::new(SystemShared {
            timeline: Timeline::new(options.timeline),
            options,
            began: Instant::now(),
            roster: Mutex::default(),
            threads: Mutex::default(),
            complete: AtomicBool::new(false),
        });
        let watched = shared.clone();
        let supervisor = thread::Builder::new()
            .name("supervisor".into())
            .spawn(move || shutdown::supervise(&watched))
            .map_err(|source| SpawnError { actor: "supervisor".into(), source })?;
        Ok(Self { shared, supervisor: Some(supervisor) })
    }

    /// Runs an actor, named as its mailbox, on `options.workers` threads. The factory builds an instance on
    /// each thread, and again after a panic; what the factory holds (senders) is dropped when the actor ends.
    ///
    /// # Errors
    /// When a thread cannot be started, or the system is stopping.
    pub fn spawn<A: Actor>(
        &self,
        inbox: Receiver<A::Message>,
        options: ActorOptions,
        factory: impl Fn() -> Result<A, ActorFailure> + Send + Sync + 'static,
    ) -> Result<(), SpawnError> {
        let name = inbox.name().clone();
        let factory = Arc::new(factory);
        let mailbox = inbox.handle();
        self.start(name, options, Some(mailbox), move || {
            let (inbox, factory) = (inbox.clone(), factory.clone());
            Box::new(move |cell: &ActorCell, context: &Context| work::<A>(cell, context, &inbox, &*factory))
        })
    }

    /// Runs a source: a function on a thread of its own that sends until it has no more, or
    /// [`Context::stopping`]. A failure or a panic runs it again, within the restart budget.
    ///
    /// # Errors
    /// When the thread cannot be started, or the system is stopping.
    pub fn source(
        &self,
        name: &str,
        options: ActorOptions,
        body: impl FnMut(&Context) -> Result<(), ActorFailure> + Send + 'static,
    ) -> Result<(), SpawnError> {
        let mut body = Some(body);
        let options = ActorOptions { workers: 1, ..options };
        self.start(name.into(), options, None, move || {
            let mut body = body.take();
            Box::new(move |cell: &ActorCell, context: &Context| run_source(cell, context, body.as_mut()))
        })
    }

    fn start(
        &self,
        name: Arc<str>,
        options: ActorOptions,
        mailbox: Option<Arc<dyn crate::mailbox::AnyMailbox>>,
        mut worker: impl FnMut() -> Body,
    ) -> Result<(), SpawnError> {
        let options =
            ActorOptions { workers: options.workers.max(1), attempts: options.attempts.max(1), ..options };
        let source = mailbox.is_none();
        let pulses: Vec<_> = (0..options.workers as u32)
            .map(|i| Arc::new(Pulse::new(name.clone(), i, self.shared.timeline.clone())))
            .collect();
        let cell = Arc::new(ActorCell::new(options, pulses.clone(), name.clone(), mailbox));
        self.shared.enrol(&cell)?;
        for (i, pulse) in pulses.into_iter().enumerate() {
            let context = Context {
                pulse,
                stopper: self.shared.options.stopper.clone(),
                events: self.shared.options.events.clone(),
                source,
            };
            let body = worker();
            let mine = cell.clone();
            let title = if options.workers > 1 { format!("{name} {i}") } else { name.to_string() };
            let threads = options.threads.unwrap_or(self.shared.options.threads);
            let life = {
                let title = title.clone();
                move || compute::within(&title, threads, options.stack, || run_worker(&mine, context, body))
            };
            let thread = thread::Builder::new().name(title).spawn(life);
            match thread {
                Ok(thread) => lock(&self.shared.threads).push((cell.clone(), thread)),
                Err(error) => {
                    // The workers that did start serve on; if there is none, the actor has ended.
                    cell.live.fetch_sub(options.workers - i, Ordering::AcqRel);
                    cell.note_exit(Exit::Failed(error.to_string()));
                    return Err(SpawnError { actor: name.to_string(), source: error });
                }
            }
        }
        Ok(())
    }

    /// Who can stop it.
    pub fn stopper(&self) -> Stopper {
        self.shared.options.stopper.clone()
    }

    /// How the actors fare now.
    pub fn snapshot(&self) -> Vec<ActorReport> {
        self.observer().snapshot()
    }

    /// An observer of the actors, valid also after [`System::join`] has taken the system.
    pub fn observer(&self) -> Observer {
        Observer(self.shared.clone())
    }

    /// The timeline so far.
    pub fn timeline(&self) -> Timeline {
        self.shared.timeline.clone()
    }

    /// How the actors fare now, and who did what when.
    pub fn report(&self) -> Report {
        Report {
            actors: self.snapshot(),
            phase: self.shared.control().phase(),
            wall_s: self.shared.began.elapsed().as_secs_f64(),
            timeline: self.shared.timeline.snapshot(),
        }
    }

    /// Waits until every actor has ended: by itself when nobody sends to it any more, or as the stopper asks.
    /// An actor that does not end in time is left behind and reported as late.
    pub fn join(mut self) -> Report {
        self.shared.complete.store(true, Ordering::Release);
        self.shared.control().notify();
        if let Some(supervisor) = self.supervisor.take() {
            // The supervisor catches nothing because it runs no foreign code.
            let _ = supervisor.join();
        }
        for (cell, thread) in lock(&self.shared.threads).drain(..) {
            if cell.ended() {
                let _ = thread.join();
            }
        }
        let mut report = self.report();
        for actor in report.actors.iter_mut().filter(|actor| actor.exit == Exit::Running) {
            actor.exit = Exit::Late;
        }
        report
    }

    /// Stops the sources, drains the rest in order, and waits; see [`System::join`].
    pub fn shutdown(self) -> Report {
        self.shared.options.stopper.drain();
        self.join()
    }
}

impl Drop for System {
    fn drop(&mut self) {
        if self.supervisor.is_some() {
            self.shared.complete.store(true, Ordering::Release);
            self.shared.options.stopper.stop();
        }
    }
}

/// See [`System::observer`].
#[derive(Clone)]
pub struct Observer(Arc<SystemShared>);

impl Observer {
    /// How the actors fare now.
    pub fn snapshot(&self) -> Vec<ActorReport> {
        self.0.cells().iter().map(|cell| cell.report()).collect()
    }
}

/// What a worker's thread runs.
type Body = Box<dyn FnMut(&ActorCell, &Context) -> Exit + Send>;

fn run_worker(cell: &Arc<ActorCell>, context: Context, mut body: Body) {
    meter::adopt(Some(context.pulse.clone()));
    let exit = catch_unwind(AssertUnwindSafe(|| body(cell, &context)))
        .unwrap_or_else(|payload| Exit::Failed(panic_words(&*payload)));
    // Senders and the inbox go before the end is announced: who waits for them is freed first.
    let dropped = catch_unwind(AssertUnwindSafe(move || drop(body)));
    let exit = match dropped {
        Ok(()) => exit,
        Err(payload) => exit.max(Exit::Failed(panic_words(&*payload))),
    };
    meter::adopt(None);
    context.pulse.note_cpu();
    context.pulse.enter(WorkerState::Ended, "");
    if let Exit::Failed(error) | Exit::Storage(StorageFailure { error, .. }) = &exit {
        // The event is sent below; this line is for the log.
        tracing::warn!("{} failed: {error}", cell.name);
        context.events.tell(Event::ActorFailed { actor: cell.name.to_string(), error: error.clone() });
        if cell.options.vital {
            context.stopper.stop();
        }
    }
    cell.note_exit(exit);
    cell.live.fetch_sub(1, Ordering::AcqRel);
    context.stopper.0.notify();
}

fn run_source(
    cell: &ActorCell,
    context: &Context,
    body: Option<&mut (impl FnMut(&Context) -> Result<(), ActorFailure> + Send)>,
) -> Exit {
    let Some(body) = body else { return Exit::Finished };
    loop {
        context.pulse.enter(WorkerState::Busy, "");
        let failure = match catch_unwind(AssertUnwindSafe(|| body(context))) {
            Ok(Ok(())) if context.stopping() => return Exit::Stopped,
            Ok(Ok(())) => return Exit::Finished,
            Ok(Err(failure)) => failure,
            Err(payload) => ActorFailure::restart(panic_words(&*payload)),
        };
        if let Some(exit) = cell.restart(context, &failure) {
            return exit;
        }
    }
}
