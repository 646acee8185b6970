//! One actor under supervision: its lives, its retries, its restarts.

use std::any::Any;
use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU32, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::actor::{Actor, ActorFailure, Context, FailureKind, Idle, Quarantined};
use crate::events::Event;
use crate::fault;
use crate::lock;
use crate::mailbox::{AnyMailbox, Receiver, RecvError};
use crate::message::Message;
use crate::meter::{Pulse, WorkerState};
use crate::report::{ActorReport, Exit, StorageFailure, WorkerStatus};

/// How often an actor may be restarted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RestartBudget {
    /// So many restarts ..
    pub restarts: u32,
    /// .. within so long.
    pub window: Duration,
    /// Pause before the first, doubled for each further one within the window. Attempts at a message are
    /// spaced in the same way.
    pub first_delay: Duration,
    /// The longest pause.
    pub longest_delay: Duration,
}

impl Default for RestartBudget {
    /// 8 restarts a minute, after 100 ms to 10 s.
    fn default() -> Self {
        Self {
            restarts: 8,
            window: Duration::from_secs(60),
            first_delay: Duration::from_millis(100),
            longest_delay: Duration::from_secs(10),
        }
    }
}

impl RestartBudget {
    fn delay(&self, earlier: u32) -> Duration {
        self.first_delay.saturating_mul(2u32.saturating_pow(earlier.min(31))).min(self.longest_delay)
    }
}

/// How an actor is run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActorOptions {
    /// Threads, each with an instance of its own, sharing the mailbox; at least 1. With more than one,
    /// messages may be finished in another order than they were sent in.
    pub workers: usize,
    /// How often a message is tried before it is given up; at least 1.
    pub attempts: u32,
    /// Restarts for failures outside messages (starting, idle work). A message that makes the actor panic
    /// costs a restart too, but is bounded by `attempts` and does not use up the budget.
    pub budget: RestartBudget,
    /// After so many messages in a row were given up (rejected ones aside), the fault is the actor's, not
    /// theirs, and it fails.
    pub given_up_in_a_row: u32,
    /// Whether the failure of this actor stops the system.
    pub vital: bool,
    /// Stack of each thread, in bytes.
    pub stack: usize,
    /// Compute threads of each worker, the worker's own among them; `None`: as many as the system says.
    pub threads: Option<usize>,
}

impl Default for ActorOptions {
    /// One worker, three attempts, 16 in a row, vital, 8 MiB.
    fn default() -> Self {
        Self {
            workers: 1,
            attempts: 3,
            budget: RestartBudget::default(),
            given_up_in_a_row: 16,
            vital: true,
            stack: 8 << 20,
            threads: None,
        }
    }
}

/// An actor as the supervisor sees it.
pub(crate) struct ActorCell {
    pub name: Arc<str>,
    pub options: ActorOptions,
    pub pulses: Vec<Arc<Pulse>>,
    pub mailbox: Option<Arc<dyn AnyMailbox>>,
    /// Workers that have not ended.
    pub live: AtomicUsize,
    exit: Mutex<Option<Exit>>,
    messages: AtomicU64,
    retries: AtomicU64,
    restarts: AtomicU64,
    in_a_row: AtomicU32,
    recent_restarts: Mutex<VecDeque<Instant>>,
    quarantined: Mutex<Vec<Quarantined>>,
}

impl ActorCell {
    pub fn new(
        options: ActorOptions,
        pulses: Vec<Arc<Pulse>>,
        name: Arc<str>,
        mailbox: Option<Arc<dyn AnyMailbox>>,
    ) -> Self {
        Self {
            name,
            options,
            live: AtomicUsize::new(pulses.len()),
            pulses,
            mailbox,
            exit: Mutex::new(None),
            messages: AtomicU64::new(0),
            retries: AtomicU64::new(0),
            restarts: AtomicU64::new(0),
            in_a_row: AtomicU32::new(0),
            recent_restarts: Mutex::default(),
            quarantined: Mutex::default(),
        }
    }

