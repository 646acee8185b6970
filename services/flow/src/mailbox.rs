//! Typed mailboxes, bounded by count and by bytes, with an urgent lane.
//!
//! Tokio semaphores hold the permits, lock-free queues hold the messages, so the same mailbox serves async
//! tasks (`send`, `recv`) and compute threads (`blocking_send`, `blocking_recv`). Each lane has permits of its
//! own: an urgent message waits neither behind queued work nor behind senders that are held back. A message
//! larger than the whole limit takes the whole limit: it travels alone, and never deadlocks. Permits are given
//! back when the message is taken out, so memory is bounded by the limit plus what is being handled.
//!
//! Several receivers may share one mailbox; each message goes to one of them. The mailbox closes when the last
//! sender or the last receiver is dropped, or by [`Receiver::close`]; what is queued can still be taken out.
//!
//! ```
//! use segwild_flow::{Limits, mailbox};
//! let (sender, receiver) = mailbox::<String>("masks", Limits { count: 2, bytes: 1 << 20 });
//! sender.blocking_send("view 1".into()).unwrap();
//! sender.blocking_send("view 2".into()).unwrap();
//! assert!(sender.try_send("view 3".into()).is_err(), "full");
//! sender.blocking_send_urgent("click".into()).unwrap();
//! drop(sender);
//! let order: Vec<_> = std::iter::from_fn(|| receiver.blocking_recv()).collect();
//! assert_eq!(order, ["click", "view 1", "view 2"]);
//! ```

mod words;

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use crossbeam_queue::SegQueue;
use tokio::sync::{Semaphore, TryAcquireError};

use crate::message::Message;
use crate::meter;
use crate::park::block_on;

pub use words::{Closed, Limits, MailboxStats, RecvError, TrySendError};

struct Item<M> {
    message: M,
    bytes: usize,
    permits: u32,
}

struct Lane<M> {
    count: Semaphore,
    bytes: Semaphore,
    queue: SegQueue<Item<M>>,
}

impl<M> Lane<M> {
    fn new(count: usize, permits: u32) -> Self {
        Self { count: Semaphore::new(count), bytes: Semaphore::new(permits as usize), queue: SegQueue::new() }
    }
}

struct MailboxShared<M> {
    name: Arc<str>,
    limits: Limits,
    /// Bytes that one permit stands for: tokio counts permits in 32 bits.
    unit: usize,
    permits: u32,
    urgent: Lane<M>,
    work: Lane<M>,
    /// One permit per queued message.
    ready: Semaphore,
    closed: AtomicBool,
    senders: AtomicUsize,
    receivers: AtomicUsize,
    /// Senders between holding their permits and having queued the message; a closing mailbox waits for them,
    /// so that a message whose send succeeded is not lost.
    entering: AtomicUsize,
    depth: AtomicUsize,
    bytes: AtomicUsize,
    high_water: AtomicUsize,
    high_water_bytes: AtomicUsize,
    sent: AtomicU64,
    received: AtomicU64,
    held_back: AtomicU64,
    waiting_senders: AtomicUsize,
    back_pressure_us: AtomicU64,
}

/// Makes a mailbox. The name is its owner's.
pub fn mailbox<M: Message>(name: &str, limits: Limits) -> (Sender<M>, Receiver<M>) {
    let limits = Limits { count: limits.count.clamp(1, Semaphore::MAX_PERMITS), bytes: limits.bytes.max(1) };
    let unit = limits.bytes.div_ceil(1 << 30).max(1);
    let permits = limits.bytes.div_ceil(unit) as u32;
    let shared = Arc::new(MailboxShared {
        name: name.into(),
        limits,
        unit,
        permits,
        urgent: Lane::new(limits.count, permits),
        work: Lane::new(limits.count, permits),
        ready: Semaphore::new(0),
        closed: AtomicBool::new(false),
        senders: AtomicUsize::new(1),
        receivers: AtomicUsize::new(1),
        entering: AtomicUsize::new(0),
        depth: AtomicUsize::new(0),
        bytes: AtomicUsize::new(0),
        high_water: AtomicUsize::new(0),
        high_water_bytes: AtomicUsize::new(0),
        sent: AtomicU64::new(0),
        received: AtomicU64::new(0),
        held_back: AtomicU64::new(0),
        waiting_senders: AtomicUsize::new(0),
        back_pressure_us: AtomicU64::new(0),
    });
    (Sender { shared: shared.clone() }, Receiver { shared })
}

