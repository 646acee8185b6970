//! The order in which calls get the slots of services.

use segwild_files::lock;
use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};
use tokio::sync::Notify;

/// How urgent a call is. The levels in order, the first one first.
///
/// Each level has a time for which its calls may be overtaken by more urgent ones ([`Priority::overtaken_for`]). So no call
/// waits for ever, however many urgent ones there are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Priority {
    /// The training waits for it: skies and transients. There is one such call per photo, most of them at the start of a run.
    Training,
    /// A person waits for it: the mask of a click, or of a selection in one photo.
    Click,
    /// A later stage needs it: embeddings, proposed masks, boundaries.
    Bulk,
}

impl Priority {
    /// Time for which calls of this level may be overtaken. A bulk call that waits for so long is rare: skies take that long for
    /// hundreds of photos only, and then one bulk call per worker and such a time is let in.
    fn overtaken_for(self) -> Duration {
        match self {
            Priority::Training => Duration::ZERO,
            Priority::Click => Duration::from_secs(1),
            Priority::Bulk => Duration::from_secs(20),
        }
    }
}

/// A call's position among all calls, whenever it waits: one that is repeated since a service failed keeps it.
///
/// Calls go in the order of `due`, the time of their arrival and the time for which they may be overtaken. Those of one level
/// go in the order of their arrival, since both times grow together. A call that is due is overtaken by none that arrives later.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Ticket {
    due: Instant,
    number: u64,
}

/// The calls that wait for a slot.
#[derive(Default)]
pub(super) struct CallQueue {
    waiting: Mutex<BTreeSet<Ticket>>,
    next: AtomicU64,
    changed: Notify,
}

/// A waiting call; it leaves the queue when this is dropped.
struct Position<'a> {
    queue: &'a CallQueue,
    ticket: Ticket,
}

impl Drop for Position<'_> {
    fn drop(&mut self) {
        self.queue.waiting().remove(&self.ticket);
        self.queue.check_again();
    }
}

impl CallQueue {
    fn waiting(&self) -> MutexGuard<'_, BTreeSet<Ticket>> {
        lock(&self.waiting)
    }

    /// Calls that wait now.
    #[cfg(test)]
    pub fn len(&self) -> usize {
        self.waiting().len()
    }

    /// Calls that have arrived so far.
    #[cfg(test)]
    pub fn arrived(&self) -> u64 {
        self.next.load(Ordering::Relaxed)
    }

    /// The ticket of a call that arrives now.
    pub fn ticket(&self, priority: Priority, now: Instant) -> Ticket {
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        Ticket { due: now + priority.overtaken_for(), number }
    }

    /// Wakes the calls that wait: a slot may be free.
    pub fn check_again(&self) {
        self.changed.notify_waiters();
    }

    /// Waits until the call is the first and `attempt` breaks off. It is called again after each
    /// [`check_again`](Self::check_again), and after `interval` at the latest.
    pub async fn turn<T>(
        &self,
        ticket: Ticket,
        interval: Duration,
        mut attempt: impl FnMut() -> ControlFlow<T>,
    ) -> T {
        self.waiting().insert(ticket);
        let _position = Position { queue: self, ticket };
        loop {
            // It counts from here, so that no change is missed between the attempt and the wait.
            let changed = self.changed.notified();
            let is_first = self.waiting().first() == Some(&ticket);
            if is_first && let ControlFlow::Break(outcome) = attempt() {
                return outcome;
            }
            let _ = tokio::time::timeout(interval, changed).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;
    use tokio::sync::Semaphore;

    fn seconds(seconds: u64) -> Duration {
        Duration::from_secs(seconds)
    }

    /// The order in which the queue lets calls through one slot. All of them wait before it is free.
    fn order(calls: &[(Priority, u64)]) -> Vec<usize> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let (queue, slots) = (Arc::new(CallQueue::default()), Arc::new(Semaphore::new(0)));
            let (began, order) = (Instant::now(), Arc::new(Mutex::new(Vec::new())));
            let tasks: Vec<_> = calls
                .iter()
                .enumerate()
                .map(|(index, (priority, after))| {
                    let (queue, slots, order) = (queue.clone(), slots.clone(), order.clone());
                    let ticket = queue.ticket(*priority, began + seconds(*after));
                    tokio::spawn(async move {
                        let attempt = || {
                            slots
                                .clone()
                                .try_acquire_owned()
                                .map_or(ControlFlow::Continue(()), ControlFlow::Break)
                        };
                        let permit = queue.turn(ticket, seconds(60), attempt).await;
                        order.lock().unwrap().push(index);
                        tokio::task::yield_now().await;
                        drop(permit);
                        queue.check_again();
                    })
                })
                .collect();
            while queue.len() < calls.len() {
                tokio::task::yield_now().await;
            }
            slots.add_permits(1);
            queue.check_again();
            for task in tasks {
                task.await.unwrap();
            }
            assert_eq!(queue.len(), 0);
            Arc::into_inner(order).unwrap().into_inner().unwrap()
        })
    }

    #[test]
    fn what_the_training_waits_for_comes_first_then_clicks_and_each_level_in_turn() {
        use Priority::{Bulk, Click, Training};
        let calls = [
            (Bulk, 0),
            (Bulk, 0),
            (Click, 0),
            (Training, 0),
            (Click, 0),
            (Training, 0),
            (Bulk, 0),
            (Training, 0),
        ];
        assert_eq!(order(&calls), [3, 5, 7, 2, 4, 0, 1, 6]);
    }

    #[test]
    fn a_call_that_was_overtaken_for_long_is_overtaken_no_more() {
        use Priority::{Bulk, Click, Training};
        let calls = [(Bulk, 0), (Bulk, 1), (Training, 19), (Training, 22), (Click, 18), (Click, 22)];
        assert_eq!(order(&calls), [2, 4, 0, 1, 3, 5]);
    }

    #[test]
    fn a_call_that_is_given_up_leaves_the_queue_to_the_next() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
        runtime.block_on(async {
            let queue = Arc::new(CallQueue::default());
            let now = Instant::now();
            let (first, second) = (queue.ticket(Priority::Training, now), queue.ticket(Priority::Bulk, now));
            let waiter = |ticket, attempt: fn() -> ControlFlow<()>| {
                let queue = queue.clone();
                tokio::spawn(async move { queue.turn(ticket, seconds(60), attempt).await })
            };
            let never = waiter(first, || ControlFlow::Continue(()));
            let next = waiter(second, || ControlFlow::Break(()));
            while queue.len() < 2 {
                tokio::task::yield_now().await;
            }
            never.abort();
            next.await.unwrap();
            assert!(never.await.unwrap_err().is_cancelled() && queue.len() == 0);
        });
    }
}
