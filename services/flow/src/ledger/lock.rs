//! One writer per run: a lock that ends with its process.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io::{Read, Seek, Write};
use std::path::{Path, PathBuf};

use super::LedgerError;
use crate::files::FileError;

/// Who writes a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Owner {
    /// Its process, if the lock file tells.
    pub pid: Option<u32>,
}

impl fmt::Display for Owner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.pid {
            Some(pid) => write!(f, "process {pid}"),
            None => f.write_str("another process"),
        }
    }
}

fn lock_path(ledger: &Path) -> PathBuf {
    ledger.with_extension("lock")
}

fn read_owner(path: &Path) -> Owner {
    let mut text = String::new();
    let read = File::open(path).and_then(|mut file| file.read_to_string(&mut text));
    Owner { pid: read.ok().and_then(|_| text.trim().parse().ok()) }
}

/// The lock, held while it lives. The file stays: removing it would let two writers lock two files.
#[derive(Debug)]
pub(super) struct RunLock {
    _file: File,
}

impl RunLock {
    pub fn take(ledger: &Path) -> Result<Self, LedgerError> {
        if let Some(folder) = ledger.parent().filter(|p| !p.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(|e| FileError::new("create the run folder", folder, e))?;
        }
        let path = lock_path(ledger);
        let mut file = File::options()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(&path)
            .map_err(|e| FileError::new("write", &path, e))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                return Err(LedgerError::Busy { path: ledger.to_path_buf(), owner: read_owner(&path) });
            }
            Err(TryLockError::Error(e)) => return Err(FileError::new("lock", &path, e).into()),
        }
        // Only for words: what locks is the lock.
        file.set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()))
            .map_err(|e| FileError::new("write", &path, e))?;
        Ok(Self { _file: file })
    }
}

/// Who holds the lock now.
pub(super) fn owner(ledger: &Path) -> Option<Owner> {
    let path = lock_path(ledger);
    let file = File::open(&path).ok()?;
    match file.try_lock_shared() {
        Err(TryLockError::WouldBlock) => Some(read_owner(&path)),
        _ => None,
    }
}
