//! Dense descriptors of a photo.

use crate::whole::read_whole;
use wincode::SchemaWrite;

/// Dense descriptors of a photo: `channels` numbers per cell of a `width` x `height` grid that covers
/// the photo edge to edge (docs/method.md, section 4: SAM's 256 x 64 x 64, cropped to the aspect).
#[derive(Clone, Debug, PartialEq, SchemaWrite)]
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

read_whole!(
    Embedding as EmbeddingRecord { width: usize, height: usize, channels: usize, data: Vec<f32> }
    where |e| crate::image::fills(&e.data, [e.width, e.height, e.channels]),
    "an embedding has another number of cells"
);
