//! What can go wrong with a file, in words.

use std::path::{Path, PathBuf};
use std::{fmt, io};

/// What stood in the way of a file operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Obstacle {
    /// No space or quota left.
    DiskFull,
    /// The file system or folder cannot be written.
    ReadOnly,
    /// This user may not.
    Denied,
    /// A folder of the path is missing or is a file.
    NoFolder,
    /// The file system takes no name of that length.
    NameTooLong,
    /// Anything else; the source says what.
    Other,
}

/// A file operation that failed: what, where, why, what to do.
#[derive(Debug, thiserror::Error)]
#[error("cannot {action} {}: {}", path.display(), Words(action, *obstacle, source))]
pub struct FileError {
    /// What was tried: `write`, `read`, ..
    pub action: &'static str,
    /// On which path.
    pub path: PathBuf,
    /// The kind of obstacle.
    pub obstacle: Obstacle,
    /// The operating system's error.
    pub source: io::Error,
}

struct Words<'a>(&'static str, Obstacle, &'a io::Error);

impl fmt::Display for Words<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.1 {
            Obstacle::DiskFull => f.write_str(Obstacle::FULL),
            Obstacle::ReadOnly => f.write_str(Obstacle::READ_ONLY),
            Obstacle::Denied if self.0 == "read" => f.write_str("permission denied; you may not read it"),
            Obstacle::Denied => f.write_str("permission denied; choose a folder that you may write"),
            Obstacle::NoFolder => f.write_str("its folder does not exist or is a file"),
            Obstacle::NameTooLong => {
                f.write_str("its name is too long for the file system; choose a shorter one")
            }
            Obstacle::Other => write!(f, "{}", self.2),
        }
    }
}

impl Obstacle {
    /// The sentence of every error of a full disk: who sees only the words of another process knows it by this.
    pub const FULL: &'static str = "the disk is full; free some space and run again";
    /// The same of a file system that cannot be written.
    pub const READ_ONLY: &'static str = "the folder is on a read-only file system; choose another one";

    /// The kind of an error of the operating system.
    pub fn of(error: &io::Error) -> Obstacle {
        match error.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => Obstacle::DiskFull,
            io::ErrorKind::ReadOnlyFilesystem => Obstacle::ReadOnly,
            io::ErrorKind::PermissionDenied => Obstacle::Denied,
            io::ErrorKind::NotFound | io::ErrorKind::NotADirectory => Obstacle::NoFolder,
            io::ErrorKind::InvalidFilename => Obstacle::NameTooLong,
            _ => Obstacle::Other,
        }
    }
}

impl FileError {
    /// Wraps the operating system's error.
    pub fn new(action: &'static str, path: &Path, source: io::Error) -> Self {
        let obstacle = Obstacle::of(&source);
        Self { action, path: path.to_path_buf(), obstacle, source }
    }
}
