//! Dense descriptors of a photo.

use wincode::{SchemaRead, SchemaWrite};

/// What an embedder says of a photo: `channels` numbers per cell of a `width` x `height` grid that covers
/// the photo edge to edge (method, section 4: SAM's 256 x 64 x 64, cropped to the aspect).
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Embedding {
    /// Cells along x.
    pub width: usize,
    /// Cells along y.
    pub height: usize,
    /// Numbers per cell.
    pub channels: usize,
    /// Planar, as [`crate::Image::data`].
    pub data: Vec<f32>,
}
