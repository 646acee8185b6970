//! Masks at given points, up to three nested ones each, as SAM's three outputs.

use super::analysis::Analysis;
use super::candidates::around;
use super::pool::set_of;
use super::shape::{SetShape, SuperpixelPositions};
use super::tree::Hierarchy;
use segwild_scene::ScoredMask;

/// How far the threshold on altitudes is moved to tell stable regions from ephemeral ones, as a share of it.
const REACH: f32 = 0.055;
/// Likeness to a thing from which a region has a predicted IoU of 0.88, and how fast that rises to 1.
const LIKELY: f32 = 17.0;
const SPREAD: f32 = 5.0;

/// Masks that the points lie in; a region that several points ask for is given once. Points outside are skipped.
pub(crate) fn propose(analysis: &Analysis, points: &[[f32; 2]]) -> Vec<ScoredMask> {
    let total = (analysis.tree.width * analysis.tree.height) as f32;
    let mut regions = Vec::new();
    for &[x, y] in points {
        let Some(leaf) = analysis.tree.leaf_at(x, y) else { continue };
        // The three best-standing regions around the point, of any tree, that differ enough in size.
        let mut candidates = around(analysis, leaf);
        candidates.retain(|c| c.area >= 16.0 && c.area <= 0.9 * total);
        candidates
            .sort_by(|a, b| b.score.total_cmp(&a.score).then((a.tree, a.region).cmp(&(b.tree, b.region))));
        let mut taken: Vec<f32> = Vec::new();
        for c in candidates {
            if taken.len() < 3 && taken.iter().all(|&t| t.min(c.area) < 0.7 * t.max(c.area)) {
                taken.push(c.area);
                regions.push((c.tree, c.region, leaf));
            }
        }
    }
    regions.sort_unstable();
    regions.dedup_by_key(|r| (r.0, r.1));
    let trees: Vec<&Hierarchy> = analysis.trees().collect();
    let positions = SuperpixelPositions::of(analysis);
    let mut masks: Vec<ScoredMask> = Vec::new();
    for (k, r, leaf) in regions {
        let mask = scored(analysis, &positions, trees[k], r, leaf);
        // Two trees often agree on a region.
        if masks.iter().all(|m| m.mask != mask.mask) {
            masks.push(mask);
        }
    }
    masks
}

/// A region as a mask, scored by the middle of its life: between the altitude at which it comes to be and the one at which
/// its parent does.
fn scored(
    analysis: &Analysis,
    positions: &SuperpixelPositions,
    tree: &Hierarchy,
    region: u32,
    leaf: u32,
) -> ScoredMask {
    let node = &tree.nodes[region as usize];
    let parent = &tree.nodes[node.parent as usize];
    let shape = SetShape::of(analysis, positions, &set_of(tree, region));
    let likeness = shape.likeness(shape.middle);
    let middle = 0.5 * (node.altitude + parent.altitude);
    let area = |altitude: f32| tree.nodes[tree.region_at(leaf, altitude) as usize].area;
    // How much the region changes when the threshold moves either way. What outlives the move is stable; how little of
    // its size comes and goes is what counts for the others.
    let kept = area(middle * (1.0 - REACH)) / area(middle * (1.0 + REACH));
    ScoredMask {
        mask: tree.region_mask(region),
        predicted_iou: (1.0 - 0.12 * ((LIKELY - likeness) / SPREAD).exp()).max(0.0),
        stability: kept.min(1.0),
    }
}
