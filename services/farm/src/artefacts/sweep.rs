//! What nothing refers to any more is removed from a store.
//!
//! Workers store while a sweep goes on, and their records refer to what they stored only later. So a sweep removes nothing that
//! was stored within a named age, and who stores what is there already renews it once it is older than `RENEWED_AFTER`. A
//! session remembers for `REMEMBERED` what a store has. Both together are less than half of [`LEAST_AGE`]: whatever a manifest
//! names was young when the manifest was stored, and stays so until a record refers to it.

use std::collections::{BTreeSet, HashSet};
use std::time::Duration;

use serde::Serialize;

use super::digest::ArtefactDigest;
use super::error::ArtefactError;
use super::parallel::each;
use super::session::ArtefactSession;
use super::store::StoredArtefact;

/// The least age of what a sweep removes.
pub const LEAST_AGE: Duration = Duration::from_secs(24 * 3600);

/// Artefacts of one fate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ArtefactCount {
    /// How many.
    pub artefacts: u64,
    /// Their bytes in all.
    pub bytes: u64,
}

impl ArtefactCount {
    fn add(&mut self, artefact: &StoredArtefact) {
        self.artefacts += 1;
        self.bytes += artefact.bytes;
    }
}

/// What a sweep found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SweptArtefacts {
    /// Removed, or, in a dry run, to be removed.
    pub removed: ArtefactCount,
    /// Old, and something refers to them.
    pub used: ArtefactCount,
    /// Younger than the age, whether something refers to them or not.
    pub young: ArtefactCount,
    /// Folders that something refers to and the store does not have.
    pub missing: u64,
}

impl ArtefactSession {
    /// Removes what is older than an age, at least [`LEAST_AGE`], and what no folder of those that `roots` names consists of.
    /// `roots` is called after the store was listed. Each artefact is shown once it is removed; with `dry_run`, none is. What
    /// others renew or remove meanwhile is not counted.
    ///
    /// # Errors
    /// What `roots` reports; [`ArtefactError::OtherStore`] when the store has none of the folders that it names; when one of them
    /// cannot be read, or the store cannot be reached. Before the first one is removed, all folders were read.
    pub fn sweep<E: From<ArtefactError>>(
        &self,
        older_than: Duration,
        dry_run: bool,
        roots: impl FnOnce() -> Result<BTreeSet<ArtefactDigest>, E>,
        show: &mut dyn FnMut(&StoredArtefact),
    ) -> Result<SweptArtefacts, E> {
        let least = older_than.max(LEAST_AGE);
        self.store().bring_back()?;
        let mut swept = SweptArtefacts::default();
        let mut old = Vec::new();
        self.store().list(&mut |artefact| match artefact.is_older(least) {
            true => old.push(artefact),
            false => swept.young.add(&artefact),
        })?;
        let used = self.used_by(&roots()?, &mut swept.missing)?;
        for artefact in old {
            if used.contains(&artefact.digest) {
                swept.used.add(&artefact);
                continue;
            }
            // Somebody may have renewed it, or removed it, since it was listed.
            if !dry_run && !self.store().remove_older(&artefact.digest, least)? {
                continue;
            }
            show(&artefact);
            swept.removed.add(&artefact);
        }
        if !dry_run {
            self.store().remove_interrupted(least)?;
        }
        Ok(swept)
    }

    /// These folders' manifests and all of their files. Folders that the store does not have are counted; it has to have one of
    /// them, or it is the store of others, who need what is in it.
    fn used_by(
        &self,
        roots: &BTreeSet<ArtefactDigest>,
        missing: &mut u64,
    ) -> Result<HashSet<ArtefactDigest>, ArtefactError> {
        let roots: Vec<ArtefactDigest> = roots.iter().copied().collect();
        let aside = std::env::temp_dir();
        let folders = each(&roots, |root| match self.fetch_manifest(root, &aside) {
            Err(ArtefactError::Missing { .. }) => Ok(None),
            read => {
                read.map(|manifest| Some(manifest.files().iter().map(|file| file.digest).collect::<Vec<_>>()))
            }
        })?;
        if folders.iter().all(Option::is_none) {
            return Err(ArtefactError::OtherStore { store: self.store().name(), folders: roots.len() });
        }
        *missing = folders.iter().filter(|folder| folder.is_none()).count() as u64;
        Ok(folders.into_iter().flatten().flatten().chain(roots).collect())
    }
}
