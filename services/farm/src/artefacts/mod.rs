//! Artefacts between machines: files by the BLAKE3 of their bytes, in a store that every machine reaches.
//!
//! - [`ArtefactStore`]: has, put, get, list, remove what is old. [`ObjectArtefacts`] is a shared folder or S3; [`JetStreamArtefacts`] a bucket of the
//!   NATS server that a small farm has anyway. Whatever a store delivers is verified before it takes a name.
//! - [`FolderManifest`]: a folder as a list of files and digests; it is an artefact, too, so a folder has one digest.
//! - [`ArtefactSession`]: stores and fetches folders and runs. A run is copied while its process writes it, and continues on
//!   another machine to the same bytes.
//!
//! - [`ArtefactSession::sweep`] removes what is old and belongs to none of the folders that its caller names.
//!
//! What it is not: it knows no job and no lease.
//!
//! ```
//! use segwild_farm::{ArtefactSession, ObjectArtefacts};
//! use std::sync::Arc;
//! # let dir = tempfile::tempdir()?;
//! # let (photos, shared, elsewhere) = (dir.path().join("photos"), dir.path().join("shared"), dir.path().join("elsewhere"));
//! # std::fs::create_dir_all(&photos)?;
//! # std::fs::write(photos.join("a.jpg"), "bytes")?;
//! let session = ArtefactSession::new(Arc::new(ObjectArtefacts::open(&shared.display().to_string())?));
//! let digest = session.store_folder(&photos, &|_| true)?;
//! session.fetch_folder(&digest, &elsewhere)?;
//! assert_eq!(std::fs::read(elsewhere.join("a.jpg"))?, b"bytes");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Start reading at `store.rs`, then `session.rs` and `run.rs`.

mod calls;
mod digest;
mod error;
mod folder;
mod http;
mod jetstream;
mod manifest;
mod object;
mod parallel;
mod run;
mod session;
mod store;
mod sweep;
mod transfer;
mod walk;

pub use digest::{ArtefactDigest, DigestError};
pub use error::{ArtefactError, FetchedFolderError, StoreAddressError, UnfitFolderError};
pub use jetstream::JetStreamArtefacts;
pub use manifest::{FolderEntry, FolderLimits, FolderManifest, FolderManifestError};
pub use object::ObjectArtefacts;
pub use session::ArtefactSession;
pub use store::{ArtefactStore, StoredArtefact};
pub use sweep::{ArtefactCount, LEAST_AGE, SweptArtefacts};
