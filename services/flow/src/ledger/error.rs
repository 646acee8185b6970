//! Why a ledger could not serve, in words.

use std::path::{Path, PathBuf};

use super::{Owner, SCHEMA_VERSION};
use crate::files::FileError;
use crate::shortage::{free_disk_bytes, is_shortage};

/// SQLite's shared memory beside a ledger takes so many bytes of the disk, also where it is only read.
const SHARED_MEMORY: u64 = 32 << 10;

/// Why the ledger could not serve.
#[derive(Debug, thiserror::Error)]
pub enum LedgerError {
    /// Another process writes this run.
    #[error("the run {} is in use by {owner}; wait for it or stop it", path.display())]
    Busy {
        /// The ledger.
        path: PathBuf,
        /// Who writes it.
        owner: Owner,
    },
    /// Written by another version of the program.
    #[error(
        "{} has ledger format {found}, this program knows format {SCHEMA_VERSION}: \
         use the version that wrote it, or begin a new run folder (the cache can be kept)",
        path.display()
    )]
    Version {
        /// The ledger.
        path: PathBuf,
        /// Its format.
        found: i64,
    },
    /// Not a ledger, or damaged.
    #[error("{} is not a run ledger or is damaged ({reason}): move it away and run again; the cache and the checkpoints are kept", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What SQLite says.
        reason: String,
    },
    /// There is no ledger to read.
    #[error("there is no run at {}", path.display())]
    Missing {
        /// The file that was searched.
        path: PathBuf,
    },
    /// The disk is full.
    #[error("cannot write {}: the disk is full; free some space and run again, what is done is kept", path.display())]
    DiskFull {
        /// The ledger.
        path: PathBuf,
    },
    /// This handle, or the folder, can only be read.
    #[error("cannot write {}: it is open for reading only, or its folder cannot be written", path.display())]
    ReadOnly {
        /// The ledger.
        path: PathBuf,
    },
    /// A file beside the ledger.
    #[error(transparent)]
    File(#[from] FileError),
    /// Anything else that SQLite reports.
    #[error("the ledger {}: {source}", path.display())]
    Sqlite {
        /// The ledger.
        path: PathBuf,
        /// SQLite's error.
        source: rusqlite::Error,
    },
}

impl LedgerError {
    pub(super) fn sqlite(path: &Path, source: rusqlite::Error) -> Self {
        use rusqlite::ErrorCode::*;
        let path = path.to_path_buf();
        match source.sqlite_error_code() {
            Some(DiskFull) => Self::DiskFull { path },
            // Where it is the shared memory that has no space, SQLite only says that the disk failed.
            Some(SystemIoFailure) if free_disk_bytes(&path).is_some_and(|free| free < SHARED_MEMORY) => {
                Self::DiskFull { path }
            }
            Some(ReadOnly) => Self::ReadOnly { path },
            // SQLite does not say why; the system does.
            Some(CannotOpen) => match std::fs::File::open(&path) {
                Err(error) if is_shortage(&error) => FileError::new("open", &path, error).into(),
                _ => Self::Sqlite { path, source },
            },
            Some(NotADatabase | DatabaseCorrupt) => Self::Damaged { path, reason: source.to_string() },
            _ => Self::Sqlite { path, source },
        }
    }
}