    pub fn ended(&self) -> bool {
        self.live.load(Ordering::Acquire) == 0
    }

    /// Notes how a worker ended; the worst counts.
    pub fn note_exit(&self, exit: Exit) {
        let mut noted = lock(&self.exit);
        if noted.as_ref().is_none_or(|worst| exit > *worst) {
            *noted = Some(exit);
        }
    }

    pub fn report(&self) -> ActorReport {
        let observations: Vec<_> = self.pulses.iter().map(|p| p.observe()).collect();
        let seconds = |state| observations.iter().map(|g| g.seconds(state)).sum();
        ActorReport {
            name: self.name.to_string(),
            exit: lock(&self.exit).clone().filter(|_| self.ended()).unwrap_or(Exit::Running),
            starting_s: seconds(WorkerState::Starting),
            busy_s: seconds(WorkerState::Busy),
            waiting_s: seconds(WorkerState::Waiting),
            blocked_s: seconds(WorkerState::Blocked),
            back_off_s: seconds(WorkerState::BackOff),
            cpu_s: self.pulses.iter().map(|p| p.cpu_seconds()).sum(),
            workers: observations
                .into_iter()
                .map(|g| WorkerStatus {
                    state: g.state,
                    since_s: g.since.elapsed().as_secs_f64(),
                    label: g.label,
                })
                .collect(),
            messages: self.messages.load(Ordering::Relaxed),
            retries: self.retries.load(Ordering::Relaxed),
            restarts: self.restarts.load(Ordering::Relaxed),
            quarantined: lock(&self.quarantined).clone(),
            mailbox: self.mailbox.as_ref().map(|m| m.stats()),
        }
    }

    /// Spends a restart and waits; an exit when there is none left, or the failure allows none.
    pub fn restart(&self, context: &Context, failure: &ActorFailure) -> Option<Exit> {
        match failure.kind {
            FailureKind::Fatal | FailureKind::Storage(_) => return Some(exit_of(failure)),
            // A stop closes the mailboxes: who was held back there has been stopped, too.
            FailureKind::Downstream if !context.stopping() => return Some(Exit::DownstreamClosed),
            FailureKind::Downstream | FailureKind::Stopped => return Some(Exit::Stopped),
            FailureKind::Retry | FailureKind::Reject | FailureKind::Restart => {}
        }
        let budget = &self.options.budget;
        let earlier = {
            let mut recent = lock(&self.recent_restarts);
            while recent.front().is_some_and(|&t| t.elapsed() > budget.window) {
                recent.pop_front();
            }
            if recent.len() >= budget.restarts as usize {
                let window = budget.window.as_secs_f64();
                let spent = format!("{failure} (after {} restarts within {window} s)", recent.len());
                return Some(Exit::Failed(spent));
            }
            recent.push_back(Instant::now());
            recent.len() as u32 - 1
        };
        self.announce_restart(context, failure, budget.delay(earlier))
    }

    fn announce_restart(&self, context: &Context, failure: &ActorFailure, delay: Duration) -> Option<Exit> {
        if context.stopping() {
            return Some(Exit::Stopped);
        }
        let restarts = self.restarts.fetch_add(1, Ordering::Relaxed) + 1;
        tracing::warn!("{} is restarted: {failure}", self.name);
        context.events.tell(Event::ActorRestarted {
            actor: self.name.to_string(),
            worker: context.worker(),
            cause: failure.message.clone(),
            restarts,
            delay_s: delay.as_secs_f64(),
        });
        self.pause(context, delay)
    }

    fn pause(&self, context: &Context, delay: Duration) -> Option<Exit> {
        context.pulse.enter(WorkerState::BackOff, "");
        if context.sleep(delay) { None } else { Some(Exit::Stopped) }
    }
}

/// How an actor ends by a failure.
fn exit_of(failure: &ActorFailure) -> Exit {
    let error = failure.message.clone();
    match failure.refusal() {
        Some(refusal) => Exit::Storage(StorageFailure { error, refusal }),
        None => Exit::Failed(error),
    }
}

