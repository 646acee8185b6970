//! What comes of a run: renders, appearances, scores, the list of objects, the report.

pub(crate) mod bake;
pub(crate) mod camera_path;
pub(crate) mod cover;
pub(crate) mod evaluate;
mod foreign_photo;
pub(crate) mod light;
pub(crate) mod object_masks;
pub(crate) mod objects;
pub(crate) mod provenance;
pub(crate) mod render;
pub(crate) mod report;
pub(crate) mod splat_files;
pub(crate) mod text_query;
pub(crate) mod video;
pub(crate) mod without;
