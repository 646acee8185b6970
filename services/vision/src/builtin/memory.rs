//! A cache in memory of the values used last, within a number of bytes.

use segwild_files::lock;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock};

/// A value computed once, or being computed.
pub(crate) type MemorySlot<T> = Arc<OnceLock<Arc<T>>>;

/// The values used last, newest first.
pub(crate) struct Memory<T> {
    /// Bytes that all values together may take; the newest one is always kept.
    limit: usize,
    recent: Mutex<VecDeque<(blake3::Hash, MemorySlot<T>)>>,
}

impl<T: Weighed> Memory<T> {
    pub fn new(limit: usize) -> Memory<T> {
        Memory { limit, recent: Mutex::default() }
    }

    /// The slot of a key, new and empty if it is not there; it becomes the newest.
    pub fn slot(&self, key: blake3::Hash) -> MemorySlot<T> {
        let mut recent = lock(&self.recent);
        let known = recent.iter().position(|(k, _)| *k == key).and_then(|i| recent.remove(i));
        let entry = known.unwrap_or_else(|| (key, MemorySlot::default()));
        let slot = entry.1.clone();
        recent.push_front(entry);
        slot
    }

    /// Whether the value of a key is there.
    pub fn has(&self, key: blake3::Hash) -> bool {
        lock(&self.recent).iter().any(|(known, slot)| *known == key && slot.get().is_some())
    }

    /// Forgets the oldest values until the others fit.
    pub fn trim(&self) {
        let mut recent = lock(&self.recent);
        let mut bytes = 0usize;
        let mut first = true;
        recent.retain(|(_, slot)| {
            bytes = bytes.saturating_add(slot.get().map_or(0, |v| v.bytes()));
            std::mem::take(&mut first) || bytes <= self.limit
        });
    }

    /// Whether so many values as large as the largest there is would fit.
    pub fn has_space_for(&self, many: usize) -> bool {
        let recent = lock(&self.recent);
        let largest = recent.iter().filter_map(|(_, slot)| slot.get()).map(|v| v.bytes()).max();
        largest.unwrap_or(0).saturating_mul(many) <= self.limit
    }

    #[cfg(test)]
    fn count(&self) -> usize {
        lock(&self.recent).len()
    }
}

/// A value that reports how much memory it takes.
pub(crate) trait Weighed {
    /// About that many bytes.
    fn bytes(&self) -> usize;
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Weighed for Vec<u8> {
        fn bytes(&self) -> usize {
            self.len()
        }
    }

    #[test]
    fn the_oldest_go_when_the_bytes_are_used_up() {
        let memory = Memory::new(100);
        let put = |n: u8, size: usize| {
            let slot = memory.slot(blake3::hash(&[n]));
            let value = slot.get_or_init(|| Arc::new(vec![n; size])).clone();
            memory.trim();
            value
        };
        (0..4).for_each(|n| drop(put(n, 30)));
        assert_eq!(memory.count(), 3);
        assert!(memory.has(blake3::hash(&[3])) && !memory.has(blake3::hash(&[0])));
        assert!(memory.slot(blake3::hash(&[1])).get().is_some(), "used again: the newest");
        drop(put(9, 30));
        assert!(memory.slot(blake3::hash(&[1])).get().is_some());
        assert!(memory.slot(blake3::hash(&[2])).get().is_none(), "was the oldest");
        assert!(memory.has_space_for(3) && !memory.has_space_for(4));
        let large = put(7, 1000);
        assert!(memory.slot(blake3::hash(&[7])).get().is_some(), "one larger than the limit is kept alone");
        assert_eq!((large.len(), memory.count()), (1000, 1));
        assert!(!memory.has_space_for(1));
    }
}