/// Words of a panic.
pub(crate) fn panic_words(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied();
    let text = text.or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    format!("panic: {}", text.unwrap_or("without words"))
}

/// Runs a piece of an actor; a panic becomes a failure and `broken`.
fn guard<T>(work: impl FnOnce() -> Result<T, ActorFailure>) -> Result<T, (ActorFailure, bool)> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(failure)) => {
            let broken = failure.kind == FailureKind::Restart;
            Err((failure, broken))
        }
        Err(payload) => Err((ActorFailure::restart(panic_words(&*payload)), true)),
    }
}

/// Work that survives a restart.
enum HeldMessage<M> {
    Retry { message: M, attempt: u32 },
    GivenUp { message: Option<M>, quarantined: Quarantined },
}

enum Life {
    Over(Exit),
    Broken,
}

/// A worker's whole life: instance after instance, until the work is done or cannot be.
pub(crate) fn work<A: Actor>(
    cell: &ActorCell,
    context: &Context,
    inbox: &Receiver<A::Message>,
    factory: &(dyn Fn() -> Result<A, ActorFailure> + Send + Sync),
) -> Exit {
    let mut held = None;
    loop {
        context.pulse.enter(WorkerState::Starting, "");
        let built = guard(|| {
            let _loading = context.busy_zone("start");
            let mut actor = factory()?;
            actor.on_start(context)?;
            Ok(actor)
        });
        let mut actor = match built {
            Ok(actor) => actor,
            Err((failure, _)) => match cell.restart(context, &failure) {
                Some(exit) => return exit,
                None => continue,
            },
        };
        let life = live(&mut actor, cell, context, inbox, &mut held);
        let exit = match life {
            Life::Over(exit @ (Exit::Failed(_) | Exit::Storage(_))) => Some(exit),
            Life::Over(exit) => {
                context.pulse.enter(WorkerState::Busy, "stop");
                Some(match guard(|| actor.on_stop(context)) {
                    Ok(()) => exit,
                    Err((failure, _)) => match failure.kind {
                        FailureKind::Stopped | FailureKind::Downstream => exit,
                        _ => exit_of(&failure),
                    },
                })
            }
            Life::Broken => None,
        };
        // What panicked once may panic again while it is dropped.
        let dropped = guard(|| {
            drop(actor);
            Ok(())
        });
        match (exit, dropped) {
            (Some(exit @ (Exit::Failed(_) | Exit::Storage(_))), _) => return exit,
            (Some(_), Err((failure, _))) => return Exit::Failed(failure.message),
            (Some(exit), Ok(())) => return exit,
            (None, _) => {}
        }
    }
}

