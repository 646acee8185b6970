//! Who is stuck: a worker that is busy and gives no sign of life.

use std::sync::atomic::Ordering;
use std::time::Instant;

use super::shared::SystemShared;
use crate::events::Event;
use crate::meter::WorkerState;

/// What the supervisor remembers of each worker.
#[derive(Default)]
pub(super) struct Watch(Vec<Vec<LastBeat>>);

#[derive(Clone)]
struct LastBeat {
    beat: u64,
    at: Instant,
    stuck: bool,
}

impl Watch {
    /// Compares every worker's beat with the last one seen, and reports who got stuck and who moves again.
    pub fn check(&mut self, shared: &SystemShared) {
        let now = Instant::now();
        let cells = shared.cells();
        self.0.resize(cells.len(), Vec::new());
        for (cell, seen) in cells.iter().zip(&mut self.0) {
            seen.resize(cell.pulses.len(), LastBeat { beat: u64::MAX, at: now, stuck: false });
            for (pulse, seen) in cell.pulses.iter().zip(seen) {
                let observe = pulse.observe();
                let moves = observe.beat != seen.beat
                    || observe.state != WorkerState::Busy
                    || pulse.zones.load(Ordering::Acquire) > 0;
                if moves {
                    if seen.stuck {
                        let actor = cell.name.to_string();
                        shared.options.events.tell(Event::ActorRecovered { actor, worker: pulse.worker });
                    }
                    *seen = LastBeat { beat: observe.beat, at: now, stuck: false };
                } else if !seen.stuck && now - seen.at >= shared.options.stuck_after {
                    seen.stuck = true;
                    shared.options.events.tell(Event::ActorStuck {
                        actor: cell.name.to_string(),
                        worker: pulse.worker,
                        label: observe.label,
                        seconds: (now - seen.at).as_secs_f64(),
                    });
                }
            }
        }
    }
}
