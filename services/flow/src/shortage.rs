//! File descriptors, processes, threads and disk space that the system does not have left: no fault of the work, which may be
//! done once others have given some back.

use std::io;
use std::path::Path;

/// A process needs about so many open files: databases, photos read by each thread, connections of `--metrics-listen`.
pub const FILES_NEEDED: u64 = 96;
/// As far as a process raises its own limit: some systems refuse more, and none is needed.
#[cfg(unix)]
const FILES_WANTED: u64 = 4096;

/// Whether the system refused something because this process, this user or the machine has too many of it open.
///
/// ```
/// use segwild_flow::shortage::is_shortage;
/// # #[cfg(unix)] {
/// assert!(is_shortage(&std::io::Error::from_raw_os_error(24)));
/// # }
/// assert!(!is_shortage(&std::io::ErrorKind::NotFound.into()));
/// ```
pub fn is_shortage(error: &io::Error) -> bool {
    #[cfg(unix)]
    let numbers = [rustix::io::Errno::MFILE, rustix::io::Errno::NFILE].map(|code| code.raw_os_error());
    // ERROR_TOO_MANY_OPEN_FILES
    #[cfg(not(unix))]
    let numbers = [4];
    error.raw_os_error().is_some_and(|code| numbers.contains(&code))
}

/// Whether the system could not start a thread or a process for want of one.
pub fn is_shortage_of_processes(error: &io::Error) -> bool {
    is_shortage(error) || error.kind() == io::ErrorKind::WouldBlock
}

/// Bytes that may still be written on the disk of a folder; `None` where the system does not report it.
#[cfg(unix)]
pub fn free_disk_bytes(folder: &Path) -> Option<u64> {
    let stats = rustix::fs::statvfs(folder).ok()?;
    Some(stats.f_bavail.saturating_mul(stats.f_frsize))
}

/// Bytes that may still be written on the disk of a folder; `None` where the system does not report it.
#[cfg(not(unix))]
pub fn free_disk_bytes(_: &Path) -> Option<u64> {
    None
}

/// Raises the number of files that this process may have open, as far as the system lets it without asking; returns how
/// many it may have then. `None` where there is no such limit.
pub fn raise_open_files() -> Option<u64> {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
        let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
        let current = current?;
        let wanted = maximum.map_or(FILES_WANTED, |most| most.min(FILES_WANTED));
        if wanted > current && setrlimit(Resource::Nofile, Rlimit { current: Some(wanted), maximum }).is_ok()
        {
            return Some(wanted);
        }
        Some(current)
    }
    #[cfg(not(unix))]
    None
}
