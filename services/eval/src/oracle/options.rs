//! How good the oracle is.

use serde::{Deserialize, Serialize};

/// The oracle's name as a provider of masks, in records, tables and pages.
pub const ORACLE: &str = "oracle";

/// How good the oracle is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OracleOptions {
    /// Seeds the descriptors and the faults.
    pub seed: u64,
    /// Numbers per cell of an embedding.
    pub channels: usize,
    /// Cells along the long side of a photo.
    pub cells: usize,
    /// Length of a part's descriptor beside its instance's, which is 1.
    pub part_code: f32,
    /// How much all built things are alike, 0 to 1: the mean cosine between the descriptors of two of them. Networks tell a
    /// column from the sky better than from the next column.
    pub embedding_similarity: f32,
    /// Length of the noise on each cell.
    pub noise: f32,
    /// Length of the offset that all cells of a photo share.
    pub offset: f32,
    /// Share of masks that are missing.
    pub drop: f32,
    /// Share of masks that run into a neighbour.
    pub merge: f32,
    /// Most pixels by which a mask's boundary wanders.
    pub wobble: f32,
}

impl Default for OracleOptions {
    fn default() -> Self {
        OracleOptions {
            seed: 1,
            channels: 64,
            cells: 64,
            part_code: 0.35,
            embedding_similarity: 0.0,
            noise: 0.25,
            offset: 0.15,
            drop: 0.10,
            merge: 0.05,
            wobble: 3.0,
        }
    }
}

impl OracleOptions {
    /// An oracle without a fault.
    pub fn perfect() -> OracleOptions {
        OracleOptions {
            noise: 0.0,
            offset: 0.0,
            drop: 0.0,
            merge: 0.0,
            wobble: 0.0,
            ..OracleOptions::default()
        }
    }
}
