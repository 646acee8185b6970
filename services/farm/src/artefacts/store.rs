//! Where artefacts lie.

use std::path::Path;

use super::digest::ArtefactDigest;
use super::error::ArtefactError;

/// Artefacts by the digest of their bytes. All calls block, and may come from any thread that runs no async task. Two may
/// store one artefact at once: its bytes are the same.
pub trait ArtefactStore: Send + Sync {
    /// What it is called in messages: never with a credential.
    fn name(&self) -> String;

    /// Whether it has an artefact. It is verified only when it is fetched.
    ///
    /// # Errors
    /// When the store cannot be reached.
    fn has(&self, digest: &ArtefactDigest) -> Result<bool, ArtefactError>;

    /// Stores the bytes of a file, unless the store has them.
    ///
    /// # Errors
    /// When the file cannot be read or has another digest (then nothing is stored), or the store cannot be reached.
    fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError>;

    /// Fetches an artefact into a file, which is replaced if it is there. It is written aside, verified and renamed.
    ///
    /// # Errors
    /// When the store cannot be reached, has no such artefact, or delivers other bytes: then the file is as it was before.
    fn get(&self, digest: &ArtefactDigest, to: &Path) -> Result<(), ArtefactError>;
}
