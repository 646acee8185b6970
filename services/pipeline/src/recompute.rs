//! What a run has made once and reads again.

use segwild_flow::codec::{Decode, Encode};
use segwild_flow::{Cache, Events, Failure, Key};
use segwild_scene::Scene;
use std::sync::Arc;

/// One artefact of a photo.
#[derive(Clone, Copy)]
pub struct Kept<'a> {
    /// Index of the photo.
    pub view: usize,
    /// What it is, in words.
    pub what: &'static str,
    /// The kind of its record.
    pub kind: &'static str,
    /// Its name.
    pub key: &'a Key,
}

/// Reads artefacts of photos out of the cache. One that was made and has been damaged since is made anew, and is never
/// taken for one that was given up: what is made from it is named by its key.
#[derive(Clone)]
pub struct Recompute {
    /// The scene.
    pub scene: Arc<Scene>,
    /// Where the artefacts are.
    pub cache: Cache,
    /// Told of those that have gone; of damaged ones the cache tells ([`Cache::on_damage`]).
    pub events: Events,
}

impl Recompute {
    /// Reads an artefact, or makes it as it was made first.
    ///
    /// # Errors
    /// When the disk refuses, or when it cannot be made again: then nothing helps, and the run is to end.
    pub fn read<T: Encode + Decode>(
        &self,
        kept: Kept<'_>,
        make: impl FnOnce() -> Result<T, Failure>,
    ) -> Result<T, Failure> {
        let Kept { view, what, kind, key } = kept;
        if let Some(value) = self.cache.get_typed(key, kind)? {
            return Ok(value);
        }
        let photo = &self.scene.views[view].name;
        if !self.cache.was_damaged(key) {
            let message = format!("the {what} of photo {photo} has gone from the cache: it is made anew");
            self.events.warn(None, message);
        }
        let value = make().map_err(|failure| match failure.is_local() {
            true => Failure::fatal(format!(
                "photo {photo}: its {what} has gone from the cache and cannot be made again ({failure}); run again"
            )),
            false => failure,
        })?;
        self.cache.put_typed(key, kind, &value)?;
        Ok(value)
    }
}
