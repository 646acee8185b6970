//! The trees of a scene and their groups.

use segwild_vision::linkage::MergeTree;
use wincode::{SchemaRead, SchemaWrite};

/// Stands for "in no tree".
pub const NONE: u32 = u32::MAX;

/// Nested groups of a scene's splats.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct SceneTree {
    /// Per splat of the scene, its leaf in all trees; [`NONE`] where no view sees it or a neighbour of it.
    pub leaf: Vec<u32>,
    /// The trees, over the same leaves.
    pub trees: Vec<GroupTree>,
    /// The surfaces, the largest planes first. No leaf belongs to two.
    pub surfaces: Vec<SceneSurface>,
    /// Per splat of the scene, the photos that show it: 1 where one photo alone does (method, section 13).
    pub shown_by: Vec<u16>,
}

/// A surface of the scene.
#[derive(Clone, Debug, Default, PartialEq, SchemaRead, SchemaWrite)]
pub struct SceneSurface {
    /// Its leaves in the trees, ascending.
    pub leaves: Vec<u32>,
    /// Those of them that face as it does, ascending. The others fill its gaps, or are feet of what stands there: a click on one of
    /// those does not mean the surface.
    pub facing: Vec<u32>,
    /// Its share of the light that all views see.
    pub area: f32,
    /// Share of its outline that lies on the photos' frames.
    pub frame: f32,
    /// Share of the occlusions at its outline in which it is the farther side, less the share in which it is the nearer one: 1
    /// where things stand before it everywhere.
    pub farther: f32,
}

/// One tree with what is known of its groups.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct GroupTree {
    /// The merges; leaves are splats that some view sees.
    pub merges: MergeTree,
    /// Per node.
    pub groups: Vec<SplatGroup>,
}

/// A node of a tree: a group of splats. Lengths are sides of pixels, summed over the views.
#[derive(Clone, Copy, Debug, Default, PartialEq, SchemaRead, SchemaWrite)]
pub struct SplatGroup {
    /// Its share of the light that all views see.
    pub area: f32,
    /// Mean distance over the edges from it to the rest.
    pub rim: f32,
    /// Mean distance over the edges inside it.
    pub inner: f32,
    /// Normalised cut in [0, 1]: affinity to the rest, relative to all affinity of the smaller side.
    pub cut: f32,
    /// Length of its outline: borders with other groups and with nothing, without the photos' frames.
    pub outline: f32,
    /// Share of the outline that is an occlusion, or borders on nothing.
    pub occluding: f32,
    /// Share of those occlusions in which the group is the nearer side, less the share in which it is the farther one: 1 for
    /// what stands before everything, -1 for what everything stands before.
    pub nearer: f32,
    /// Share of outline and frame together that lies on the photos' frames.
    pub frame: f32,
}

impl SceneTree {
    /// How many leaves it has.
    pub fn leaf_count(&self) -> usize {
        self.trees.first().map_or(0, |tree| tree.merges.leaves)
    }

