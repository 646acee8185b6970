//! The objects of a scene, without a click: the parts of its tree as a list with names, and their export.

mod bounds;
mod coco;
mod export;
mod list;
mod npy;
mod sheet;

pub(crate) use bounds::bounds;
pub use export::ExportedObjects;
pub(crate) use export::{coco_masks, write_objects};
pub(crate) use list::{ListRequest, SHOWS, whole_pixels};
pub use list::{ListedObjects, ObjectList, SceneObject, SeenOnceShare};
