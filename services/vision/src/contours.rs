//! Nested regions of a boundary map: an ultrametric contour map (Arbelaez et al., PAMI 2011) by average linkage over the
//! basins of the map (method, section 13).

use crate::builtin::{FloatPlane, basins, neighbours};
use crate::linkage::{LinkageCost, LinkageEdge, MergeTree, agglomerate};
use segwild_scene::Image;
use std::collections::BTreeMap;

/// Basins of fewer pixels join a neighbour.
const LEAST_BASIN: usize = 4;

/// The nested regions of one view.
#[derive(Clone, Debug, PartialEq)]
pub struct ContourTree {
    /// Per pixel, row by row, the leaf of `merges` that holds it.
    pub labels: Vec<u32>,
    /// The regions; heights are mean boundary strengths, in [0, 1].
    pub merges: MergeTree,
}

impl ContourTree {
    /// The regions of a boundary map, one plane of strengths in [0, 1].
    pub fn of(strength: &Image) -> ContourTree {
        let (w, h) = (strength.width, strength.height);
        let strength = FloatPlane::new(w, h, strength.plane(0).to_vec());
        let (labels, count) = basins(&strength, LEAST_BASIN);
        let mut sides: BTreeMap<(u32, u32), (f32, f32)> = BTreeMap::new();
        let mut areas = vec![0.0; count];
        for i in 0..w * h {
            areas[labels[i] as usize] += 1.0;
            for j in neighbours(i, w, h).filter(|&j| j > i && labels[j] != labels[i]) {
                let side = sides.entry((labels[i].min(labels[j]), labels[i].max(labels[j]))).or_default();
                let side_strength = strength.data[i].max(strength.data[j]);
                *side = (side.0 + side_strength, side.1 + 1.0);
            }
        }
        let edge = |(&(a, b), &(sum, length)): (&(u32, u32), &(f32, f32))| LinkageEdge {
            a,
            b,
            distance: sum / length,
            weight: length,
        };
        ContourTree { labels, merges: agglomerate(&areas, sides.iter().map(edge), LinkageCost::AVERAGE) }
    }

    /// The height at which two pixels' regions merge: 0 within one region, up to 1.
    pub fn height(&self, a: usize, b: usize) -> f32 {
        self.merges.height[self.merges.meet(self.labels[a], self.labels[b]) as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_merge_at_the_strength_of_their_common_contour() {
        // Three bands: a weak contour, then a strong one.
        let (w, h) = (60, 20);
        let at = |x: usize| match x {
            20 => 0.3,
            40 => 0.9,
            _ => 0.0,
        };
        let data = (0..w * h).map(|i| at(i % w)).collect();
        let tree = ContourTree::of(&Image { width: w, height: h, channels: 1, data });
        let row = 10 * w;
        assert_eq!(tree.height(row + 5, row + 15), 0.0);
        assert!((tree.height(row + 5, row + 30) - 0.3).abs() < 0.02);
        assert!((tree.height(row + 30, row + 55) - 0.9).abs() < 0.02);
        assert!((tree.height(row + 5, row + 55) - 0.9).abs() < 0.02);
    }
}
