//! The thread that conducts, watched like the others.

use std::marker::PhantomData;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::System;
use super::shared::SpawnError;
use crate::control::Stopper;
use crate::meter::{self, Pulse, WorkerState};
use crate::report::Exit;
use crate::supervise::{ActorCell, ActorOptions};

/// The calling thread as a member of a system, until it is dropped: it has a heartbeat, a row in the timeline and in
/// reports, and shutdown names it when it is late. Nobody can restart it.
///
/// ```
/// # use segwild_flow::{System, SystemOptions};
/// let system = System::new(SystemOptions::default())?;
/// let me = system.guest("coordinator")?;
/// me.busy("reads the answers");
/// std::thread::sleep(std::time::Duration::from_millis(2)); // long enough for a span
/// me.waits();
/// drop(me);
/// let report = system.join();
/// assert_eq!(report.actors[0].name, "coordinator");
/// assert!(report.timeline.spans.iter().any(|span| span.label == "reads the answers"));
/// # Ok::<_, segwild_flow::SpawnError>(())
/// ```
pub struct Guest {
    cell: Arc<ActorCell>,
    pulse: Arc<Pulse>,
    stopper: Stopper,
    /// It speaks for the thread that it was made on.
    _here: PhantomData<*const ()>,
}

impl System {
    /// Makes the calling thread a member; see [`Guest`]. Drop it before [`System::join`].
    ///
    /// # Errors
    /// When the system is stopping.
    pub fn guest(&self, name: &str) -> Result<Guest, SpawnError> {
        let name: Arc<str> = name.into();
        let mut pulse = Pulse::new(name.clone(), 0, self.shared.timeline.clone());
        pulse.coarse = true;
        let pulse = Arc::new(pulse);
        let options = ActorOptions { vital: false, ..ActorOptions::default() };
        let cell = Arc::new(ActorCell::new(options, vec![pulse.clone()], name, None));
        self.shared.enrol(&cell)?;
        meter::adopt(Some(pulse.clone()));
        Ok(Guest { cell, pulse, stopper: self.stopper(), _here: PhantomData })
    }
}

impl Guest {
    /// It is at work on something; too long without a word is being stuck.
    pub fn busy(&self, label: &str) {
        self.pulse.note_cpu();
        self.pulse.enter(WorkerState::Busy, label);
    }

    /// It waits for something to do.
    pub fn waits(&self) {
        self.pulse.enter(WorkerState::Waiting, "");
    }
}

impl Drop for Guest {
    fn drop(&mut self) {
        meter::adopt(None);
        self.pulse.note_cpu();
        self.pulse.enter(WorkerState::Ended, "");
        self.cell.note_exit(Exit::Finished);
        self.cell.live.fetch_sub(1, Ordering::AcqRel);
        self.stopper.0.notify();
    }
}