    /// The light that all views see of each leaf, as a share of all that they see; leaves have the same light in all trees.
    pub fn leaf_light(&self) -> impl Iterator<Item = f32> + '_ {
        let groups = self.trees.first().map_or(&[][..], |tree| &tree.groups[..]);
        groups.iter().take(self.leaf_count()).map(|leaf| leaf.area)
    }

    /// Whether its parts fit together and to a scene of so many splats: it may have been read from a file.
    pub fn fits(&self, splats: usize) -> bool {
        let leaves = self.leaf_count();
        let whole = |tree: &GroupTree| tree.merges.is_sound(leaves) && tree.groups.len() == tree.merges.len();
        self.leaf.len() == splats
            && self.shown_by.len() == splats
            && self.trees.len() == TREES.len()
            && self.trees.iter().all(whole)
            && self.leaf.iter().all(|&leaf| leaf == NONE || (leaf as usize) < leaves)
            && self
                .surfaces
                .iter()
                .flat_map(|s| s.leaves.iter().chain(&s.facing))
                .all(|&leaf| (leaf as usize) < leaves)
    }

    /// IoU of a selection of splats with one of leaves, by the light that the views see of each leaf, in [0, 1]. A leaf is selected
    /// by the share of its splats.
    pub(crate) fn light_iou(&self, labels: &[bool], leaves: &[bool]) -> f32 {
        let mut counts = vec![[0u32; 2]; leaves.len()];
        for (&leaf, &label) in self.leaf.iter().zip(labels).filter(|(leaf, _)| **leaf != NONE) {
            let [all, selected] = &mut counts[leaf as usize];
            *all += 1;
            *selected += u32::from(label);
        }
        let (mut both, mut either) = (0.0f64, 0.0f64);
        for ((&[all, selected], &leaf), light) in counts.iter().zip(leaves).zip(self.leaf_light()) {
            let share = f64::from(selected) / f64::from(all.max(1));
            let (light, other) = (f64::from(light), f64::from(u8::from(leaf)));
            both += light * share.min(other);
            either += light * share.max(other);
        }
        if either > 0.0 { (both / either) as f32 } else { 0.0 }
    }

    /// Whether each leaf belongs to a surface.
    pub fn leaves_on(&self, surface: &SceneSurface) -> Vec<bool> {
        let mut leaves = vec![false; self.leaf_count()];
        surface.leaves.iter().for_each(|&leaf| leaves[leaf as usize] = true);
        leaves
    }

    /// Whether one photo alone shows each splat of the scene.
    pub fn seen_once(&self) -> Vec<bool> {
        self.shown_by.iter().map(|&photos| photos == 1).collect()
    }
}

/// Which distances a tree is grown from, and how.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Growth {
    /// Distances in the eigenvectors of the whole graph, and the edges' own.
    Spectral,
    /// Average linkage of the edges' own distances.
    Average,
}

/// What a distance between splats is measured by: the photo's boundaries and the gap together, the boundaries alone, the gap alone
/// (method, section 13). No one of them is best on all scenes: a print on a wall misleads the first two, a leg on the ground the
/// last.
pub(super) const CUES: usize = 3;
const BOTH: usize = 0;
pub(super) const PHOTO: usize = 1;
pub(super) const GAP: usize = 2;

/// The trees, by cue and growth.
pub(super) const TREES: [(usize, Growth); 5] = [
    (BOTH, Growth::Spectral),
    (PHOTO, Growth::Spectral),
    (GAP, Growth::Spectral),
    (BOTH, Growth::Average),
    (GAP, Growth::Average),
];

#[cfg(test)]
mod tests {
    use super::*;

    /// Three leaves of 3, 2 and 1 splats with light of 6, 3 and 1; the last splat is in no tree.
    fn tree() -> SceneTree {
        let area = |area| SplatGroup { area, ..SplatGroup::default() };
        let merges =
            MergeTree { leaves: 3, parent: vec![3, 3, 4, 4, 4], height: vec![0.0, 0.0, 0.0, 1.0, 2.0] };
        let groups = [6.0, 3.0, 1.0, 9.0, 10.0].map(area).to_vec();
        SceneTree {
            leaf: vec![0, 0, 0, 1, 1, 2, NONE],
            trees: vec![GroupTree { merges, groups }],
            surfaces: Vec::new(),
            shown_by: vec![2; 7],
        }
    }

    fn iou(labels: [bool; 7], leaves: [bool; 3]) -> f32 {
        tree().light_iou(&labels, &leaves)
    }

    #[test]
    fn leaves_count_by_their_light_and_by_the_share_of_their_splats() {
        let first = [true, true, true, false, false, false, false];
        assert_eq!(iou(first, [true, false, false]), 1.0);
        assert_eq!(iou(first, [true, true, false]), 6.0 / 9.0);
        assert_eq!(iou(first, [false, true, true]), 0.0);
        // One of two splats is half of the light.
        let and_half = [true, true, true, true, false, false, false];
        assert!((iou(and_half, [true, false, false]) - 6.0 / 7.5).abs() < 1e-6);
    }

    #[test]
    fn a_splat_in_no_tree_counts_for_nothing_and_nothing_has_no_iou() {
        assert_eq!(iou([true, true, true, false, false, false, true], [true, false, false]), 1.0);
        assert_eq!(iou([false, false, false, false, false, false, true], [false; 3]), 0.0);
    }
}
