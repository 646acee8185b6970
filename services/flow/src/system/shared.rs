//! What the threads of a system share: how it is run, and its actors.

use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::control::{Control, Stopper};
use crate::events::Events;
use crate::lock;
use crate::supervise::ActorCell;
use crate::timeline::Timeline;

/// How a system is run.
#[derive(Clone)]
pub struct SystemOptions {
    /// Where events are sent.
    pub events: Events,
    /// Who stops it.
    pub stopper: Stopper,
    /// A worker without a sign of progress for so long is reported as stuck.
    pub stuck_after: Duration,
    /// A drain may take so long before everybody is stopped.
    pub drain: Duration,
    /// A stop may take so long before those who still run are left behind.
    pub grace: Duration,
    /// How often shutdown names who it waits for.
    pub name_late_every: Duration,
    /// Spans the timeline keeps.
    pub timeline: usize,
    /// Compute threads of each worker, for the kernels that it calls; 0 takes all cores.
    pub threads: usize,
}

impl Default for SystemOptions {
    /// Stuck after 60 s; 5 minutes to drain, 30 s to stop, names every 5 s; 50,000 spans; all cores.
    fn default() -> Self {
        Self {
            events: Events::new(),
            stopper: Stopper::new(),
            stuck_after: Duration::from_secs(60),
            drain: Duration::from_secs(300),
            grace: Duration::from_secs(30),
            name_late_every: Duration::from_secs(5),
            timeline: 50_000,
            threads: 0,
        }
    }
}

/// An actor could not be started.
#[derive(Debug, thiserror::Error)]
#[error("cannot start `{actor}`: {source}")]
pub struct SpawnError {
    /// For whom.
    pub actor: String,
    /// The operating system's error; interrupted when the system is stopping.
    pub source: std::io::Error,
}

impl SpawnError {
    /// Whether nothing is wrong but that a stop of the system was requested before.
    pub fn is_stopping(&self) -> bool {
        self.source.kind() == std::io::ErrorKind::Interrupted
    }
}

pub(super) struct SystemShared {
    pub(super) options: SystemOptions,
    pub(super) began: Instant,
    pub(super) timeline: Timeline,
    pub(super) roster: Mutex<Roster>,
    pub(super) threads: Mutex<Vec<(Arc<ActorCell>, JoinHandle<()>)>>,
    /// Nothing more will be spawned: the end of all actors is the end.
    pub(super) complete: AtomicBool,
}

#[derive(Default)]
pub(super) struct Roster {
    cells: Vec<Arc<ActorCell>>,
    /// Shutdown has started: nobody joins any more, or the newcomer would be forgotten.
    sealed: bool,
}

impl SystemShared {
    pub(super) fn control(&self) -> &Control {
        &self.options.stopper.0
    }

    pub(super) fn cells(&self) -> Vec<Arc<ActorCell>> {
        lock(&self.roster).cells.clone()
    }

    pub(super) fn seal(&self) -> Vec<Arc<ActorCell>> {
        let mut roster = lock(&self.roster);
        roster.sealed = true;
        roster.cells.clone()
    }

    /// Adds an actor to the roster, if it is not sealed.
    pub(super) fn enrol(&self, cell: &Arc<ActorCell>) -> Result<(), SpawnError> {
        let mut roster = lock(&self.roster);
        if roster.sealed {
            let words = "the system is stopping";
            let source = std::io::Error::new(std::io::ErrorKind::Interrupted, words);
            return Err(SpawnError { actor: cell.name.to_string(), source });
        }
        roster.cells.push(cell.clone());
        Ok(())
    }
}
