//! The scene tree of a run, from what the run has made.

use super::inputs::Inputs;
use super::stage::Stage;
use crate::RunError;
use crate::artifacts::photo_boundaries::{MaskKeys, PhotoBoundaries};
use crate::artifacts::scene_tree::TreeSource;
use segwild_features::FieldInputs;
use segwild_flow::Key;
use segwild_scene::MaskSet;
use segwild_vision::PromptSegmenter;

/// The scene tree of the trained scene, `geometry` its key. Where it is grown from masks, this waits until it is known of every
/// photo if it has any: the tree's key names them.
///
/// # Errors
/// When `stopping` returns true first.
pub fn tree_source<'a>(
    inputs: &'a Inputs,
    geometry: &'a str,
    segmenter: &'a dyn PromptSegmenter,
    stopping: &'a dyn Fn() -> bool,
) -> Result<TreeSource<'a>, RunError> {
    let boundaries = match segmenter.finds_objects() {
        true => outlines(inputs, stopping)?,
        false => PhotoBoundaries::Model(segmenter),
    };
    Ok(TreeSource { photos: &inputs.photos, model: &inputs.model, geometry, boundaries })
}

/// The outlines of the masks that the stage `masks` makes; masks that have gone from the cache are made again.
fn outlines<'a>(inputs: &'a Inputs, stopping: &'a dyn Fn() -> bool) -> Result<PhotoBoundaries<'a>, RunError> {
    let views = &inputs.recompute.scene.views;
    let keys_of = &inputs.keys;
    let takes_part = |view: &usize| {
        !views[*view].test && keys_of.unreadable(*view).is_none() && keys_of.is_described(*view)
    };
    let mut keys = MaskKeys::new();
    for view in (0..views.len()).filter(takes_part) {
        let known = inputs.masks_known.wait(view, stopping).ok_or(RunError::Interrupted)?;
        keys.insert(view, known.then(|| inputs.keys.masks[view]));
    }
    let read = move |view: usize, _: &Key| -> Result<Option<MaskSet>, RunError> {
        inputs.masks(view, stopping).map_err(|failure| match stopping() {
            true => RunError::Interrupted,
            false => RunError::of_stage(Stage::Masks.name(), &failure),
        })
    };
    Ok(PhotoBoundaries::Masks { keys, read: Box::new(read) })
}