fn live<A: Actor>(
    actor: &mut A,
    cell: &ActorCell,
    context: &Context,
    inbox: &Receiver<A::Message>,
    held: &mut Option<HeldMessage<A::Message>>,
) -> Life {
    let mut cpu_noted = Instant::now();
    loop {
        if context.stopping() {
            return Life::Over(Exit::Stopped);
        }
        if cpu_noted.elapsed() > Duration::from_millis(200) {
            cpu_noted = Instant::now();
            context.pulse.note_cpu();
        }
        let outside = |(failure, _): (ActorFailure, bool)| match cell.restart(context, &failure) {
            Some(exit) => Life::Over(exit),
            None => Life::Broken,
        };
        let (message, attempt) = match held.take() {
            Some(HeldMessage::Retry { message, attempt }) => (message, attempt),
            Some(HeldMessage::GivenUp { message, quarantined }) => {
                context.pulse.enter(WorkerState::Busy, &quarantined.label);
                match guard(|| actor.on_quarantine(message, &quarantined, context)) {
                    Ok(()) => continue,
                    Err(caught) => return outside(caught),
                }
            }
            None => match inbox.try_recv() {
                Ok(message) => (message, 1),
                Err(empty) => {
                    context.pulse.enter(WorkerState::Busy, "");
                    match guard(|| actor.on_idle(context)) {
                        Ok(Idle::Again) => continue,
                        Ok(Idle::Wait) if empty == RecvError::Closed => return Life::Over(Exit::Finished),
                        Ok(Idle::Wait) => {
                            context.pulse.enter(WorkerState::Waiting, "");
                            match inbox.blocking_recv() {
                                Some(message) => (message, 1),
                                None => continue,
                            }
                        }
                        Err(caught) => return outside(caught),
                    }
                }
            },
        };
        // A stop that came while this one waited: it is left undone, as the rest of the mailbox is.
        if context.stopping() {
            return Life::Over(Exit::Stopped);
        }
        let (label, copy) = (actor.label(&message), message.again());
        context.pulse.enter(WorkerState::Busy, &label);
        let handled = guard(|| {
            if fault::armed() {
                fault::point(&format!("{}.handle", cell.name))?;
            }
            actor.handle(message, context)
        });
        match handled {
            Ok(()) => {
                cell.messages.fetch_add(1, Ordering::Relaxed);
                cell.in_a_row.store(0, Ordering::Relaxed);
            }
            Err((failure, broken)) => {
                if let Some(life) = after_failure(cell, context, &failure, broken, copy, label, attempt, held)
                {
                    return life;
                }
            }
        }
    }
}

/// Decides what becomes of a message that failed and of the instance that it failed in; `None`: live on.
fn after_failure<M>(
    cell: &ActorCell,
    context: &Context,
    failure: &ActorFailure,
    broken: bool,
    copy: Option<M>,
    label: String,
    attempt: u32,
    held: &mut Option<HeldMessage<M>>,
) -> Option<Life> {
    let over = match failure.kind {
        FailureKind::Downstream if !context.stopping() => Some(Exit::DownstreamClosed),
        FailureKind::Downstream | FailureKind::Stopped => Some(Exit::Stopped),
        FailureKind::Retry | FailureKind::Restart | FailureKind::Storage(_) if context.stopping() => {
            Some(Exit::Stopped)
        }
        _ => None,
    };
    if let Some(exit) = over {
        return Some(Life::Over(exit));
    }
    let again = !matches!(failure.kind, FailureKind::Reject | FailureKind::Fatal);
    let delay = cell.options.budget.delay(attempt - 1);
    match copy {
        Some(message) if again && attempt < cell.options.attempts => {
            cell.retries.fetch_add(1, Ordering::Relaxed);
            *held = Some(HeldMessage::Retry { message, attempt: attempt + 1 });
            if !broken {
                return cell.pause(context, delay).map(Life::Over);
            }
        }
        // What the disk refused is nobody's fault: there is nothing to give up.
        _ if failure.is_storage() => return Some(Life::Over(exit_of(failure))),
        message => {
            let quarantined = Quarantined { label, error: failure.message.clone(), attempts: attempt };
            context.events.tell(Event::GivenUp {
                actor: cell.name.to_string(),
                label: quarantined.label.clone(),
                error: quarantined.error.clone(),
                attempts: attempt,
            });
            lock(&cell.quarantined).push(quarantined.clone());
            if failure.kind == FailureKind::Fatal {
                return Some(Life::Over(exit_of(failure)));
            }
            *held = Some(HeldMessage::GivenUp { message, quarantined });
            if failure.kind != FailureKind::Reject {
                let in_a_row = cell.in_a_row.fetch_add(1, Ordering::Relaxed) + 1;
                if in_a_row >= cell.options.given_up_in_a_row {
                    let error =
                        format!("{in_a_row} messages in a row were given up, the last one: {failure}");
                    return Some(Life::Over(Exit::Failed(error)));
                }
            }
        }
    }
    if broken {
        return Some(match cell.announce_restart(context, failure, delay) {
            Some(exit) => Life::Over(exit),
            None => Life::Broken,
        });
    }
    None
}
