//! The steps in which poses are computed, and what they may use.

use std::time::Instant;

/// A step of computing poses.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseStep {
    /// Photos are taken out of a video.
    Frames,
    /// Features of each photo.
    Features,
    /// Pairs of photos that show the same.
    Pairs,
    /// Poses and points.
    Model,
}

impl PoseStep {
    /// Its name in the timeline.
    pub const fn name(self) -> &'static str {
        match self {
            PoseStep::Frames => "frames",
            PoseStep::Features => "features of photos",
            PoseStep::Pairs => "pairs of photos",
            PoseStep::Model => "poses and points",
        }
    }
}

/// When a step was computed.
#[derive(Clone, Copy, Debug)]
pub struct PoseSpan {
    /// The step.
    pub step: PoseStep,
    /// Its start.
    pub start: Instant,
    /// Its end.
    pub end: Instant,
}

/// What the children may use.
#[derive(Clone, Copy, Debug)]
pub struct PoseLimits {
    /// Threads.
    pub threads: usize,
    /// Memory in bytes.
    pub memory: u64,
}

impl PoseLimits {
    /// So many threads (0: a thread per core) and MiB of memory (0: half of what the machine has free).
    pub fn new(threads: usize, memory_mib: u32) -> PoseLimits {
        let cores = || std::thread::available_parallelism().map_or(1, usize::from);
        let free = || segwild_flow::cpu::available_memory().map_or(UNKNOWN_MEMORY, |bytes| bytes / 2);
        PoseLimits {
            threads: if threads == 0 { cores() } else { threads },
            memory: if memory_mib == 0 { free() } else { u64::from(memory_mib) << 20 },
        }
    }
}

/// Bytes of memory where the system does not report what it has free.
const UNKNOWN_MEMORY: u64 = 4 << 30;
