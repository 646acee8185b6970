//! One of a thing that many want: an accelerator is leased, not fought over.
//!
//! A lease is handed out in the order in which it was requested, urgent ones first, and comes back when its guard is
//! dropped, also by a panic. Who waits shows in the timeline as held back by the thing, by name. Who stops waiting
//! leaves the queue, and nobody behind waits longer for it.
//!
//! ```
//! use segwild_flow::Lease;
//! let gpu = Lease::new("accelerator 0");
//! let held = gpu.acquire("masks");
//! assert!(gpu.try_acquire("features").is_none());
//! assert_eq!(gpu.stats().holder.as_deref(), Some("masks"));
//! drop(held);
//! assert!(gpu.try_acquire("features").is_some());
//! ```

use std::collections::VecDeque;
use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use crate::lock;
use crate::meter::waiting_for;
use crate::park::block_on;

/// Somebody in the queue.
struct QueuePosition {
    ticket: u64,
    waker: Option<Waker>,
}

#[derive(Default)]
struct LeaseQueue {
    holder: Option<String>,
    since: Option<Instant>,
    urgent: VecDeque<QueuePosition>,
    others: VecDeque<QueuePosition>,
    next: u64,
    taken: u64,
    waited: Duration,
    held: Duration,
}

impl LeaseQueue {
    fn lane(&mut self, urgent: bool) -> &mut VecDeque<QueuePosition> {
        if urgent { &mut self.urgent } else { &mut self.others }
    }

    fn waiting(&self) -> usize {
        self.urgent.len() + self.others.len()
    }

    fn take(&mut self, who: &str) {
        self.holder = Some(who.into());
        self.since = Some(Instant::now());
        self.taken += 1;
    }

    /// Whose turn it is, to be woken once the queue is unlocked.
    fn next_turn(&mut self) -> Option<Waker> {
        if self.holder.is_some() {
            return None;
        }
        self.urgent.front_mut().or(self.others.front_mut())?.waker.take()
    }
}

struct LeaseShared {
    name: String,
    queue: Mutex<LeaseQueue>,
}

/// The thing that is leased; clones lease the same one.
#[derive(Clone)]
pub struct Lease(Arc<LeaseShared>);

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
        Self(Arc::new(LeaseShared { name: name.into(), queue: Mutex::default() }))
    }

    /// Takes it for `who`, waiting in turn; for compute threads.
    pub fn acquire(&self, who: &str) -> LeaseGuard {
        self.blocking(self.turn(who))
    }

    /// As [`Lease::acquire`], ahead of all who are not urgent: a click does not wait behind a batch of masks.
    pub fn acquire_urgent(&self, who: &str) -> LeaseGuard {
        self.blocking(self.urgent_turn(who))
    }

    /// Takes it if it is free and nobody waits.
    pub fn try_acquire(&self, who: &str) -> Option<LeaseGuard> {
        let mut queue = lock(&self.0.queue);
        if queue.holder.is_some() || queue.waiting() > 0 {
            return None;
        }
        queue.take(who);
        Some(LeaseGuard(self.clone()))
    }

    /// Joins the queue now; for async tasks.
    pub fn turn(&self, who: &str) -> LeaseTurn {
        self.queue_up(who, false)
    }

    /// As [`Lease::turn`], ahead of all who are not urgent.
    pub fn urgent_turn(&self, who: &str) -> LeaseTurn {
        self.queue_up(who, true)
    }

    fn queue_up(&self, who: &str, urgent: bool) -> LeaseTurn {
        let mut queue = lock(&self.0.queue);
        let ticket = queue.next;
        queue.next += 1;
        queue.lane(urgent).push_back(QueuePosition { ticket, waker: None });
        drop(queue);
        LeaseTurn { lease: self.clone(), who: who.into(), urgent, ticket, since: Instant::now(), over: false }
    }

    fn blocking(&self, mut turn: LeaseTurn) -> LeaseGuard {
        if let Some(guard) = turn.take_if_first(None) {
            return guard;
        }
        let _waiting = waiting_for(&self.0.name);
        block_on(turn, None).expect("there is no deadline that could pass")
    }

    /// Gauges and counters.
    pub fn stats(&self) -> LeaseStats {
        let queue = lock(&self.0.queue);
        LeaseStats {
            name: self.0.name.clone(),
            holder: queue.holder.clone(),
            waiting: queue.waiting(),
            taken: queue.taken,
            waited_s: queue.waited.as_secs_f64(),
            held_s: (queue.held + queue.since.map_or(Duration::ZERO, |s| s.elapsed())).as_secs_f64(),
        }
    }
}

/// A position in a lease's queue: a future of the lease. Dropping it leaves the queue.
pub struct LeaseTurn {
    lease: Lease,
    who: String,
    urgent: bool,
    ticket: u64,
    since: Instant,
    /// The lease was handed out: the position is gone.
    over: bool,
}

impl LeaseTurn {
    /// Takes the lease if it is free and this turn's; else leaves the waker to be woken then.
    fn take_if_first(&mut self, waker: Option<&Waker>) -> Option<LeaseGuard> {
        let mut queue = lock(&self.lease.0.queue);
        let first = queue.urgent.front().or(queue.others.front()).map(|position| position.ticket);
        if queue.holder.is_none() && first == Some(self.ticket) {
            queue.lane(self.urgent).pop_front();
            queue.waited += self.since.elapsed();
            queue.take(&self.who);
            self.over = true;
            return Some(LeaseGuard(self.lease.clone()));
        }
        let (ticket, waker) = (self.ticket, waker.cloned());
        if let Some(position) = queue.lane(self.urgent).iter_mut().find(|position| position.ticket == ticket)
        {
            position.waker = waker;
        }
        None
    }
}

impl Future for LeaseTurn {
    type Output = LeaseGuard;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<LeaseGuard> {
        match self.take_if_first(Some(context.waker())) {
            Some(guard) => Poll::Ready(guard),
            None => Poll::Pending,
        }
    }
}

impl Drop for LeaseTurn {
    fn drop(&mut self) {
        if self.over {
            return;
        }
        let mut queue = lock(&self.lease.0.queue);
        let ticket = self.ticket;
        queue.lane(self.urgent).retain(|position| position.ticket != ticket);
        // It may have been woken already, and now it is the turn of the one behind.
        let next = queue.next_turn();
        drop(queue);
        next.into_iter().for_each(Waker::wake);
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
        let next = queue.next_turn();
        drop(queue);
        next.into_iter().for_each(Waker::wake);
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
