//! Keeps the photos of a scene in a run's cache, at the size that the run uses.

use super::digests::photo_digest;
use super::keys::photo_key;
use segwild_flow::{Cache, Events, Key};
use segwild_scene::{PackedPhoto, PhotoCache, PhotoStore, Scene, SceneError};
use std::sync::{Arc, OnceLock};

/// Their domain in the cache. Each is decoded again where it is missing, so that nothing is lost with them.
const PHOTOS: &str = "photo";

/// A cache that keeps photos by the hash of their files.
pub(crate) struct RunPhotoCache {
    cache: Cache,
    scene: Arc<Scene>,
    size: u32,
    /// Per view, once it is known, the hash of its files.
    digests: Vec<OnceLock<String>>,
}

impl RunPhotoCache {
    /// The photos of a scene at a long side of so many pixels.
    pub fn new(cache: Cache, scene: &Arc<Scene>, size: u32) -> RunPhotoCache {
        let digests = scene.views.iter().map(|_| OnceLock::new()).collect();
        RunPhotoCache { cache, scene: scene.clone(), size, digests }
    }

    /// A store of these photos that keeps up to `most_bytes` in memory as well.
    pub fn store(self: &Arc<RunPhotoCache>, most_bytes: usize) -> PhotoStore {
        PhotoStore::new(self.scene.clone(), self.size, most_bytes).with_cache(self.clone())
    }

    /// Warns of each damaged record.
    pub fn warn_of_damage(&self, events: &Events) {
        let events = events.clone();
        self.cache.on_damage(move |_, reason| {
            let words =
                format!("the cache's record of a photo was damaged ({reason}): its file is decoded again");
            events.warn(Some("ingest"), words);
        });
    }

    /// The hash of a photo's files.
    ///
    /// # Errors
    /// When they cannot be read.
    pub fn digest(&self, view: usize) -> Result<String, SceneError> {
        if let Some(known) = self.digests[view].get() {
            return Ok(known.clone());
        }
        let digest = photo_digest(&self.scene.views[view])?;
        // Another thread may have been first, with the same hash.
        let _ = self.digests[view].set(digest.clone());
        Ok(digest)
    }

    fn key(&self, view: usize) -> Option<Key> {
        let digest = self.digest(view).ok()?;
        Some(photo_key(PHOTOS, &digest, &self.scene.views[view], self.size, ""))
    }
}

impl PhotoCache for RunPhotoCache {
    fn photo(&self, view: usize) -> Option<PackedPhoto> {
        // A record that cannot be read counts as missing.
        self.cache.get_typed(&self.key(view)?, PHOTOS).ok().flatten()
    }

    fn keep(&self, view: usize, photo: &PackedPhoto) {
        let Some(key) = self.key(view) else { return };
        if let Err(error) = self.cache.put_typed(&key, PHOTOS, photo) {
            let name = &self.scene.views[view].name;
            tracing::warn!(
                "photo {name} is not kept at its size, so that its file is decoded again: {error}"
            );
        }
    }
}
