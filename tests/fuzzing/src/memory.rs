//! The system's allocator, counted.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Counts what is held, and the most that was.
pub struct CountedAllocator {
    held: AtomicUsize,
    peak: AtomicUsize,
}

impl CountedAllocator {
    /// Nothing is held.
    pub const fn new() -> CountedAllocator {
        CountedAllocator { held: AtomicUsize::new(0), peak: AtomicUsize::new(0) }
    }

    /// Forgets the most that was held so far; returns how many bytes are held now.
    pub fn start_counting(&self) -> usize {
        let held = self.held.load(Relaxed);
        self.peak.store(held, Relaxed);
        held
    }

    /// The most bytes that were held since.
    pub fn peak(&self) -> usize {
        self.peak.load(Relaxed)
    }

    fn add(&self, bytes: usize) {
        let held = self.held.fetch_add(bytes, Relaxed) + bytes;
        self.peak.fetch_max(held, Relaxed);
    }

    fn take(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Relaxed);
    }
}

// SAFETY: every call goes to the system's allocator as it is; counting touches no memory that is handed out.
unsafe impl GlobalAlloc for CountedAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        self.add(layout.size());
        // SAFETY: the caller keeps `alloc`'s contract.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        self.take(layout.size());
        // SAFETY: the caller keeps `dealloc`'s contract; the block is the system's.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        self.add(layout.size());
        // SAFETY: the caller keeps `alloc_zeroed`'s contract.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        self.add(size);
        self.take(layout.size());
        // SAFETY: the caller keeps `realloc`'s contract; the block is the system's.
        unsafe { System.realloc(at, layout, size) }
    }
}
