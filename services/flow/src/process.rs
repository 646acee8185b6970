//! This process as the operating system sees it (Linux), and files that only one process works with at a time.

use std::fmt;
use std::fs::{self, File, TryLockError};
use std::io::{Seek, Write};
use std::path::Path;

use crate::files::{self, FileError};

/// What a process takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Usage {
    /// Resident memory in bytes.
    pub rss_bytes: u64,
    /// The most resident memory it ever had, in bytes.
    pub peak_rss_bytes: u64,
    /// Threads.
    pub threads: u64,
}

/// What this process takes now; `None` where the system does not report it.
///
/// ```
/// if let Some(usage) = segwild_flow::process::usage() {
///     assert!(usage.peak_rss_bytes >= usage.rss_bytes / 2 && usage.threads >= 1);
/// }
/// ```
pub fn usage() -> Option<Usage> {
    let text = fs::read_to_string("/proc/self/status").ok()?;
    let field = |name: &str| -> Option<u64> {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
        line.split_whitespace().next()?.parse().ok()
    };
    Some(Usage {
        rss_bytes: field("VmRSS")? << 10,
        peak_rss_bytes: field("VmHWM")? << 10,
        threads: field("Threads")?,
    })
}

/// Bytes of a lock file at most: it holds a number.
const MOST_BYTES: u64 = 64;

/// A process that holds a [`Lock`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Owner {
    /// Its number, if the lock file tells.
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

/// Why a lock was not taken.
#[derive(Debug, thiserror::Error)]
pub enum LockError {
    /// Another process holds it.
    #[error("{0} holds it")]
    Held(Owner),
    /// Its file cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
}

/// A lock file, held while this lives: however the process ends, the lock ends with it. The file stays: removing it
/// would let two processes lock two files.
///
/// ```
/// use segwild_flow::process::{Lock, owner};
/// let dir = tempfile::tempdir().unwrap();
/// let path = dir.path().join("run.lock");
/// let lock = Lock::take(&path).unwrap();
/// assert_eq!(owner(&path).and_then(|o| o.pid), Some(std::process::id()));
/// assert!(Lock::take(&path).is_err());
/// drop(lock);
/// assert!(owner(&path).is_none());
/// ```
#[derive(Debug)]
pub struct Lock {
    _file: File,
}

impl Lock {
    /// Takes the lock of a file, which is made if it is not there.
    ///
    /// # Errors
    /// When another process holds it, or the file cannot be written.
    pub fn take(path: &Path) -> Result<Self, LockError> {
        let mut file = File::options()
            .create(true)
            .truncate(false)
            .read(true)
            .write(true)
            .open(path)
            .map_err(|e| FileError::new("write", path, e))?;
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(LockError::Held(read_owner(path))),
            Err(TryLockError::Error(e)) => return Err(FileError::new("lock", path, e).into()),
        }
        // Only for words: what locks is the lock.
        file.set_len(0)
            .and_then(|()| file.rewind())
            .and_then(|()| writeln!(file, "{}", std::process::id()))
            .map_err(|e| FileError::new("write", path, e))?;
        Ok(Self { _file: file })
    }
}

/// Who holds the lock of a file now; nobody where it is no plain file.
pub fn owner(path: &Path) -> Option<Owner> {
    let file = files::open_plain(path).ok()?;
    match file.try_lock_shared() {
        Err(TryLockError::WouldBlock) => Some(read_owner(path)),
        _ => None,
    }
}

fn read_owner(path: &Path) -> Owner {
    let text = files::read_within(path, MOST_BYTES).ok().and_then(|bytes| String::from_utf8(bytes).ok());
    Owner { pid: text.and_then(|text| text.trim().parse().ok()) }
}

#[cfg(test)]
mod tests {
    #[cfg(unix)]
    #[test]
    fn a_pipe_as_a_lock_file_keeps_nobody_waiting() {
        let folder = tempfile::tempdir().unwrap();
        let pipe = folder.path().join("batch.lock");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        assert_eq!(super::owner(&pipe), None);
        assert_eq!(super::read_owner(&pipe).pid, None);
    }
}
