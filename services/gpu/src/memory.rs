//! How much of an accelerator's memory a training takes, before it starts.

use crate::compare::LENGTH;
use crate::engine::TILE;
use segwild_raster::GswWidth;

/// Pairs of a splat and a tile that splats have where there are many of them, each.
const PAIRS_PER_SPLAT: f64 = 8.0;
/// And that a tile has where there are few and large ones: few splats cover many tiles each.
const PAIRS_PER_TILE: f64 = 600.0;
/// Bytes per pair: twice its tile and its place while they are sorted, its splat, its entry, sums and moments, and a share
/// of what is kept at every bucket.
const PER_PAIR: f64 = 124.0;
/// Numbers of a splat beside its harmonics and codes, as the device lays them out.
const SHAPE: f64 = 12.0;
/// Copies of what is trained: parameters, two moments, gradients.
const COPIES: f64 = 4.0;
/// Bytes per splat beside these: footprint, depth and centre, sort keys and order, colours, sums.
const PER_SPLAT: f64 = 170.0;
/// Bytes per pixel: image, what is shown, residuals, weights, likeness, gradients, errors.
const PER_PIXEL: f64 = 124.0;
/// Buffers are a quarter longer than what is in them.
const AMPLE: f64 = 1.25;
/// Bytes of photos that stay from step to step, if no budget says less: least, and most.
pub const LEAST_PHOTOS: u64 = 8 << 20;
const MOST_PHOTOS: u64 = 1 << 30;

/// How many bytes of photos stay on the device within a budget for everything; 0 is none.
pub(crate) fn photos_kept(budget: u64) -> u64 {
    if budget == 0 { MOST_PHOTOS } else { (budget / 8).clamp(LEAST_PHOTOS, MOST_PHOTOS) }
}

/// Whether channels of so many bytes may stay on the device: a quarter of a budget for everything is theirs, so that views
/// find room beside them.
pub(crate) fn keeps_channels(bytes: u64, budget: u64) -> bool {
    budget == 0 || bytes <= budget / 4
}

/// Whether what learns from views, or is added up over them, may be on the device with so many bytes: half of a budget for
/// everything.
pub(crate) fn settles(bytes: u64, budget: u64) -> bool {
    budget == 0 || bytes <= budget / 2
}

/// About how many bytes of an accelerator's memory it takes to train so many splats on photos of so many pixels, beside
/// the photos that stay there. `embedding_size` are the numbers that splats keep for their look, `networks` those of the look `gsw`.
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
