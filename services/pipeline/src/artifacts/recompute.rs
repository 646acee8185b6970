//! Reads artefacts that the run has made before, and makes them again where the cache has lost them.

use segwild_flow::codec::{Decode, Encode};
use segwild_flow::{ActorFailure, Cache, Events, Key};
use segwild_scene::Scene;
use std::sync::Arc;

/// One artefact of a photo.
#[derive(Clone, Copy)]
pub struct CachedArtefact<'a> {
    /// Index of the photo.
    pub view: usize,
    /// What it is, in words.
    pub what: &'static str,
    /// The kind of its record.
    pub kind: &'static str,
    /// Its key.
    pub key: &'a Key,
}

/// Reads artefacts of photos from the cache. An artefact that has been damaged since it was made is made again, and is
/// never taken for one that was given up: the keys of what is made from it depend on it.
#[derive(Clone)]
pub struct Recompute {
    /// The scene.
    pub scene: Arc<Scene>,
    /// Where the artefacts are.
    pub cache: Cache,
    /// Receives a warning for each artefact that has gone. Damaged ones are reported by the cache ([`Cache::on_damage`]).
    pub events: Events,
}

impl Recompute {
    /// Reads an artefact, or makes it as it was made first.
    ///
    /// # Errors
    /// When the disk fails, or when the artefact cannot be made again. That failure is fatal, and the run ends.
    pub fn read<T: Encode + Decode>(
        &self,
        kept: CachedArtefact<'_>,
        make: impl FnOnce() -> Result<T, ActorFailure>,
    ) -> Result<T, ActorFailure> {
        let CachedArtefact { view, what, kind, key } = kept;
        if let Some(value) = self.cache.get_typed(key, kind)? {
            return Ok(value);
        }
        let photo = &self.scene.views[view].name;
        if !self.cache.was_damaged(key) {
            let message = format!("the {what} of photo {photo} has gone from the cache: it is made again");
            self.events.warn(None, message);
        }
        let value = make().map_err(|failure| match failure.is_local() {
            true => ActorFailure::fatal(format!(
                "photo {photo}: its {what} has gone from the cache and cannot be made again ({failure}); run again"
            )),
            false => failure,
        })?;
        self.cache.put_typed(key, kind, &value)?;
        Ok(value)
    }
}
