//! Selections of a session: `studio/selections/HASH.bin` of a run.

use crate::document::StoredSelection;
use segwild_flow::{FileError, files};
use segwild_pipeline::Selected;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Selections kept in memory at most.
const MOST_IN_MEMORY: usize = 64;

/// The selections of a session.
pub struct SelectionStore {
    folder: PathBuf,
    /// Splats of the scene.
    splats: usize,
    /// Read ones, and when each was last needed.
    read: HashMap<String, (Arc<Selected>, u64)>,
    clock: u64,
}

impl SelectionStore {
    /// The selections in a folder, of a scene of so many splats.
    pub fn new(folder: &Path, splats: usize) -> SelectionStore {
        SelectionStore { folder: folder.to_owned(), splats, read: HashMap::new(), clock: 0 }
    }

    fn path(&self, hash: &str) -> PathBuf {
        self.folder.join(format!("{hash}.bin"))
    }

    /// Writes a selection; the same splats are written once.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn put(&mut self, selected: Selected) -> Result<StoredSelection, FileError> {
        let splats = selected.labels.iter().filter(|label| **label).count();
        let bytes = selected.to_bytes();
        let hash = blake3::hash(&bytes).to_hex()[..32].to_owned();
        let path = self.path(&hash);
        if !path.is_file() {
            std::fs::create_dir_all(&self.folder)
                .map_err(|e| FileError::new("create the folder", &self.folder, e))?;
            files::write_atomic(&path, &bytes)?;
        }
        self.remember(&hash, Arc::new(selected));
        Ok(StoredSelection { hash, splats })
    }

    /// Reads a selection; `None` where its file is missing, damaged, or of another scene.
    pub fn get(&mut self, stored: &StoredSelection) -> Option<Arc<Selected>> {
        self.clock += 1;
        if let Some((selected, used)) = self.read.get_mut(&stored.hash) {
            *used = self.clock;
            return Some(selected.clone());
        }
        // The journal may come from somebody else: a hash is letters and digits, and names no other path.
        let is_hash = stored.hash.len() == 32 && stored.hash.bytes().all(|b| b.is_ascii_hexdigit());
        let bytes = files::read_plain(&self.path(&stored.hash)).ok().filter(|_| is_hash)?;
        if blake3::hash(&bytes).to_hex()[..32] != stored.hash {
            return None;
        }
        let selected = Arc::new(Selected::from_bytes(&bytes, self.splats).ok()?);
        self.remember(&stored.hash, selected.clone());
        Some(selected)
    }

    fn remember(&mut self, hash: &str, selected: Arc<Selected>) {
        self.clock += 1;
        self.read.insert(hash.to_owned(), (selected, self.clock));
        if self.read.len() > MOST_IN_MEMORY {
            let oldest = self.read.iter().min_by_key(|(_, (_, used))| *used).map(|(hash, _)| hash.clone());
            oldest.map(|hash| self.read.remove(&hash));
        }
    }
}
