//! One of a thing that many want: an accelerator is leased, not fought over.
//!
//! A lease is handed out in the order in which it was asked for, urgent ones first, and comes back when its guard is
//! dropped, also by a panic. Who waits shows in the timeline as held back by the thing, by name.
//!
//! ```
//! use segwild_flow::Lease;
//! let gpu = Lease::new("accelerator 0");
//! let held = gpu.acquire("masks");
//! assert!(gpu.try_acquire("features").is_none());
//! assert_eq!(gpu.holder().as_deref(), Some("masks"));
//! drop(held);
//! assert!(gpu.try_acquire("features").is_some());
//! ```

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::meter::{lock, waiting_for};

#[derive(Default)]
struct Queue {
    holder: Option<String>,
    since: Option<Instant>,
    urgent: VecDeque<u64>,
    others: VecDeque<u64>,
    next: u64,
    taken: u64,
    waited: Duration,
    held: Duration,
}

struct Shared {
    name: String,
    queue: Mutex<Queue>,
    changed: Condvar,
}

/// The thing that is leased; clones lease the same one.
#[derive(Clone)]
pub struct Lease(Arc<Shared>);

/// Gauges and counters of a [`Lease`].
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct LeaseStats {
    /// The thing's name.
    pub name: String,
    /// Who has it now.
    pub holder: Option<String>,
    /// How many wait for it now.
    pub waiting: usize,
    /// How often it was taken.
    pub taken: u64,
    /// Time spent waiting for it, in seconds.
    pub waited_s: f64,
    /// Time it was held, in seconds.
    pub held_s: f64,
}

impl Lease {
    /// A thing of which there is one.
    pub fn new(name: &str) -> Self {
        let queue = Mutex::default();
        Self(Arc::new(Shared { name: name.into(), queue, changed: Condvar::new() }))
    }

    /// Takes it for `who`, waiting in turn.
    pub fn acquire(&self, who: &str) -> LeaseGuard {
        self.wait(who, false)
    }

    /// Takes it for `who`, ahead of all who are not urgent: a click does not wait behind a batch of masks.
    pub fn acquire_urgent(&self, who: &str) -> LeaseGuard {
        self.wait(who, true)
    }

    /// Takes it if it is free and nobody waits.
    pub fn try_acquire(&self, who: &str) -> Option<LeaseGuard> {
        let mut queue = lock(&self.0.queue);
        let free = queue.holder.is_none() && queue.urgent.is_empty() && queue.others.is_empty();
        free.then(|| self.take(&mut queue, who))
    }

    fn take(&self, queue: &mut Queue, who: &str) -> LeaseGuard {
        queue.holder = Some(who.into());
        queue.since = Some(Instant::now());
        queue.taken += 1;
        LeaseGuard(self.clone())
    }

    fn wait(&self, who: &str, urgent: bool) -> LeaseGuard {
        let began = Instant::now();
        let mut queue = lock(&self.0.queue);
        let ticket = queue.next;
        queue.next += 1;
        if urgent { &mut queue.urgent } else { &mut queue.others }.push_back(ticket);
        let mut held_back = None;
        loop {
            let first = queue.urgent.front().or(queue.others.front()).copied();
            if queue.holder.is_none() && first == Some(ticket) {
                if urgent { &mut queue.urgent } else { &mut queue.others }.pop_front();
                queue.waited += began.elapsed();
                return self.take(&mut queue, who);
            }
            held_back = held_back.or_else(|| waiting_for(&self.0.name));
            queue = self.0.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Who has it now.
    pub fn holder(&self) -> Option<String> {
        lock(&self.0.queue).holder.clone()
    }

    /// Gauges and counters.
    pub fn stats(&self) -> LeaseStats {
        let queue = lock(&self.0.queue);
        LeaseStats {
            name: self.0.name.clone(),
            holder: queue.holder.clone(),
            waiting: queue.urgent.len() + queue.others.len(),
            taken: queue.taken,
            waited_s: queue.waited.as_secs_f64(),
            held_s: (queue.held + queue.since.map_or(Duration::ZERO, |s| s.elapsed())).as_secs_f64(),
        }
    }
}

/// Holds the thing while it lives.
pub struct LeaseGuard(Lease);

impl Drop for LeaseGuard {
    fn drop(&mut self) {
        let mut queue = lock(&self.0.0.queue);
        let held = queue.since.take().map_or(Duration::ZERO, |since| since.elapsed());
        queue.held += held;
        queue.holder = None;
        drop(queue);
        self.0.0.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::thread;

    #[test]
    fn one_at_a_time_in_turn_and_the_urgent_first() {
        let lease = Lease::new("accelerator");
        let order = Mutex::new(Vec::new());
        thread::scope(|scope| {
            let held = lease.acquire("first");
            for (n, urgent) in [(1, false), (2, false), (3, true), (4, false), (5, true)] {
                let (lease, order) = (lease.clone(), &order);
                let mine = lease.clone();
                scope.spawn(move || {
                    let _held = if urgent { mine.acquire_urgent("n") } else { mine.acquire("n") };
                    lock(order).push(n);
                });
                while lease.stats().waiting < n as usize {
                    thread::yield_now();
                }
            }
            assert!(lease.try_acquire("jumper").is_none());
            drop(held);
        });
        assert_eq!(*lock(&order), [3, 5, 1, 2, 4]);
        let stats = lease.stats();
        assert_eq!((stats.taken, stats.waiting, stats.holder), (6, 0, None));
    }

    #[test]
    fn a_panic_gives_it_back() {
        let lease = Lease::new("accelerator");
        let mine = lease.clone();
        let _ = thread::spawn(move || {
            let _held = mine.acquire("doomed");
            std::panic::resume_unwind(Box::new("bug"));
        })
        .join();
        assert!(lease.try_acquire("next").is_some());
    }

    #[test]
    fn never_two_at_once() {
        let lease = Lease::new("accelerator");
        let inside = AtomicU32::new(0);
        thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..200 {
                        let _held = lease.acquire("worker");
                        assert_eq!(inside.fetch_add(1, Ordering::SeqCst), 0);
                        inside.fetch_sub(1, Ordering::SeqCst);
                    }
                });
            }
        });
        assert_eq!(lease.stats().taken, 800);
    }
}
