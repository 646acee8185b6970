//! Dense descriptors: colour and texture of each cell and of the regions around it, at several sizes.
//!
//! Per cell: colour and texture of the cell itself, of two blurs of it, and of the region it lies in at three levels of
//! the tree. Regions make the descriptor the same all over a thing and change at its outline, which plain blurs do not.
//! Colours are the photo's own, with exposure and white point taken out, so that two photos of one scene agree.
//!
//! 106 channels (9 colour, 10 texture, 3 x 29 of regions) on a grid of 64 cells along the long side, SAM's: the feature field's
//! compression is made for that size, and finer cells would see single strokes of texture.

use super::analysis::{Analysis, PixelFeatures};
use super::plane::{FloatPlane, span};
use segwild_scene::Embedding;

/// Cells along the long side, as SAM's (method, section 4).
const LONG: usize = 64;
/// Altitudes at which the region around a cell is described.
const LEVELS: [f32; 3] = [0.12, 0.22, 0.35];
/// Weights of the groups of channels, chosen by how well a click in one photo finds its object in photos under other
/// light by cosine similarity alone. Texture transfers best. Histograms of whole regions transfer worst, for they are many and
/// differ with what the region happens to include; they only keep outlines clean.
const COLOUR: f32 = 0.5;
const TEXTURE: f32 = 1.0;
const REGION: f32 = 0.2;

/// Descriptors of a photo: 106 channels on a grid of 64 cells along the long side.
pub(crate) fn embed(pixels: &PixelFeatures) -> Embedding {
    let tree = &pixels.analysis.tree;
    let (w, h) = (tree.width, tree.height);
    let long = w.max(h);
    let cells = |n: usize| ((n * LONG) as f32 / long as f32).round().max(1.0) as usize;
    let (gw, gh) = (cells(w), cells(h));
    let mut out = Embedding { width: gw, height: gh, channels: 0, data: Vec::new() };
    let mut push = |plane: &[f32], weight: f32, centre: f32| {
        out.channels += 1;
        out.data.extend(plane.iter().map(|v| weight * (v - centre)));
    };
    let normal = [&pixels.normal.l, &pixels.normal.a, &pixels.normal.b];
    for plane in normal {
        let cell = plane.pooled(gw, gh);
        push(&cell.data, COLOUR, 0.5);
        for sigma in [1.0, 2.5] {
            push(&cell.blurred(sigma).data, COLOUR, 0.5);
        }
    }
    for plane in &pixels.texture {
        let cell = plane.pooled(gw, gh);
        push(&cell.blurred(0.8).data, TEXTURE, 0.2);
        push(&cell.blurred(2.0).data, TEXTURE, 0.2);
    }
    for level in LEVELS {
        for plane in region_planes(&pixels.analysis, level, gw, gh) {
            push(&plane.data, REGION, 0.0);
        }
    }
    out
}

/// Histograms (square roots of shares: Hellinger) of the regions at `level`, as cells see them: by the share of the
/// cell that every region covers.
fn region_planes(analysis: &Analysis, level: f32, gw: usize, gh: usize) -> Vec<FloatPlane> {
    let tree = &analysis.tree;
    let regions: Vec<u32> = (0..tree.leaves as u32).map(|l| tree.region_at(l, level)).collect();
    let describe = |region: u32| -> Vec<f32> {
        let node = &tree.nodes[region as usize];
        node.histogram.iter().map(|&v| (v / node.area).max(0.0).sqrt()).collect()
    };
    let described: Vec<Vec<f32>> = regions.iter().map(|&r| describe(r)).collect();
    let channels = tree.nodes[0].histogram.len();
    let mut planes = vec![FloatPlane::zeros(gw, gh); channels];
    for cy in 0..gh {
        let (y0, y1) = span(cy, gh, tree.height);
        for cx in 0..gw {
            let (x0, x1) = span(cx, gw, tree.width);
            let share = 1.0 / ((y1 - y0) * (x1 - x0)) as f32;
            for y in y0..y1 {
                for x in x0..x1 {
                    let leaf = tree.labels[y * tree.width + x] as usize;
                    for (plane, v) in planes.iter_mut().zip(&described[leaf]) {
                        plane.data[cy * gw + cx] += share * v;
                    }
                }
            }
        }
    }
    planes
}
