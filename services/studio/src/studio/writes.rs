//! Objects that are to be written as selections, in the order in which that was requested.

use crate::document::ObjectId;
use std::collections::VecDeque;
use tokio::sync::oneshot;

/// Writes that wait at most.
const MOST: usize = 64;

/// An object that is to be written, and who receives how that ended.
type QueuedWrite<T> = (ObjectId, oneshot::Sender<T>);

/// The writes that are to come, for one thread that takes them one after the other.
pub(super) struct WriteQueue<T> {
    waiting: VecDeque<QueuedWrite<T>>,
    /// Whether a thread takes them.
    busy: bool,
}

impl<T> Default for WriteQueue<T> {
    fn default() -> Self {
        WriteQueue { waiting: VecDeque::new(), busy: false }
    }
}

impl<T> WriteQueue<T> {
    /// Whether no further write may wait.
    pub fn is_full(&self) -> bool {
        self.waiting.len() >= MOST
    }

    /// Whether nobody takes the writes: who adds one starts a thread.
    pub fn is_idle(&self) -> bool {
        !self.busy
    }

    /// Adds a write, which somebody takes. What is returned receives how it ended.
    pub fn add(&mut self, id: ObjectId) -> oneshot::Receiver<T> {
        let (written, answer) = oneshot::channel();
        self.waiting.push_back((id, written));
        self.busy = true;
        answer
    }

    /// Takes the next write; without one, whoever took them has ended.
    pub fn take(&mut self) -> Option<QueuedWrite<T>> {
        let next = self.waiting.pop_front();
        self.busy = next.is_some();
        next
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_are_taken_in_order_and_a_thread_starts_where_none_takes_them() {
        let mut writes = WriteQueue::<u32>::default();
        assert!(writes.is_idle());
        let answers = [writes.add(7), writes.add(3)];
        for (expected, mut answer) in [7, 3].into_iter().zip(answers) {
            let (id, written) = writes.take().expect("one waits");
            assert!(!writes.is_idle() && written.send(10 * id).is_ok());
            assert_eq!((id, answer.try_recv()), (expected, Ok(10 * expected)));
        }
        assert!(writes.take().is_none() && writes.is_idle());
        let _answers: Vec<_> = (0..MOST as ObjectId).map(|id| writes.add(id)).collect();
        assert!(writes.is_full());
    }
}
