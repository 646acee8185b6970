//! The objects of a scene, without a click: the scene tree, its parts as a list with names, and their export.

mod coco;
mod export;
mod list;
mod sheet;
mod tree;

pub(crate) use export::coco_masks;
pub use export::{ExportedObjects, export_objects, list_objects};
pub(crate) use list::ListRequest;
pub use list::{ListedObjects, ObjectList, SceneObject};
pub(crate) use tree::{OBJECTS, TreeSource, tree_key};

use segwild_scene::Mask;

/// The first column and row of a mask's pixels, and those after the last; `None` where it is empty.
fn bounds(mask: &Mask) -> Option<([u32; 2], [u32; 2])> {
    mask.pixels().fold(None, |bounds, (x, y)| {
        let (low, high) = bounds.unwrap_or(([x, y], [x, y]));
        Some(([low[0].min(x), low[1].min(y)], [high[0].max(x + 1), high[1].max(y + 1)]))
    })
}
