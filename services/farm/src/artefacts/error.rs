//! What stands in the way of an artefact, in words.

use std::path::PathBuf;

use segwild_flow::files::Stray;
use segwild_flow::process::Owner;
use segwild_flow::{FileError, LedgerError};

use super::digest::ArtefactDigest;

/// Why an artefact was not stored or fetched.
#[derive(Debug, thiserror::Error)]
pub enum ArtefactError {
    /// The address of a store that makes no sense.
    #[error(
        "`{address}` is no store of artefacts ({reason}): give a folder, file:///FOLDER or s3://BUCKET/PREFIX"
    )]
    Address {
        /// As it was given.
        address: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The store does not have it.
    #[error(
        "{store} does not have the artefact {digest}: store it again, or check that all machines use the same store"
    )]
    Missing {
        /// Which store.
        store: String,
        /// Which artefact.
        digest: ArtefactDigest,
    },
    /// The store delivered other bytes.
    #[error(
        "the artefact {digest} is damaged in {store} (its bytes have the digest {found}): remove it there and store it again"
    )]
    Damaged {
        /// Which store.
        store: String,
        /// Which artefact.
        digest: ArtefactDigest,
        /// The digest of what came.
        found: ArtefactDigest,
    },
    /// A file has other bytes than its digest promises.
    #[error("{} is not the artefact {digest}: it has changed while it was read; try again when nobody writes it", path.display())]
    Changed {
        /// Which file.
        path: PathBuf,
        /// Which artefact it was to be.
        digest: ArtefactDigest,
    },
    /// The store cannot be reached or refuses.
    #[error("cannot {action} in {store}: {source}")]
    Store {
        /// Which store.
        store: String,
        /// What was tried, with the artefact.
        action: String,
        /// What the store's client reports.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A manifest that no program of ours writes, or one beyond the limits.
    #[error("the folder {digest} is refused: {reason}")]
    Manifest {
        /// Which manifest.
        digest: ArtefactDigest,
        /// What is wrong with it.
        reason: String,
    },
    /// A folder that cannot be stored.
    #[error("{} cannot be stored: {reason}", path.display())]
    Unfit {
        /// The folder, or the entry of it.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// The run folder is in use.
    #[error("the run {} is in use by {owner}; wait for it or stop it", path.display())]
    Busy {
        /// The folder.
        path: PathBuf,
        /// Who writes it.
        owner: Owner,
    },
    /// An entry of a folder leads out of it.
    #[error(transparent)]
    Stray(#[from] Stray),
    /// A file on this machine.
    #[error(transparent)]
    File(#[from] FileError),
    /// The ledger of a run.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
}

impl ArtefactError {
    /// Whether a file was gone when it was to be read.
    pub(super) fn is_gone(&self) -> bool {
        matches!(self, Self::File(error) if error.action == "read" && error.source.kind() == std::io::ErrorKind::NotFound)
    }
}