impl<M: Message> MailboxShared<M> {
    fn close(&self) {
        self.closed.store(true, Ordering::SeqCst);
        for lane in [&self.urgent, &self.work] {
            lane.count.close();
            lane.bytes.close();
        }
        self.ready.close();
    }

    /// Queues a message whose permits are held; gives it back when the mailbox closed meanwhile.
    fn enter(&self, lane: &Lane<M>, message: M, permits: u32) -> Result<(), M> {
        self.entering.fetch_add(1, Ordering::SeqCst);
        // Either this sees the flag, or who set it sees `entering` and waits: both are SeqCst.
        if self.closed.load(Ordering::SeqCst) {
            self.entering.fetch_sub(1, Ordering::SeqCst);
            return Err(message);
        }
        let bytes = message.bytes();
        let depth = self.depth.fetch_add(1, Ordering::Relaxed) + 1;
        let total = self.bytes.fetch_add(bytes, Ordering::Relaxed) + bytes;
        self.high_water.fetch_max(depth, Ordering::Relaxed);
        self.high_water_bytes.fetch_max(total, Ordering::Relaxed);
        self.sent.fetch_add(1, Ordering::Relaxed);
        lane.queue.push(Item { message, bytes, permits });
        self.ready.add_permits(1);
        self.entering.fetch_sub(1, Ordering::SeqCst);
        Ok(())
    }

    fn try_enter(&self, lane: &Lane<M>, message: M) -> Result<(), TrySendError<M>> {
        let permits = self.permits_of(&message);
        let count = match lane.count.try_acquire() {
            Ok(permit) => permit,
            Err(TryAcquireError::NoPermits) => return Err(TrySendError::Full(message)),
            Err(TryAcquireError::Closed) => return Err(TrySendError::Closed(message)),
        };
        let bytes = match lane.bytes.try_acquire_many(permits) {
            Ok(permit) => permit,
            Err(TryAcquireError::NoPermits) => return Err(TrySendError::Full(message)),
            Err(TryAcquireError::Closed) => return Err(TrySendError::Closed(message)),
        };
        count.forget();
        bytes.forget();
        self.enter(lane, message, permits).map_err(TrySendError::Closed)
    }

    fn permits_of(&self, message: &M) -> u32 {
        // More than the whole limit takes the whole limit.
        message.bytes().div_ceil(self.unit).min(self.permits as usize) as u32
    }

    async fn send(&self, lane: &Lane<M>, message: M) -> Result<(), Closed> {
        let closed = || Closed(self.name.clone());
        let message = match self.try_enter(lane, message) {
            Ok(()) => return Ok(()),
            Err(TrySendError::Closed(_)) => return Err(closed()),
            Err(TrySendError::Full(message)) => message,
        };
        let _waiting = WaitingSender::new(self);
        let permits = self.permits_of(&message);
        let count = lane.count.acquire().await.map_err(|_| closed())?;
        let bytes = lane.bytes.acquire_many(permits).await.map_err(|_| closed())?;
        count.forget();
        bytes.forget();
        self.enter(lane, message, permits).map_err(|_| closed())
    }

    fn pop(&self) -> Option<M> {
        let (item, lane) = match self.urgent.queue.pop() {
            Some(item) => (item, &self.urgent),
            None => (self.work.queue.pop()?, &self.work),
        };
        self.depth.fetch_sub(1, Ordering::Relaxed);
        self.bytes.fetch_sub(item.bytes, Ordering::Relaxed);
        self.received.fetch_add(1, Ordering::Relaxed);
        lane.count.add_permits(1);
        lane.bytes.add_permits(item.permits as usize);
        Some(item.message)
    }

