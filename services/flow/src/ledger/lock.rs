//! One writer per run: a lock that ends with its process.

use std::fs;
use std::path::{Path, PathBuf};

use super::LedgerError;
use crate::files::FileError;
use crate::process::{self, Lock, LockError};

pub use crate::process::Owner;

fn lock_path(ledger: &Path) -> PathBuf {
    ledger.with_extension("lock")
}

/// The lock of a ledger, held while it lives.
#[derive(Debug)]
pub(super) struct RunLock {
    _lock: Lock,
}

impl RunLock {
    pub fn take(ledger: &Path) -> Result<Self, LedgerError> {
        if let Some(folder) = ledger.parent().filter(|p| !p.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(|e| FileError::new("create the run folder", folder, e))?;
        }
        let lock = Lock::take(&lock_path(ledger)).map_err(|error| match error {
            LockError::Held(owner) => LedgerError::Busy { path: ledger.to_path_buf(), owner },
            LockError::File(error) => error.into(),
        })?;
        Ok(Self { _lock: lock })
    }
}

/// Who holds the lock now.
pub(super) fn owner(ledger: &Path) -> Option<Owner> {
    process::owner(&lock_path(ledger))
}
