//! The scene tree of a run: grown once from the trained scene and its photos, and kept in the run's cache (method, section 13).

use super::photo_boundaries::{MaskKeys, PhotoBoundaries, PhotoCue};
use crate::RunError;
use segwild_flow::{Cache, Key, KeyBuilder};
use segwild_scene::PhotoStore;
use segwild_segmenter::PosedView;
use segwild_segmenter::scene_tree::{SceneTree, TreeBuilder};
use segwild_trainer::Model;

/// Its domain in the cache, the kind of its record, and the name under which the ledger says that the run uses it.
pub(crate) const OBJECTS: &str = "objects";

/// Raised when the bytes of a tree of the same input change.
const FORMAT: u32 = 6;

/// Long side in pixels at which views are compared and their boundaries found, at most (method, section 13): the constants of
/// boundaries and ranking are of this size. At 640 px stone and bricks have boundaries that part what belongs together
/// (docs/experiments/2026-11-30-size-of-the-tree.md).
const TREE_SIZE: u32 = 320;

/// Name of the tree of a trained scene, whose boundaries `segmenter` finds.
pub(crate) fn tree_key(geometry: &str, segmenter: &str) -> Key {
    Key::of(OBJECTS).value("format", FORMAT).part("geometry", geometry).part("segmenter", segmenter).finish()
}

/// Name of the tree of a trained scene, whose boundaries are the outlines of these masks.
pub(crate) fn masked_tree_key(geometry: &str, masks: &MaskKeys) -> Key {
    let key = Key::of(OBJECTS).value("format", FORMAT).part("geometry", geometry);
    let add = |key: KeyBuilder, (view, masks): (&usize, &Option<Key>)| {
        let name = format!("masks {view}");
        match masks {
            Some(masks) => key.key(&name, masks),
            None => key.part(&name, "given up"),
        }
    };
    masks.iter().fold(key, add).finish()
}

/// Where trees come from.
pub(crate) struct TreeSource<'a> {
    /// The photos.
    pub photos: &'a PhotoStore,
    /// The trained scene.
    pub model: &'a Model,
    /// Key of the trained scene.
    pub geometry: &'a str,
    /// Boundaries in the photos.
    pub boundaries: PhotoBoundaries<'a>,
}

impl TreeSource<'_> {
    /// Name of the tree.
    pub fn key(&self) -> Key {
        match &self.boundaries {
            PhotoBoundaries::Model(segmenter) => tree_key(self.geometry, &segmenter.key()),
            PhotoBoundaries::Masks { keys, .. } => masked_tree_key(self.geometry, keys),
        }
    }

    /// Reads the tree from the cache, or grows it. `None` where the boundaries of a photo that it needs are not there. Photos that
    /// cannot be read, those held out, those without masks where it is grown from masks, and those that see nothing but what enough
    /// others see take no part; the last two are only counted ([`SceneTree::shown_by`]).
    ///
    /// # Errors
    /// When the scene cannot be rendered, the cache cannot be read, or `stopping` returns true.
    pub fn tree(&self, cache: &Cache, stopping: &dyn Fn() -> bool) -> Result<Option<SceneTree>, RunError> {
        let key = self.key();
        let splats = &self.model.splats;
        if let Some(kept) =
            cache.get_typed::<SceneTree>(&key, OBJECTS)?.filter(|tree| tree.fits(splats.len()))
        {
            return Ok(Some(kept));
        }
        if self.boundaries.is_empty() {
            return Ok(None);
        }
        let mut builder = TreeBuilder::new(splats, self.model.options());
        let mut seen = false;
        let views = self.photos.scene().views.iter().enumerate();
        let views: Vec<_> =
            views.filter(|(index, _)| self.model.trained_on.contains(&(*index as u32))).collect();
        for (index, view) in TreeBuilder::order(views.len()).into_iter().map(|at| views[at]) {
            if stopping() {
                return Err(RunError::Interrupted);
            }
            let view =
                PosedView { camera: view.camera.scaled_to(self.photos.long_side()), ..PosedView::from(view) };
            let small = view.camera.scaled_to(TREE_SIZE);
            let (width, height) = (small.width as usize, small.height as usize);
            let view = builder.see(&view, width, height)?;
            if !builder.needs(&view) {
                builder.count(&view);
                continue;
            }
            match self.boundaries.of(self.photos, index, width, height)? {
                PhotoCue::Strengths(strengths) => builder.add(view, &strengths),
                PhotoCue::LeftOut => continue,
                PhotoCue::OnlyCounted => {
                    builder.count(&view);
                    continue;
                }
                PhotoCue::Missing => return Ok(None),
            }
            seen = true;
        }
        if stopping() {
            return Err(RunError::Interrupted);
        }
        if !seen {
            return Ok(None);
        }
        let tree = builder.grow();
        if let Err(error) = cache.put_typed(&key, OBJECTS, &tree) {
            tracing::warn!("the scene tree is not kept, so that each click grows it again: {error}");
        }
        Ok(Some(tree))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tree_by_masks_is_named_by_each_of_them() {
        let masks = |settings: &str| Key::of("masks").part("settings", settings).finish();
        let of = |second: Option<Key>| {
            masked_tree_key("geometry:1", &MaskKeys::from([(0, Some(masks("a"))), (2, second)]))
        };
        let key = of(Some(masks("b")));
        assert_eq!(key, of(Some(masks("b"))));
        let others = [
            of(Some(masks("c"))),
            of(None),
            masked_tree_key("geometry:1", &MaskKeys::from([(0, Some(masks("a")))])),
            masked_tree_key("geometry:1", &MaskKeys::from([(0, Some(masks("a"))), (3, Some(masks("b")))])),
            masked_tree_key("geometry:2", &MaskKeys::from([(0, Some(masks("a"))), (2, Some(masks("b")))])),
            tree_key("geometry:1", "sam"),
        ];
        assert!(others.iter().all(|other| *other != key));
    }
}