    /// What is left in a closed mailbox.
    fn pop_closed(&self) -> Option<M> {
        loop {
            if let Some(message) = self.pop() {
                return Some(message);
            }
            if self.entering.load(Ordering::SeqCst) == 0 {
                return self.pop();
            }
            std::thread::yield_now();
        }
    }

    async fn recv(&self) -> Option<M> {
        match self.ready.acquire().await {
            Ok(permit) => {
                permit.forget();
                // There is a message for every permit, but in a mailbox closed meanwhile another receiver
                // may have taken it without one.
                self.pop().or_else(|| self.pop_closed())
            }
            Err(_) => self.pop_closed(),
        }
    }
}

/// Counts the time a sender is held back, also when its future is dropped.
struct WaitingSender<'a, M> {
    shared: &'a MailboxShared<M>,
    since: Instant,
}

impl<'a, M> WaitingSender<'a, M> {
    fn new(shared: &'a MailboxShared<M>) -> Self {
        shared.held_back.fetch_add(1, Ordering::Relaxed);
        shared.waiting_senders.fetch_add(1, Ordering::Relaxed);
        Self { shared, since: Instant::now() }
    }
}

impl<M> Drop for WaitingSender<'_, M> {
    fn drop(&mut self) {
        self.shared.waiting_senders.fetch_sub(1, Ordering::Relaxed);
        self.shared.back_pressure_us.fetch_add(self.since.elapsed().as_micros() as u64, Ordering::Relaxed);
    }
}

/// The sending side; clones send to the same mailbox.
pub struct Sender<M: Message> {
    shared: Arc<MailboxShared<M>>,
}

impl<M: Message> Clone for Sender<M> {
    fn clone(&self) -> Self {
        self.shared.senders.fetch_add(1, Ordering::Relaxed);
        Self { shared: self.shared.clone() }
    }
}

impl<M: Message> Drop for Sender<M> {
    fn drop(&mut self) {
        if self.shared.senders.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.shared.close();
        }
    }
}

impl<M: Message> Sender<M> {
    /// Sends, waiting for space; for async tasks.
    ///
    /// # Errors
    /// When the mailbox is closed; the message is dropped.
    pub async fn send(&self, message: M) -> Result<(), Closed> {
        self.shared.send(&self.shared.work, message).await
    }

    /// Sends ahead of all work, waiting for space among urgent messages only.
    ///
    /// # Errors
    /// When the mailbox is closed.
    pub async fn send_urgent(&self, message: M) -> Result<(), Closed> {
        self.shared.send(&self.shared.urgent, message).await
    }

    /// Sends, blocking the thread until there is space; for compute threads. An actor's time held back is
    /// counted as such.
    ///
    /// # Errors
    /// When the mailbox is closed.
    pub fn blocking_send(&self, message: M) -> Result<(), Closed> {
        self.blocking(&self.shared.work, message)
    }

    /// As [`Sender::blocking_send`], ahead of all work.
    ///
    /// # Errors
    /// When the mailbox is closed.
    pub fn blocking_send_urgent(&self, message: M) -> Result<(), Closed> {
        self.blocking(&self.shared.urgent, message)
    }

    fn blocking(&self, lane: &Lane<M>, message: M) -> Result<(), Closed> {
        let closed = || Closed(self.shared.name.clone());
        match self.shared.try_enter(lane, message) {
            Ok(()) => Ok(()),
            Err(TrySendError::Closed(_)) => Err(closed()),
            Err(TrySendError::Full(message)) => {
                let _blocked = meter::waiting_for(&self.shared.name);
                block_on(self.shared.send(lane, message), None).unwrap_or_else(|| Err(closed()))
            }
        }
    }

    /// Sends if there is space now.
    ///
    /// # Errors
    /// Gives the message back when there is none.
    pub fn try_send(&self, message: M) -> Result<(), TrySendError<M>> {
        self.shared.try_enter(&self.shared.work, message)
    }

    /// Sends ahead of all work if there is space now.
    ///
    /// # Errors
    /// Gives the message back when there is none.
    pub fn try_send_urgent(&self, message: M) -> Result<(), TrySendError<M>> {
        self.shared.try_enter(&self.shared.urgent, message)
    }

