//! Folders to and from a store.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use segwild_flow::files::{self, Stray, stays_inside};
use segwild_flow::{FileError, lock};

use super::digest::ArtefactDigest;
use super::error::{ArtefactError, FetchedFolderError, UnfitFolderError};
use super::manifest::{FolderEntry, FolderLimits, FolderManifest, FolderManifestError};
use super::parallel::each;
use super::store::ArtefactStore;
use super::walk::{self, FoundFile};

/// How often a file that changes while it is read is tried.
const TRIES: usize = 4;
/// A file that was written so shortly before it was read may be written again without a change of its time.
const SETTLED: Duration = Duration::from_secs(2);

/// A session stores again what it stored longer ago: a sweep of the store may have removed it. See `sweep.rs`.
const REMEMBERED: Duration = Duration::from_secs(3600);

/// A file as it was when it was hashed.
#[derive(Clone, Copy, PartialEq, Eq)]
struct Seen {
    bytes: u64,
    modified: SystemTime,
}

/// Stores and fetches folders. It remembers the digests of files that it has read, by path, length and time, and what the
/// store has: a run that is stored after each checkpoint is not read as a whole again.
pub struct ArtefactSession {
    store: Arc<dyn ArtefactStore>,
    limits: FolderLimits,
    hashed: Mutex<HashMap<PathBuf, (Seen, ArtefactDigest)>>,
    /// What the store has, and since when that is known. By the wall clock: a machine that sleeps does not stop a sweep.
    stored: Mutex<HashMap<ArtefactDigest, SystemTime>>,
}

/// Which files a folder may do without.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Gone {
    /// None: who removes one while the folder is stored breaks it.
    Refused,
    /// Those that were removed since they were listed.
    LeftOut,
}

impl ArtefactSession {
    /// A session with a store.
    pub fn new(store: Arc<dyn ArtefactStore>) -> Self {
        Self::within(store, FolderLimits::default())
    }

    /// The same with other limits of a folder.
    pub fn within(store: Arc<dyn ArtefactStore>, limits: FolderLimits) -> Self {
        Self { store, limits, hashed: Mutex::default(), stored: Mutex::default() }
    }

    /// Stores those files of a folder whose paths `wanted` accepts (it sees folders as well), as far as the store has not got them.
    /// Links are followed. Returns the digest of the folder's manifest.
    ///
    /// # Errors
    /// When a file cannot be read or changes all the time, or the store cannot be reached.
    pub fn store_folder(
        &self,
        folder: &Path,
        wanted: &dyn Fn(&str) -> bool,
    ) -> Result<ArtefactDigest, ArtefactError> {
        let found = walk::files(folder, &self.limits, wanted)?;
        let entries = self.store_files(&found, Gone::Refused)?;
        // The folder may be one that this process only reads.
        self.store_manifest(folder, entries, &std::env::temp_dir())
    }

    /// Fetches a folder. Files that are there with the right digest stay as they are; others of these names are replaced;
    /// further files stay. Nothing is written outside of `into`, whatever links are in it.
    ///
    /// # Errors
    /// When the manifest is refused, a file of it is missing or damaged in the store, or the folder cannot be written.
    pub fn fetch_folder(
        &self,
        digest: &ArtefactDigest,
        into: &Path,
    ) -> Result<FolderManifest, ArtefactError> {
        std::fs::create_dir_all(into).map_err(|e| FileError::new("create the folder", into, e))?;
        let manifest = self.fetch_manifest(digest, into)?;
        self.fetch_files(manifest.files(), into)?;
        Ok(manifest)
    }

    pub(super) fn limits(&self) -> &FolderLimits {
        &self.limits
    }

    pub(super) fn store(&self) -> &dyn ArtefactStore {
        self.store.as_ref()
    }

    pub(super) fn store_files(
        &self,
        found: &[FoundFile],
        gone: Gone,
    ) -> Result<Vec<FolderEntry>, ArtefactError> {
        let entries = each(found, |found| match self.store_file(found) {
            Err(error) if gone == Gone::LeftOut && error.is_gone() => Ok(None),
            stored => stored.map(Some),
        })?;
        Ok(entries.into_iter().flatten().collect())
    }

    fn store_file(&self, found: &FoundFile) -> Result<FolderEntry, ArtefactError> {
        let mut tries = 1;
        loop {
            let (digest, bytes) = self.digest_of(&found.source)?;
            match self.put(&digest, &found.source) {
                Ok(()) => return Ok(FolderEntry { path: found.path.clone(), digest, bytes }),
                Err(ArtefactError::Changed { .. }) if tries < TRIES => {
                    tries += 1;
                    lock(&self.hashed).remove(&found.source);
                }
                Err(error) => return Err(error),
            }
        }
    }

