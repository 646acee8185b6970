//! Objects that are to be written as selections, in the order in which that was requested.

use crate::document::ObjectId;
use std::collections::VecDeque;
use tokio::sync::oneshot;

/// Writes that wait at most.
const MOST: usize = 64;

/// A write of an object.
pub(super) trait WriteOfObject {
    /// The object.
    fn object(&self) -> ObjectId;
}

/// A write that waits, and who receives how it ended.
pub(super) struct QueuedWrite<W, T> {
    pub write: W,
    pub written: oneshot::Sender<T>,
}

/// The writes that are to come, for one thread that takes them one after the other.
pub(super) struct WriteQueue<W, T> {
    waiting: VecDeque<QueuedWrite<W, T>>,
    /// Whether a thread takes them.
    busy: bool,
    /// Whether no more are taken.
    ended: bool,
}

impl<W, T> Default for WriteQueue<W, T> {
    fn default() -> Self {
        WriteQueue { waiting: VecDeque::new(), busy: false, ended: false }
    }
}

impl<W: WriteOfObject, T> WriteQueue<W, T> {
    /// Whether no further write may wait.
    pub fn is_full(&self) -> bool {
        self.waiting.len() >= MOST
    }

    /// Whether nobody takes the writes: who adds one starts a thread.
    pub fn is_idle(&self) -> bool {
        !self.busy
    }

    /// Whether it has ended: nothing may be added.
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// Adds a write, which somebody takes. What is returned receives how it ended.
    pub fn add(&mut self, write: W) -> oneshot::Receiver<T> {
        let (written, answer) = oneshot::channel();
        self.waiting.push_back(QueuedWrite { write, written });
        self.busy = true;
        answer
    }

    /// Takes the next write; without one, whoever took them has ended.
    pub fn take(&mut self) -> Option<QueuedWrite<W, T>> {
        let next = self.waiting.pop_front();
        self.busy = next.is_some();
        next
    }

    /// Takes the write of an object out of its turn, if it waits.
    pub fn remove(&mut self, object: ObjectId) -> Option<QueuedWrite<W, T>> {
        let at = self.waiting.iter().position(|queued| queued.write.object() == object)?;
        self.waiting.remove(at)
    }

    /// Ends it; returns the writes that wait.
    pub fn end(&mut self) -> VecDeque<QueuedWrite<W, T>> {
        self.ended = true;
        std::mem::take(&mut self.waiting)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    impl WriteOfObject for ObjectId {
        fn object(&self) -> ObjectId {
            *self
        }
    }

    #[test]
    fn writes_are_taken_in_order_and_a_thread_starts_where_none_takes_them() {
        let mut writes = WriteQueue::<ObjectId, u32>::default();
        assert!(writes.is_idle());
        let mut removed = writes.add(5);
        let answers = [writes.add(7), writes.add(3)];
        drop(writes.remove(5).expect("it waits"));
        assert!(writes.remove(5).is_none() && removed.try_recv().is_err());
        for (expected, mut answer) in [7, 3].into_iter().zip(answers) {
            let QueuedWrite { write, written } = writes.take().expect("one waits");
            assert!(!writes.is_idle() && written.send(10 * write).is_ok());
            assert_eq!((write, answer.try_recv()), (expected, Ok(10 * expected)));
        }
        assert!(writes.take().is_none() && writes.is_idle());
        let _answers: Vec<_> = (0..MOST as ObjectId).map(|id| writes.add(id)).collect();
        assert!(writes.is_full() && !writes.has_ended());
        assert_eq!(writes.end().len(), MOST);
        assert!(writes.has_ended() && writes.take().is_none());
    }
}
