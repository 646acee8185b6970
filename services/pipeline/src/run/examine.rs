//! Which photos a run can use: each is read once, within the memory budget, with the corrected mask of its transients.

use super::memory;
use crate::artifacts::digests::Digests;
use crate::transients::Corrections;
use crate::{RunError, Settings};
use segwild_scene::{PhotoStore, SceneError};

/// Examines every photo of the store. `digest` is the hash of a view's files.
///
/// # Errors
/// As [`Digests::read`].
pub fn examine_photos(
    photos: &PhotoStore,
    digest: &(dyn Fn(usize) -> Result<String, SceneError> + Sync),
    settings: &Settings,
    corrections: &Corrections,
    stopping: &(dyn Fn() -> bool + Sync),
) -> Result<Digests, RunError> {
    let scene = photos.scene();
    let limit = memory::decoding_limit(settings, scene);
    let within_budget = |view: usize| {
        memory::fits_budget(settings, &scene.views[view], limit)?;
        Ok(digest(view)?)
    };
    Ok(Digests::read(photos, &within_budget, settings, stopping)?.without(corrections.unusable()))
}
