//! The photos of a session, decoded once: every click reads all of them, round after round.

use segwild_scene::{Image, Scene};
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Bytes of decoded photos that are kept; the newest is kept whatever its size.
pub(super) const MOST_BYTES: usize = 192 << 20;

/// Photos at working size, those that were read last.
pub(super) struct DecodedPhotos {
    scene: Arc<Scene>,
    /// Long side in pixels.
    size: u32,
    /// The latest is the last.
    kept: Mutex<VecDeque<(usize, Arc<Image>)>>,
}

impl DecodedPhotos {
    /// The photos of a scene at a long side of `size` pixels.
    pub fn new(scene: Arc<Scene>, size: u32) -> DecodedPhotos {
        DecodedPhotos { scene, size, kept: Mutex::default() }
    }

    fn kept(&self) -> MutexGuard<'_, VecDeque<(usize, Arc<Image>)>> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A photo; the error is a sentence that says why it cannot be read.
    pub fn read(&self, view: usize) -> Result<Image, String> {
        let known = {
            let mut kept = self.kept();
            let at = kept.iter().position(|(other, _)| *other == view);
            at.and_then(|at| kept.remove(at)).inspect(|found| kept.push_back(found.clone()))
        };
        if let Some((_, image)) = known {
            return Ok((*image).clone());
        }
        let image = self.scene.views[view].load(self.size).map_err(|e| e.to_string())?.image;
        let mut kept = self.kept();
        kept.push_back((view, Arc::new(image.clone())));
        let bytes = |kept: &VecDeque<(usize, Arc<Image>)>| -> usize {
            kept.iter().map(|(_, image)| 4 * image.data.len()).sum()
        };
        while kept.len() > 1 && bytes(&kept) > MOST_BYTES {
            kept.pop_front();
        }
        Ok(image)
    }
}
