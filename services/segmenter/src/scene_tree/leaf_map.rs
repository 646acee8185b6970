//! Which leaf of the scene tree each pixel of a view shows: the pixels of every group of the tree, nested or not.

use super::front_values::front_values;
use super::{GroupCandidate, NONE, SceneTree};
use crate::PosedView;
use segwild_raster::{CpuEngine, ProjectOptions, RasterError};
use segwild_scene::{Mask, Splats};

/// The leaf that each pixel of a view shows.
#[derive(Clone, Debug, PartialEq)]
pub struct LeafMap {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Per pixel, row by row, the leaf; [`NONE`] where it shows none.
    pub leaves: Vec<u32>,
}

/// The pixels of a view that show a group.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ShownPixels {
    /// All of them.
    pub all: u32,
    /// Those on the frame.
    pub on_frame: u32,
}

impl LeafMap {
    /// Renders the leaves into a view: a pixel shows the leaf of the splat that makes up most of it.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn render(
        engine: &CpuEngine,
        splats: &Splats,
        options: &ProjectOptions,
        view: &PosedView,
        tree: &SceneTree,
    ) -> Result<LeafMap, RasterError> {
        let leaf =
            |splat: Option<usize>| splat.and_then(|splat| tree.leaf.get(splat)).copied().unwrap_or(NONE);
        let front = front_values(engine, splats, options, view, leaf)?;
        Ok(LeafMap { width: front.width, height: front.height, leaves: front.values })
    }

    /// Takes pixels out: those of a mask of any size that covers the view edge to edge.
    pub fn leave_out(&mut self, mask: &Mask) {
        let mask = mask.resized(self.width as u32, self.height as u32);
        for (i, leaf) in self.leaves.iter_mut().enumerate() {
            if mask.index(i) {
                *leaf = NONE;
            }
        }
    }

    /// The pixels that show each of some groups.
    pub fn shown(&self, tree: &SceneTree, groups: &[GroupCandidate]) -> Vec<ShownPixels> {
        let leaves = tree.leaf_count();
        let mut counts = [vec![0.0f32; leaves], vec![0.0f32; leaves]];
        for (i, &leaf) in self.leaves.iter().enumerate().filter(|(_, leaf)| (**leaf as usize) < leaves) {
            let (x, y) = (i % self.width, i / self.width);
            let inner = (1..self.width.saturating_sub(1)).contains(&x)
                && (1..self.height.saturating_sub(1)).contains(&y);
            counts[0][leaf as usize] += 1.0;
            counts[1][leaf as usize] += f32::from(u8::from(!inner));
        }
        let sums: Vec<[Vec<f64>; 2]> =
            tree.trees.iter().map(|tree| [0, 1].map(|k| tree.merges.sums(&counts[k]))).collect();
        let of = |group: &GroupCandidate| {
            let sum =
                |k: usize| group.nodes.iter().map(|&(tree, node)| sums[tree][k][node as usize]).sum::<f64>();
            ShownPixels { all: sum(0) as u32, on_frame: sum(1) as u32 }
        };
        groups.iter().map(of).collect()
    }

    /// The pixels that show one of these leaves.
    pub fn mask(&self, leaves: &[bool]) -> Mask {
        Mask::from_fn(self.width as u32, self.height as u32, |x, y| {
            let leaf = self.leaves[y as usize * self.width + x as usize];
            leaves.get(leaf as usize).copied().unwrap_or(false)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_tree::tree::TREES;
    use crate::scene_tree::{GroupTree, MergeTree, SplatGroup};

    #[test]
    fn nested_groups_show_the_pixels_of_their_leaves() {
        // Leaves 0 to 2; 0 and 1 are merged into 3, and all into 4.
        let merges =
            MergeTree { leaves: 3, parent: vec![3, 3, 4, 4, 4], height: vec![0.0, 0.0, 0.0, 1.0, 2.0] };
        let tree = GroupTree { merges, groups: vec![SplatGroup::default(); 5] };
        let tree = SceneTree {
            leaf: vec![0, 1, 2, NONE],
            trees: vec![tree; TREES.len()],
            surfaces: Vec::new(),
            shown_by: vec![2; 4],
        };
        assert!(tree.fits(4));
        let leaves = vec![NONE, 0, 0, 2, 0, 1, 1, 2, NONE, 2, 2, NONE];
        let mut map = LeafMap { width: 4, height: 3, leaves };
        let group = |nodes: &[(usize, u32)]| GroupCandidate { nodes: nodes.to_vec(), score: 0.5, area: 0.1 };
        let groups = [group(&[(0, 1)]), group(&[(1, 3)]), group(&[(0, 4)]), group(&[(0, 0), (2, 2)])];
        let of = |map: &LeafMap| {
            map.shown(&tree, &groups).iter().map(|shown| (shown.all, shown.on_frame)).collect::<Vec<_>>()
        };
        assert_eq!(of(&map), [(2, 0), (5, 3), (9, 7), (7, 7)]);
        assert_eq!(map.mask(&tree.leaves_of(&groups[1])).count(), 5);
        // A transient over the upper row.
        map.leave_out(&Mask::from_fn(8, 6, |_, y| y < 2));
        assert_eq!(of(&map), [(2, 0), (3, 1), (6, 4), (4, 4)]);
    }
}
