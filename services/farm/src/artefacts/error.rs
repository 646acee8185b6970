//! What stands in the way of an artefact, in words.

use std::path::PathBuf;

use segwild_flow::files::Stray;
use segwild_flow::process::Owner;
use segwild_flow::{FileError, LedgerError};

use super::digest::ArtefactDigest;
use super::manifest::FolderManifestError;

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
        #[source]
        reason: StoreAddressError,
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
    /// The store has more bytes of it than were declared.
    #[error(
        "the artefact {digest} is longer in {store} than the {most} bytes that it may have by the list of its folder: store the folder again"
    )]
    Long {
        /// Which store.
        store: String,
        /// Which artefact.
        digest: ArtefactDigest,
        /// Most bytes that it may have.
        most: u64,
    },
    /// The store has fewer bytes of it than were declared.
    #[error(
        "the artefact {digest} has {received} bytes in {store}, and {least} by the list of its folder: store the folder again"
    )]
    Short {
        /// Which store.
        store: String,
        /// Which artefact.
        digest: ArtefactDigest,
        /// Bytes that came.
        received: u64,
        /// Fewest bytes that it may have.
        least: u64,
    },
    /// The store has no folder of those who are to use it.
    #[error(
        "{store} has none of the {folders} folders that the farm's scenes refer to, so it seems to be another farm's store: check --artefacts, which is the same for a sweep as for the farm's workers"
    )]
    OtherStore {
        /// Which store.
        store: String,
        /// How many folders it should have.
        folders: usize,
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
        #[source]
        reason: FetchedFolderError,
    },
    /// A folder that cannot be stored.
    #[error("{} cannot be stored: {reason}", path.display())]
    Unfit {
        /// The folder, or the entry of it.
        path: PathBuf,
        /// Why.
        #[source]
        reason: UnfitFolderError,
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

/// Why an address is none of a store of artefacts.
#[derive(Debug, thiserror::Error)]
pub enum StoreAddressError {
    /// An address of S3 without a bucket.
    #[error("it names no bucket")]
    NoBucket,
    /// An address that is neither a folder's nor of S3.
    #[error("it is of another kind")]
    OtherKind,
    /// No text at all.
    #[error("it is empty")]
    Empty,
    /// The store's client refuses it, or what the environment says of it.
    #[error("{0}")]
    Client(#[source] Box<dyn std::error::Error + Send + Sync>),
    /// The folder is not there and cannot be made.
    #[error("the folder cannot be made: {0}")]
    Folder(#[source] std::io::Error),
    /// The system starts no thread for the store's client.
    #[error("no thread can be started: {0}")]
    Thread(#[source] std::io::Error),
    /// The client of the farm's servers, which keep the store, has ended.
    #[error("the client has ended")]
    Ended,
}

/// Why a folder that was fetched is refused.
#[derive(Debug, thiserror::Error)]
pub enum FetchedFolderError {
    /// Its manifest cannot be read from the disk.
    #[error("its manifest cannot be read: {0}")]
    Unread(#[source] std::io::Error),
    /// Its manifest is refused.
    #[error(transparent)]
    Manifest(#[from] FolderManifestError),
    /// It was to be a run.
    #[error("it has no ledger: it is no run")]
    NoLedger,
    /// A run has a file, named as it is safe to show, that would not have been stored with it.
    #[error("`{0}` is no file of a run that goes to another machine")]
    OtherFile(String),
}

/// Why a folder cannot be stored.
#[derive(Debug, thiserror::Error)]
pub enum UnfitFolderError {
    /// Links form a circle.
    #[error("it is a link to a folder in which it lies")]
    Circle,
    /// A name of other bytes than text.
    #[error("its name is not Unicode: rename it")]
    Name,
    /// A path that no manifest takes, and what is wrong with it.
    #[error("its path {0}")]
    Path(&'static str),
    /// Too many files: more than this.
    #[error("it has more than {0} files")]
    Files(usize),
    /// Its manifest is refused.
    #[error(transparent)]
    Manifest(#[from] FolderManifestError),
    /// Its manifest has too many bytes.
    #[error("its list of files has {0} bytes")]
    Listing(usize),
}

impl ArtefactError {
    /// Whether a file was gone when it was to be read.
    pub(super) fn is_gone(&self) -> bool {
        matches!(self, Self::File(error) if error.action == "read" && error.source.kind() == std::io::ErrorKind::NotFound)
    }
}
