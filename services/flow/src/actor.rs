//! Actors: plain structs on compute threads of their own, one message at a time.
//!
//! ```
//! use segwild_flow::*;
//! use std::sync::Arc;
//!
//! #[derive(Clone)]
//! struct Photo { name: Arc<str>, pixels: Arc<Vec<u8>> }
//! impl Message for Photo {
//!     fn bytes(&self) -> usize { self.pixels.len() }
//!     fn label(&self) -> String { self.name.to_string() }
//!     fn again(&self) -> Option<Self> { Some(self.clone()) }
//! }
//!
//! /// Sums pixels and sends the sum on.
//! struct Sum { out: Sender<u64> }
//! impl Actor for Sum {
//!     type Message = Photo;
//!     fn handle(&mut self, photo: Photo, _: &Context) -> Result<(), ActorFailure> {
//!         if photo.pixels.is_empty() {
//!             return Err(ActorFailure::reject("the photo is empty"));
//!         }
//!         self.out.blocking_send(photo.pixels.iter().map(|&p| u64::from(p)).sum())?;
//!         Ok(())
//!     }
//! }
//!
//! let system = System::new(SystemOptions::default()).unwrap();
//! let (photos, inbox) = mailbox::<Photo>("sum", Limits::default());
//! let (out, sums) = mailbox::<u64>("sums", Limits::default());
//! system.spawn(inbox, ActorOptions::default(), move || Ok(Sum { out: out.clone() })).unwrap();
//! for (name, pixels) in [("a.jpg", vec![1, 2, 3]), ("b.jpg", vec![])] {
//!     photos.blocking_send(Photo { name: name.into(), pixels: Arc::new(pixels) }).unwrap();
//! }
//! drop(photos); // nobody sends any more: the actor finishes what is queued, and ends
//! assert_eq!(sums.blocking_recv(), Some(6));
//! assert_eq!(sums.blocking_recv(), None);
//! let report = system.join();
//! let sum = report.actor("sum").unwrap();
//! assert_eq!(sum.exit, Exit::Finished);
//! assert_eq!(sum.quarantined[0].label, "b.jpg");
//! ```

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::control::{Phase, Stopper};
use crate::events::Events;
use crate::mailbox::Closed;
use crate::message::Message;
use crate::meter::Pulse;
use crate::refusal::SystemRefusal;

/// What to do when there is no message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Idle {
    /// Wait for one.
    Wait,
    /// There is work between messages (a training step): look into the mailbox and call again.
    Again,
}

/// A message that was given up.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Quarantined {
    /// The message's label: the view's name.
    pub label: String,
    /// Why its last attempt failed.
    pub error: String,
    /// How often it was tried.
    pub attempts: u32,
}

/// A stage of the dataflow. It lives on one thread, built there by its factory, and needs neither `Send` nor
/// locks.
pub trait Actor: Sized + 'static {
    /// What it is sent.
    type Message: Message;

    /// Called once before the first message.
    ///
    /// # Errors
    /// Counts against the restart budget.
    fn on_start(&mut self, _: &Context) -> Result<(), ActorFailure> {
        Ok(())
    }

    /// What the timeline, a stuck worker and a message that was given up are called by; the message's own label, unless
    /// the actor knows better what its numbers stand for.
    fn label(&self, message: &Self::Message) -> String {
        message.label()
    }

    /// Handles a message. Long work calls [`Context::progress`] and checks [`Context::stopping`].
    ///
    /// # Errors
    /// The failure's kind says what happens next: see [`ActorFailure`].
    fn handle(&mut self, message: Self::Message, context: &Context) -> Result<(), ActorFailure>;

    /// Called when the mailbox is empty. A closed mailbox ends the actor once this says [`Idle::Wait`].
    ///
    /// # Errors
    /// Counts against the restart budget.
    fn on_idle(&mut self, _: &Context) -> Result<Idle, ActorFailure> {
        Ok(Idle::Wait)
    }

    /// Called when a message was given up, so that whoever waits for its result can be informed. `message` is
    /// there when [`Message::again`] made a copy.
    ///
    /// # Errors
    /// Counts against the restart budget.
    fn on_quarantine(
        &mut self,
        _message: Option<Self::Message>,
        _: &Quarantined,
        _: &Context,
    ) -> Result<(), ActorFailure> {
        Ok(())
    }

    /// Called before the actor ends in order (finished, stopped, or its consumer gone): the point for a last
    /// checkpoint.
    ///
    /// # Errors
    /// The actor then counts as failed.
    fn on_stop(&mut self, _: &Context) -> Result<(), ActorFailure> {
        Ok(())
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum FailureKind {
    Retry,
    Reject,
    Restart,
    Storage(SystemRefusal),
    Fatal,
    Downstream,
    Stopped,
}

/// Why an actor could not do its work, and what follows. Any error becomes one by `?` and means
/// [`ActorFailure::retry`], but for two: with [`Closed`], a consumer that has gone, the actor ends quietly; and an error of
/// the disk or the system is [`ActorFailure::storage`], by what [`SystemRefusal::of`] finds in it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ActorFailure {
    pub(crate) kind: FailureKind,
    pub(crate) message: String,
}

impl ActorFailure {
    fn new(kind: FailureKind, error: impl fmt::Display) -> Self {
        Self { kind, message: error.to_string() }
    }