    pub(super) fn put(&self, digest: &ArtefactDigest, file: &Path) -> Result<(), ArtefactError> {
        let began = SystemTime::now();
        let known = lock(&self.stored).get(digest).copied();
        // One that seems to lie ahead is none to trust.
        if known.is_some_and(|at| began.duration_since(at).is_ok_and(|ago| ago < REMEMBERED)) {
            return Ok(());
        }
        self.store.put(digest, file)?;
        lock(&self.stored).insert(*digest, began);
        Ok(())
    }

    /// The digest of a file and its length, from memory if the file is as it was.
    fn digest_of(&self, file: &Path) -> Result<(ArtefactDigest, u64), ArtefactError> {
        let failed = |e| FileError::new("read", file, e);
        let data = std::fs::metadata(file).map_err(failed)?;
        let seen = Seen { bytes: data.len(), modified: data.modified().map_err(failed)? };
        if let Some((_, digest)) = lock(&self.hashed).get(file).filter(|(before, _)| *before == seen) {
            return Ok((*digest, seen.bytes));
        }
        let (digest, bytes) = ArtefactDigest::of_file(file)?;
        let settled = seen.modified.elapsed().is_ok_and(|age| age > SETTLED);
        if settled && bytes == seen.bytes {
            lock(&self.hashed).insert(file.to_owned(), (seen, digest));
        }
        Ok((digest, bytes))
    }

    /// Stores the manifest of a folder, by way of a file in `aside`.
    pub(super) fn store_manifest(
        &self,
        folder: &Path,
        entries: Vec<FolderEntry>,
        aside: &Path,
    ) -> Result<ArtefactDigest, ArtefactError> {
        let manifest = FolderManifest::new(entries);
        let unfit = |reason| ArtefactError::Unfit { path: folder.to_owned(), reason };
        manifest.check(&self.limits).map_err(|e| unfit(e.into()))?;
        let json = manifest.to_json();
        if json.len() as u64 > self.limits.manifest_bytes {
            return Err(unfit(UnfitFolderError::Listing(json.len())));
        }
        let digest = ArtefactDigest::of(&json);
        let file = aside.join(files::unique_name(".segwild-manifest"));
        let stored = files::write_private(&file, &json).map_err(ArtefactError::from);
        let stored = stored.and_then(|()| self.put(&digest, &file));
        // It was ours alone; one that stays is only litter.
        let _ = std::fs::remove_file(&file);
        stored.map(|()| digest)
    }

    /// A folder's manifest, by way of a file in `into`.
    pub(super) fn fetch_manifest(
        &self,
        digest: &ArtefactDigest,
        into: &Path,
    ) -> Result<FolderManifest, ArtefactError> {
        let file = into.join(files::unique_name(".manifest"));
        let most = self.limits.manifest_bytes;
        let refused = |reason: FetchedFolderError| ArtefactError::Manifest { digest: *digest, reason };
        self.store.get(digest, 0..=most, &file).map_err(|error| match error {
            ArtefactError::Long { .. } => refused(FolderManifestError::Long(most).into()),
            other => other,
        })?;
        let read = files::read_within(&file, most);
        // It was ours alone.
        let _ = std::fs::remove_file(&file);
        let json = read.map_err(|e| refused(FetchedFolderError::Unread(e)))?;
        FolderManifest::parse(&json, &self.limits).map_err(|e| refused(e.into()))
    }

    pub(super) fn fetch_files(&self, entries: &[FolderEntry], into: &Path) -> Result<(), ArtefactError> {
        stays_inside(into, |_| true)?;
        each(entries, |entry| self.fetch_file(entry, into)).map(|_| ())
    }

    fn fetch_file(&self, entry: &FolderEntry, into: &Path) -> Result<(), ArtefactError> {
        let to = into.join(&entry.path);
        let there = std::fs::symlink_metadata(&to);
        if there.as_ref().is_ok_and(|data| data.is_dir()) {
            let reason = "a folder is where a file is to be: remove it".into();
            return Err(Stray { path: to, reason }.into());
        }
        let same = there.is_ok_and(|data| data.is_file() && data.len() == entry.bytes);
        if same && self.digest_of(&to)?.0 == entry.digest {
            return Ok(());
        }
        self.store.get(&entry.digest, entry.bytes..=entry.bytes, &to)
    }
}