    /// Gauges and counters.
    pub fn stats(&self) -> MailboxStats {
        self.shared.stats()
    }
}

/// The receiving side; clones share the messages between them.
pub struct Receiver<M: Message> {
    shared: Arc<MailboxShared<M>>,
}

impl<M: Message> Clone for Receiver<M> {
    fn clone(&self) -> Self {
        self.shared.receivers.fetch_add(1, Ordering::Relaxed);
        Self { shared: self.shared.clone() }
    }
}

impl<M: Message> Drop for Receiver<M> {
    fn drop(&mut self) {
        if self.shared.receivers.fetch_sub(1, Ordering::AcqRel) == 1 {
            self.shared.close();
            // What is left may hold senders or replies that somebody waits for.
            while self.shared.pop_closed().is_some() {}
        }
    }
}

impl<M: Message> Receiver<M> {
    /// The next message, urgent ones first; `None` once the mailbox is closed and empty. For async tasks.
    pub async fn recv(&self) -> Option<M> {
        self.shared.recv().await
    }

    /// As [`Receiver::recv`], blocking the thread; for compute threads.
    pub fn blocking_recv(&self) -> Option<M> {
        block_on(self.shared.recv(), None).flatten()
    }

    /// The next message if it comes within a time.
    ///
    /// # Errors
    /// [`RecvError::Empty`] after that time.
    pub fn recv_timeout(&self, timeout: Duration) -> Result<M, RecvError> {
        match block_on(self.shared.recv(), Instant::now().checked_add(timeout)) {
            Some(Some(message)) => Ok(message),
            Some(None) => Err(RecvError::Closed),
            None => Err(RecvError::Empty),
        }
    }

    /// The next message if there is one now.
    ///
    /// # Errors
    /// When there is none.
    pub fn try_recv(&self) -> Result<M, RecvError> {
        match self.shared.ready.try_acquire() {
            Ok(permit) => {
                permit.forget();
                self.shared.pop().or_else(|| self.shared.pop_closed()).ok_or(RecvError::Closed)
            }
            Err(TryAcquireError::NoPermits) => Err(RecvError::Empty),
            Err(TryAcquireError::Closed) => self.shared.pop_closed().ok_or(RecvError::Closed),
        }
    }

    /// Takes no more messages: senders are refused, also those that wait; what is queued can be taken out.
    pub fn close(&self) {
        self.shared.close();
    }

    /// Gauges and counters.
    pub fn stats(&self) -> MailboxStats {
        self.shared.stats()
    }

    /// Whose it is.
    pub fn name(&self) -> &Arc<str> {
        &self.shared.name
    }

    pub(crate) fn handle(&self) -> Arc<dyn AnyMailbox> {
        self.shared.clone()
    }
}

/// A mailbox whose message type does not matter: what the system needs of it.
pub(crate) trait AnyMailbox: Send + Sync {
    fn close(&self);
    fn stats(&self) -> MailboxStats;
}

impl<M: Message> AnyMailbox for MailboxShared<M> {
    fn close(&self) {
        MailboxShared::close(self);
    }

    fn stats(&self) -> MailboxStats {
        MailboxStats {
            name: self.name.to_string(),
            depth: self.depth.load(Ordering::Relaxed),
            bytes: self.bytes.load(Ordering::Relaxed),
            high_water: self.high_water.load(Ordering::Relaxed),
            high_water_bytes: self.high_water_bytes.load(Ordering::Relaxed),
            capacity: self.limits.count,
            capacity_bytes: self.limits.bytes,
            sent: self.sent.load(Ordering::Relaxed),
            received: self.received.load(Ordering::Relaxed),
            held_back: self.held_back.load(Ordering::Relaxed),
            waiting_senders: self.waiting_senders.load(Ordering::Relaxed),
            back_pressure_s: self.back_pressure_us.load(Ordering::Relaxed) as f64 * 1e-6,
            closed: self.closed.load(Ordering::Relaxed),
        }
    }
}
