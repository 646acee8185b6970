//! Where artefacts lie.

use std::ops::RangeInclusive;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde::Serialize;

use super::digest::ArtefactDigest;
use super::error::ArtefactError;

/// An artefact that has been in a store for longer is renewed when somebody stores it again: a sweep removes by age, and must
/// not remove what somebody counts on. With what a session remembers, it is less than half of the least age (`sweep.rs`).
pub(super) const RENEWED_AFTER: Duration = Duration::from_secs(10 * 3600);

/// An artefact that a store has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct StoredArtefact {
    /// Its digest.
    pub digest: ArtefactDigest,
    /// Its length in bytes.
    pub bytes: u64,
    /// When it was stored, or renewed, in seconds since 1970.
    pub since: u64,
}

/// Artefacts by the digest of their bytes. All calls block, and may come from any thread that runs no async task. Two may
/// store one artefact at once: its bytes are the same.
pub trait ArtefactStore: Send + Sync {
    /// What it is called in messages: never with a credential.
    fn name(&self) -> String;

    /// Whether it has an artefact. It is verified only when it is fetched.
    ///
    /// # Errors
    /// When the store cannot be reached.
    fn has(&self, digest: &ArtefactDigest) -> Result<bool, ArtefactError> {
        Ok(self.find(digest)?.is_some())
    }

    /// An artefact as the store lists it; `None` where it has none.
    ///
    /// # Errors
    /// When the store cannot be reached.
    fn find(&self, digest: &ArtefactDigest) -> Result<Option<StoredArtefact>, ArtefactError>;

    /// Stores the bytes of a file, unless the store has them. One that it has had for long is renewed.
    ///
    /// # Errors
    /// When the file cannot be read or has another digest (then nothing is stored), or the store cannot be reached.
    fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError>;

    /// Fetches an artefact of so many bytes into a file, which is replaced if it is there. It is written aside, verified and
    /// renamed; never are more than the most bytes written.
    ///
    /// # Errors
    /// When the store cannot be reached, has no such artefact, or delivers other bytes, more or fewer: then the file is as it was
    /// before.
    fn get(
        &self,
        digest: &ArtefactDigest,
        bytes: RangeInclusive<u64>,
        to: &Path,
    ) -> Result<(), ArtefactError>;

    /// Shows every artefact, in no order. Whatever else lies in the store is left out.
    ///
    /// # Errors
    /// When the store cannot be reached; some artefacts may have been shown before.
    fn list(&self, show: &mut dyn FnMut(StoredArtefact)) -> Result<(), ArtefactError>;

    /// Removes an artefact that has been in the store for at least so long; whether it did. What is there and what is removed is
    /// decided in one step, as far as the store can: who renews an artefact meanwhile keeps it, or sees that it is gone.
    ///
    /// # Errors
    /// When the store cannot be reached or refuses.
    fn remove_older(&self, digest: &ArtefactDigest, least: Duration) -> Result<bool, ArtefactError>;

    /// Brings back what a removal that was killed has left neither there nor removed, where the store knows such a state.
    ///
    /// # Errors
    /// When the store cannot be reached or refuses.
    fn bring_back(&self) -> Result<(), ArtefactError> {
        Ok(())
    }

    /// Removes what interrupted transfers left and nobody has written for at least so long, where the store shows it.
    ///
    /// # Errors
    /// When the store cannot be reached or refuses.
    fn remove_interrupted(&self, _least: Duration) -> Result<(), ArtefactError> {
        Ok(())
    }
}

/// The time in seconds since 1970.
pub(super) fn seconds_now() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs())
}

impl StoredArtefact {
    /// Whether it has been there for at least so long; one whose time lies ahead, by another machine's clock, has not, but for 0.
    pub(super) fn is_older(&self, least: Duration) -> bool {
        seconds_now().saturating_sub(self.since) >= least.as_secs()
    }
}
