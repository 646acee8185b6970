//! Whose turn it is to make an archive of masks, and the memory that it takes.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use tokio::sync::Mutex;

/// The archives of a session: one at a time is made, since each has copies of the scene's splats.
#[derive(Default)]
pub(super) struct MaskArchives {
    turn: Arc<Mutex<()>>,
    /// Bytes of the object whose masks are made.
    bytes: Arc<AtomicUsize>,
}

impl MaskArchives {
    /// About how many bytes they take in memory.
    pub fn bytes(&self) -> usize {
        self.bytes.load(Ordering::Relaxed)
    }

    /// The turn to make one.
    pub fn turn(&self) -> Arc<Mutex<()>> {
        self.turn.clone()
    }

    /// Counts bytes until what is returned is dropped.
    pub fn count(&self, bytes: usize) -> CountedBytes {
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        CountedBytes { of_session: self.bytes.clone(), bytes }
    }
}

/// Bytes that count as a session's while this lives.
pub(super) struct CountedBytes {
    of_session: Arc<AtomicUsize>,
    bytes: usize,
}

impl Drop for CountedBytes {
    fn drop(&mut self) {
        self.of_session.fetch_sub(self.bytes, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_counts_while_its_masks_are_made() {
        let archives = MaskArchives::default();
        let counted = archives.count(7);
        assert_eq!(archives.bytes(), 7);
        drop(counted);
        assert_eq!(archives.bytes(), 0);
        let turn = archives.turn().try_lock_owned();
        assert!(turn.is_ok() && archives.turn().try_lock().is_err(), "one at a time");
    }
}
