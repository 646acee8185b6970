//! How full the disk is.

use std::path::Path;

use serde::{Deserialize, Serialize};

/// The disk that a folder lies on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Disk {
    /// Bytes that may still be written.
    pub free_bytes: u64,
    /// Bytes in all.
    pub size_bytes: u64,
}

impl Disk {
    /// `None` where the system does not report it.
    #[cfg(unix)]
    pub fn of(folder: &Path) -> Option<Disk> {
        let stats = rustix::fs::statvfs(folder).ok()?;
        let block = stats.f_frsize;
        Some(Disk {
            free_bytes: stats.f_bavail.saturating_mul(block),
            size_bytes: stats.f_blocks.saturating_mul(block),
        })
    }

    /// `None` where the system does not report it.
    #[cfg(not(unix))]
    pub fn of(_: &Path) -> Option<Disk> {
        None
    }
}
