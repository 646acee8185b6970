//! The scene tree of a run: grown once from the trained scene and its photos, and kept in the run's cache (method, section 13).

use crate::RunError;
use segwild_flow::{Cache, Key};
use segwild_scene::PhotoStore;
use segwild_segmenter::PosedView;
use segwild_segmenter::scene_tree::{SceneTree, TreeBuilder};
use segwild_trainer::Model;
use segwild_vision::PromptSegmenter;

/// Its domain in the cache, the kind of its record, and the name under which the ledger says that the run uses it.
pub(crate) const OBJECTS: &str = "objects";

/// Raised when the bytes of a tree of the same input change.
const FORMAT: u32 = 3;

/// Name of the tree of a trained scene, whose boundaries `segmenter` finds.
pub(crate) fn tree_key(geometry: &str, segmenter: &str) -> Key {
    Key::of(OBJECTS).value("format", FORMAT).part("geometry", geometry).part("segmenter", segmenter).finish()
}

/// Where trees come from.
pub(crate) struct TreeSource<'a> {
    /// The photos.
    pub photos: &'a PhotoStore,
    /// The trained scene.
    pub model: &'a Model,
    /// Key of the trained scene.
    pub geometry: &'a str,
    /// Finds boundaries in photos.
    pub segmenter: &'a dyn PromptSegmenter,
}

impl TreeSource<'_> {
    /// Name of the tree.
    pub fn key(&self) -> Key {
        tree_key(self.geometry, &self.segmenter.key())
    }

    /// Reads the tree from the cache, or grows it. `None` where the segmenter finds objects by itself. Photos that cannot be read,
    /// those held out, and those that see nothing but what enough others see take no part; the last are only counted
    /// ([`SceneTree::shown_by`]).
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
        let mut builder = TreeBuilder::new(splats, self.model.options());
        let mut seen = false;
        let views = self.photos.scene().views.iter().enumerate();
        let views: Vec<_> = views.filter(|(_, view)| !view.test).collect();
        for (index, view) in TreeBuilder::order(views.len()).into_iter().map(|at| views[at]) {
            if stopping() {
                return Err(RunError::Interrupted);
            }
            let camera = view.camera.scaled_to(self.photos.long_side());
            let (width, height) = (camera.width as usize, camera.height as usize);
            let view = builder.see(&PosedView::from(view), width, height)?;
            if !builder.needs(&view) {
                builder.count(&view);
                continue;
            }
            let Ok(photo) = self.photos.read(index) else { continue };
            let Some(boundaries) = self.segmenter.boundary_strengths(&photo.image)? else { return Ok(None) };
            builder.add(view, &boundaries);
            seen = true;
        }
        if !seen || stopping() {
            return Ok(None);
        }
        let tree = builder.grow();
        if let Err(error) = cache.put_typed(&key, OBJECTS, &tree) {
            tracing::warn!("the scene tree is not kept, so that each click grows it again: {error}");
        }
        Ok(Some(tree))
    }
}
