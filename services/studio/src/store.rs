//! Selections and corrected masks of a session: `studio/selections/HASH.bin` and `HASH.png` of a run.

use crate::document::StoredSelection;
use segwild_flow::{FileError, files};
use segwild_pipeline::Selected;
use segwild_scene::{Mask, SceneError};
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
        if !is_hash(&stored.hash) {
            return None;
        }
        let bytes = files::read_plain(&self.path(&stored.hash)).ok()?;
        if blake3::hash(&bytes).to_hex()[..32] != stored.hash {
            return None;
        }
        let selected = Arc::new(Selected::from_bytes(&bytes, self.splats).ok()?);
        self.remember(&stored.hash, selected.clone());
        Some(selected)
    }

    /// Writes a mask of transients; returns its name.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn put_mask(&self, mask: &Mask) -> Result<String, SceneError> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(format!("{} {}", mask.width(), mask.height()).as_bytes());
        mask.pixels().for_each(|(x, y)| {
            hasher.update(&[x.to_le_bytes(), y.to_le_bytes()].concat());
        });
        let name = hasher.finalize().to_hex()[..32].to_owned();
        let path = self.mask_path(&name);
        if !path.is_file() {
            mask.write_png(&path)?;
        }
        Ok(name)
    }

    /// Reads a mask of transients; `None` where its file is missing or damaged.
    pub fn mask(&self, name: &str) -> Option<Mask> {
        is_hash(name).then(|| Mask::read_png(&self.mask_path(name)).ok())?
    }

    fn mask_path(&self, name: &str) -> PathBuf {
        self.folder.join(format!("{name}.png"))
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

/// Whether a name is a hash. A journal may come from somebody else: letters and digits name no other path.
fn is_hash(name: &str) -> bool {
    name.len() == 32 && name.bytes().all(|b| b.is_ascii_hexdigit())
}
