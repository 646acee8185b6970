//! Estimates an accelerator's memory that a training takes, before it starts.

use crate::compare::{LENGTH, SsimDerivatives};
use crate::groups::TILE;
use segwild_objective::GswWidth;

/// Pairs of a splat and a tile per splat, where there are many splats.
const PAIRS_PER_SPLAT: f64 = 8.0;
/// And per tile, where splats are few and large: each covers many tiles.
const PAIRS_PER_TILE: f64 = 600.0;
/// Bytes per pair: twice its tile and its index while they are sorted, its splat, its entry, sums and moments, and a
/// share of what is kept at every bucket.
const PER_PAIR: f64 = 124.0;
/// Numbers of a splat beside its harmonics and embedding, as the device lays them out.
const SHAPE: f64 = 12.0;
/// Copies of what is trained: parameters, two moments, gradients.
const COPIES: f64 = 4.0;
/// Bytes per splat beside these: footprint, depth and centre, sort keys and order, colours, sums.
const PER_SPLAT: f64 = 170.0;
/// Bytes per pixel: image, shown colours, residuals, weights, SSIM, gradients, errors.
const PER_PIXEL: f64 = 144.0;
/// Buffers are a quarter longer than what is in them.
const AMPLE: f64 = 1.25;
/// Estimated bytes of an accelerator's memory to train so many splats on photos of so many pixels, without the photos
/// that stay there. `embedding_size` is the length of a splat's appearance embedding, `networks` the width of the
/// networks of the appearance model `gsw`.
pub fn training_bytes(
    splats: usize,
    pixels: usize,
    sh_degree: u32,
    embedding_size: usize,
    networks: Option<GswWidth>,
) -> u64 {
    let (n, pixels) = (splats as f64, pixels as f64);
    let harmonics = 3.0 * f64::from((sh_degree + 1).pow(2));
    let splat_embeddings = embedding_size as f64;
    let tiles = (pixels / f64::from(TILE * TILE)).ceil();
    let pairs = (n * PAIRS_PER_SPLAT).max((tiles * PAIRS_PER_TILE).min(n * tiles));
    let bytes = n * (4.0 * (SHAPE + harmonics + splat_embeddings) * COPIES + PER_SPLAT)
        + pairs * PER_PAIR
        + pixels * PER_PIXEL
        + networks.map_or(0, |width| crate::nets::bytes(width, splats)) as f64
        + 4.0 * LENGTH as f64;
    (AMPLE * bytes) as u64
}

/// Bytes of the longest array that training on photos of so many pixels takes: the derivatives of SSIM. An accelerator binds an array
/// whole or not at all: on one that binds less ([`Adapter::binding`](crate::Adapter::binding)) such a training ends at its first step.
pub fn longest_of_photo(pixels: usize) -> u64 {
    (pixels * size_of::<SsimDerivatives>()) as u64
}
