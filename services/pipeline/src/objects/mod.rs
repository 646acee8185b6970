//! The objects of a scene, without a click: the scene tree, its parts as a list with names, and their export.

mod coco;
mod export;
mod list;
mod sheet;
mod tree;

pub use export::{ExportedObjects, export_objects, list_objects};
pub(crate) use list::ListRequest;
pub use list::{ObjectList, SceneObject};
pub(crate) use tree::{OBJECTS, TreeSource, tree_key};