    /// Try the message again; after the last attempt it is quarantined and the rest goes on.
    pub fn retry(error: impl fmt::Display) -> Self {
        Self::new(FailureKind::Retry, error)
    }

    /// The message itself is bad: quarantine it without another attempt.
    pub fn reject(error: impl fmt::Display) -> Self {
        Self::new(FailureKind::Reject, error)
    }

    /// This actor's state is not to be trusted: build it again, then try the message again.
    pub fn restart(error: impl fmt::Display) -> Self {
        Self::new(FailureKind::Restart, error)
    }

    /// The disk or the system refuses: no fault of the message, which is tried again but never given up. After the last
    /// attempt the actor ends as [`Exit::Storage`](crate::Exit::Storage), and with it, by default, the run.
    pub fn storage(error: impl std::error::Error + 'static) -> Self {
        let refusal = SystemRefusal::of(&error).unwrap_or(SystemRefusal::Disk);
        Self::new(FailureKind::Storage(refusal), error)
    }

    /// Nothing will help: the actor ends as failed, and with it, by default, the run.
    pub fn fatal(error: impl fmt::Display) -> Self {
        Self::new(FailureKind::Fatal, error)
    }

    /// The work was left because [`Context::stopping`] was true; it can be resumed.
    pub fn stopped() -> Self {
        Self::new(FailureKind::Stopped, "stopped")
    }

    /// Whether the disk or the system is at fault: see [`ActorFailure::storage`].
    pub fn is_storage(&self) -> bool {
        self.refusal().is_some()
    }

    /// What refused the work, where the disk or the system is at fault.
    pub fn refusal(&self) -> Option<SystemRefusal> {
        match self.kind {
            FailureKind::Storage(refusal) => Some(refusal),
            _ => None,
        }
    }

    /// Whether it is about this one message: others may fare better. Not so of what is fatal, of the disk, of a stop.
    pub fn is_local(&self) -> bool {
        matches!(self.kind, FailureKind::Retry | FailureKind::Reject | FailureKind::Restart)
    }
}

/// The error's words.
impl fmt::Display for ActorFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl<E: std::error::Error + Send + Sync + 'static> From<E> for ActorFailure {
    fn from(error: E) -> Self {
        let first = &error as &(dyn std::error::Error + 'static);
        let kind = if first.is::<Closed>() {
            FailureKind::Downstream
        } else {
            SystemRefusal::of(first).map_or(FailureKind::Retry, FailureKind::Storage)
        };
        Self::new(kind, error)
    }
}

/// An actor's surroundings; usable from the threads it hands work to.
pub struct Context {
    pub(crate) pulse: Arc<Pulse>,
    pub(crate) stopper: Stopper,
    pub(crate) events: Events,
    pub(crate) source: bool,
}

impl Context {
    /// The actor's name.
    pub fn name(&self) -> &str {
        &self.pulse.actor
    }

    /// Which of the actor's workers this is, from 0.
    pub fn worker(&self) -> u32 {
        self.pulse.worker
    }

    /// Whether to leave the work at the next point where it can be resumed: a source does as soon as
    /// the system drains, others when it stops at once. Costs one atomic read.
    pub fn stopping(&self) -> bool {
        self.stopper.phase() >= if self.source { Phase::Draining } else { Phase::Stopping }
    }

    /// [`ActorFailure::stopped`] once [`Context::stopping`]: `context.check()?` in a loop.
    ///
    /// # Errors
    /// When [`Context::stopping`].
    pub fn check(&self) -> Result<(), ActorFailure> {
        if self.stopping() { Err(ActorFailure::stopped()) } else { Ok(()) }
    }

    /// Waits, but no longer than until [`Context::stopping`]; returns whether it waited to the end.
    pub fn sleep(&self, time: Duration) -> bool {
        !self.stopper.0.wait(time, || self.stopping())
    }

    /// A sign of life: long work calls it now and then, or it is reported as stuck.
    pub fn progress(&self) {
        self.pulse.progress();
    }

    /// While the guard lives, silence is not taken for being stuck: loading a model, compiling.
    pub fn busy_zone(&self, label: &str) -> BusyZone<'_> {
        self.pulse.zones.fetch_add(1, Ordering::AcqRel);
        BusyZone { _span: self.span(label), context: self }
    }

    /// Records a named part of the work in the timeline, until the guard is dropped.
    pub fn span(&self, label: &str) -> SpanGuard<'_> {
        SpanGuard { pulse: &self.pulse, label: label.into(), since: Instant::now() }
    }

    /// Where events are sent.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// The system's stopper.
    pub fn stopper(&self) -> &Stopper {
        &self.stopper
    }
}

/// See [`Context::busy_zone`].
pub struct BusyZone<'a> {
    _span: SpanGuard<'a>,
    context: &'a Context,
}

impl Drop for BusyZone<'_> {
    fn drop(&mut self) {
        self.context.progress();
        self.context.pulse.zones.fetch_sub(1, Ordering::AcqRel);
    }
}

/// See [`Context::span`].
pub struct SpanGuard<'a> {
    pulse: &'a Pulse,
    label: String,
    since: Instant,
}

impl Drop for SpanGuard<'_> {
    fn drop(&mut self) {
        self.pulse.span(&self.label, self.since);
    }
}
