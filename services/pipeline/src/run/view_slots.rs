//! Slots in which one actor leaves per-view results that another actor waits for.

use segwild_flow::{lock, waiting_for};
use std::collections::BTreeMap;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// One slot per view, filled once; readers wait. The trainer waits here for the sky of its photos, so that what it
/// computes does not depend on how fast the sky was found.
pub struct ViewSlots<T> {
    /// What the slots hold, in words: the timeline of a waiting actor shows it.
    what: &'static str,
    slots: Mutex<BTreeMap<usize, T>>,
    filled: Condvar,
}

impl<T: Clone> ViewSlots<T> {
    /// Empty slots; `what` says what they will hold.
    pub fn new(what: &'static str) -> ViewSlots<T> {
        ViewSlots { what, slots: Mutex::new(BTreeMap::new()), filled: Condvar::new() }
    }

    /// Fills a slot.
    pub fn set(&self, view: usize, value: T) {
        lock(&self.slots).insert(view, value);
        self.filled.notify_all();
    }

    /// The content of a slot now.
    pub fn get(&self, view: usize) -> Option<T> {
        lock(&self.slots).get(&view).cloned()
    }

    /// Waits until the slot is filled; `None` when `stopping` says so first.
    pub fn wait(&self, view: usize, stopping: impl Fn() -> bool) -> Option<T> {
        let mut slots = lock(&self.slots);
        let mut _waits = None;
        loop {
            if let Some(value) = slots.get(&view) {
                return Some(value.clone());
            }
            if _waits.is_none() {
                _waits = waiting_for(&format!("{} of photo {view}", self.what));
            }
            if stopping() {
                return None;
            }
            let tick = Duration::from_millis(200);
            slots = self.filled.wait_timeout(slots, tick).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_waits_for_its_own_slot() {
        let slots = ViewSlots::new("word");
        std::thread::scope(|s| {
            let reader = s.spawn(|| slots.wait(1, || false));
            slots.set(0, "other");
            slots.set(1, "mine");
            assert_eq!(reader.join().unwrap(), Some("mine"));
        });
    }

    #[test]
    fn a_reader_does_not_outwait_a_stop() {
        assert_eq!(ViewSlots::<u8>::new("word").wait(0, || true), None);
    }
}
