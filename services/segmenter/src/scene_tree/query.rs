//! Clicks against the scene tree: from what they hit to ranked groups of splats (method, section 13).

use super::surfaces::MIN_SURFACE_FRAME;
use super::tree::{GAP, Growth, PHOTO, TREES};
use super::{GroupTree, MergeTree, NONE, SceneSurface, SceneTree};
use crate::{ClickHit, TreeBoundaries};

/// Candidates that a query answers with, at most.
const MAX_CANDIDATES: usize = 2;

/// Two candidates differ in area by at least this factor. By choice; it orders alternatives only.
const MIN_AREA_RATIO: f32 = 1.5;

/// Expected IoU `lambda_g` that a candidate of another granularity must have more, per whole range of sizes (method, section
/// 13). By choice; it counts where a prompt has a granularity.
const GRANULARITY_WEIGHT: f32 = 2.0;

/// Share of all light under which a group is no candidate (method, section 13). By choice. Half and half more changed no
/// measured click.
pub(super) const MIN_AREA: f32 = 0.002;

/// Share of all light from which a group is no part of the scene that is listed (method, section 13). By choice.
pub(super) const MAX_PART_AREA: f32 = 0.5;

/// Share of all light from which a group is the scene rather than a thing in it (method, section 13). From
/// docs/experiments/2026-11-30-gaps.md: of a statue alone against the sky, the statue has .95.
pub(crate) const SCENE_AREA: f32 = 0.96;

/// Expected IoU of a surface with what is meant (method, section 13): about the mean of six synthetic scenes' ground with what was
/// found of it. From docs/experiments/2026-11-30-surfaces.md.
pub(crate) const SURFACE_IOU: f32 = 0.55;

/// A linear function of what is known of a group (method, section 13).
struct GroupWeights {
    constant: f32,
    log_area: f32,
    log_area_squared: f32,
    root_frame: f32,
    log_cut: f32,
    gap: f32,
    nearer: f32,
    rim: f32,
    contrast: f32,
    shape: f32,
    average: f32,
    photo: f32,
}

/// Expected IoU of a group with what a click means (method, section 13): a linear fit over the groups that hold 180 random
/// clicks on nine objects of eight captured scenes and 110 on two synthetic ones (docs/experiments/2026-11-28-scene-tree.md).
/// Groups that the photos' frames cut off are hardly things. A fit to the groups of today's trees knows the chosen ones hardly
/// better, and lists small parts (docs/experiments/2026-11-30-gaps.md).
const EXPECTED: GroupWeights = GroupWeights {
    constant: 0.3226,
    log_area: 0.0142,
    log_area_squared: -0.0142,
    root_frame: -0.7643,
    log_cut: -0.0322,
    gap: 0.0328,
    nearer: 0.2256,
    rim: 0.023,
    contrast: 0.0,
    shape: 0.0,
    average: 0.0922,
    photo: 0.0,
};

/// Rank of a group among those that hold a click (method, section 13): the weights by which the softmax of the ranks has the
/// largest mean IoU, over 840 random clicks on nine objects of eight captured scenes, at 320 and 640 px, and 864 on 54 of six
/// synthetic ones, each object alike (docs/experiments/2026-11-30-gaps.md). It says which group is meant, and [`EXPECTED`] how
/// good that is.
const RANK: GroupWeights = GroupWeights {
    constant: 0.0,
    log_area: -0.46,
    log_area_squared: -0.07,
    root_frame: -2.983,
    log_cut: -0.265,
    gap: 0.784,
    nearer: 0.282,
    rim: 0.473,
    contrast: 1.201,
    shape: -0.602,
    average: -0.225,
    photo: -0.809,
};

/// Added to the normalised cut before its logarithm is taken; part of the fit. Half and half more changed no measured click.
const CUT_FLOOR: f32 = 1e-3;

/// Share of a group's light on a surface from which the group is a piece of it, unless its expected IoU is above
/// [`SURFACE_IOU`] (method, section 13). By choice.
const MIN_SHARE_ON_SURFACE: f32 = 0.5;

/// A group that a query may select.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupCandidate {
    /// Nodes, each with the number of its tree. A click chooses one; selections of earlier versions may have several.
    pub nodes: Vec<(usize, u32)>,
    /// Expected IoU with what is meant.
    pub score: f32,
    /// Share of all light that the views see.
    pub area: f32,
}

impl GroupTree {
    /// The groups that hold a leaf and are no smaller than a candidate, the smallest first; each with how much higher its parent
    /// is, relative to the most of them.
    pub(super) fn large_groups_with(&self, leaf: u32) -> impl Iterator<Item = (u32, f32)> + '_ {
        let MergeTree { parent, height, .. } = &self.merges;
        let gap = |node: u32| height[parent[node as usize] as usize] - height[node as usize];
        let large =
            move || self.merges.ancestors(leaf).filter(|&node| self.groups[node as usize].area >= MIN_AREA);
        let widest = large().map(gap).fold(1e-9, f32::max);
        large().map(move |node| (node, gap(node) / widest))
    }

    /// Per group, how much higher its parent is, relative to the widest gap on the way from the group's largest part to the root: a
    /// click lies there most often.
    pub(super) fn relative_gaps(&self) -> Vec<f32> {
        let merges = &self.merges;
        let n = merges.len();
        let gap = |node: usize| merges.height[merges.parent[node] as usize] - merges.height[node];
        let own = |node: usize| if self.groups[node].area >= MIN_AREA { gap(node) } else { 0.0 };
        // The widest gap from each node's largest part to it, and from it to the root.
        let (mut below, mut above) = ((0..n).map(own).collect::<Vec<f32>>(), vec![0.0f32; n]);
        let mut largest = vec![0.0f32; n];
        for node in 0..n {
            let parent = merges.parent[node] as usize;
            if parent != node && self.groups[node].area > largest[parent] {
                largest[parent] = self.groups[node].area;
                below[parent] = below[node].max(own(parent));
            }
        }
        for node in (0..n).rev() {
            let parent = merges.parent[node] as usize;
            above[node] = if parent == node { own(node) } else { own(node).max(above[parent]) };
        }
        (0..n).map(|node| gap(node) / below[node].max(above[node]).max(1e-9)).collect()
    }
}

impl SceneTree {
    /// The leaf that a click hits: the one with the largest share of it. `None` where it hits nothing that is in the tree.
    pub fn leaf_of(&self, hit: &ClickHit) -> Option<u32> {
        let mut shares: Vec<(u32, f32)> =
            hit.splats.iter().map(|&(splat, share)| (self.leaf[splat as usize], share)).collect();
        shares.retain(|(leaf, _)| *leaf != NONE);
        shares.sort_by_key(|(leaf, _)| *leaf);
        let summed =
            shares.chunk_by(|a, b| a.0 == b.0).map(|run| (run[0].0, run.iter().map(|s| s.1).sum::<f32>()));
        summed.max_by(|a, b| a.1.total_cmp(&b.1)).map(|(leaf, _)| leaf)
    }

    /// The surface that a click hits, by its number: what faces as it does makes up at least half of what the click hits.
    pub fn surface_at(&self, hit: &ClickHit) -> Option<usize> {
        let share_of = |is_counted: &dyn Fn(u32) -> bool| -> f32 {
            let of = hit.splats.iter().map(|&(splat, share)| (self.leaf[splat as usize], share));
            of.filter(|(leaf, _)| *leaf != NONE && is_counted(*leaf)).map(|(_, share)| share).sum()
        };
        let half = 0.5 * share_of(&|_| true);
        let on = |surface: &SceneSurface| share_of(&|leaf| surface.facing.binary_search(&leaf).is_ok());
        self.surfaces.iter().position(|surface| half > 0.0 && on(surface) >= half)
    }

    /// What a click on a leaf may select, the likeliest first.
    pub fn candidates(&self, leaf: u32, boundaries: TreeBoundaries) -> Vec<GroupCandidate> {
        apart(self.groups_with(leaf, boundaries))
    }

    /// As [`SceneTree::candidates`], with those first whose size is near `granularity`: 0 is the smallest group that holds the
    /// leaf, 1 the largest; sizes are compared by their logarithms.
    pub fn candidates_of_size(
        &self,
        leaf: u32,
        granularity: f32,
        boundaries: TreeBoundaries,
    ) -> Vec<GroupCandidate> {
        let mut found = self.groups_with(leaf, boundaries);
        let sizes = || found.iter().map(|c| c.area.ln());
        let (least, most) = (sizes().fold(f32::MAX, f32::min), sizes().fold(f32::MIN, f32::max));
        let far = |c: &GroupCandidate| {
            let position = (c.area.ln() - least) / (most - least).max(1e-6);
            (position - granularity).abs()
        };
        let worth = |c: &GroupCandidate| c.score - GRANULARITY_WEIGHT * far(c);
        found.sort_by(|a, b| worth(b).total_cmp(&worth(a)).then(a.nodes.cmp(&b.nodes)));
        apart(found)
    }

    /// Groups that hold a leaf in the trees of some boundaries, the likeliest first.
    pub(super) fn groups_with(&self, leaf: u32, boundaries: TreeBoundaries) -> Vec<GroupCandidate> {
        let mut found = Vec::new();
        for (number, tree) in self.trees_of(boundaries) {
            for (node, gap) in tree.large_groups_with(leaf) {
                let score = expected(number, tree, node, gap);
                let area = tree.groups[node as usize].area;
                let rank = rank(number, tree, node, gap);
                found.push((rank, GroupCandidate { nodes: vec![(number, node)], score, area }));
            }
        }
        found.sort_by(|(a, first), (b, second)| b.total_cmp(a).then(first.nodes.cmp(&second.nodes)));
        found.into_iter().map(|(_, candidate)| candidate).collect()
    }

    /// The trees of some boundaries, with their numbers.
    pub(super) fn trees_of(&self, boundaries: TreeBoundaries) -> impl Iterator<Item = (usize, &GroupTree)> {
        self.trees.iter().enumerate().filter(move |(number, _)| takes_part(boundaries, TREES[*number].0))
    }

    /// The largest share of the outlines of a candidate's nodes that lies on the photos' frames.
    fn frame_of(&self, candidate: &GroupCandidate) -> f32 {
        let frames = candidate.nodes.iter().map(|&(tree, node)| self.trees[tree].groups[node as usize].frame);
        frames.fold(0.0, f32::max)
    }

    /// Whether a candidate is a thing of its own where a click hits a surface. What the photos' frames cut off is none, nor is a piece
    /// of the surface, unless it is likelier a thing than the surface is what is meant: a pediment lies on its front.
    pub(crate) fn is_thing_on(&self, candidate: &GroupCandidate, surface: &SceneSurface) -> bool {
        self.frame_of(candidate) < MIN_SURFACE_FRAME
            && (candidate.score > SURFACE_IOU || self.share_on(candidate, surface) < MIN_SHARE_ON_SURFACE)
    }

    /// Share of a candidate's light that lies on a surface.
    fn share_on(&self, candidate: &GroupCandidate, surface: &SceneSurface) -> f32 {
        let (leaves, on) = (self.leaves_of(candidate), self.leaves_on(surface));
        let held = leaves.iter().zip(&on).zip(self.leaf_light()).filter(|((inside, _), _)| **inside);
        let (mut all, mut shared) = (0.0, 0.0);
        held.for_each(|((_, on), light)| {
            all += light;
            shared += if *on { light } else { 0.0 };
        });
        if all > 0.0 { shared / all } else { 0.0 }
    }

    /// Whether each leaf belongs to a candidate.
    pub fn leaves_of(&self, candidate: &GroupCandidate) -> Vec<bool> {
        let mut leaves = vec![false; self.leaf_count()];
        for &(tree, node) in &candidate.nodes {
            let inside = self.trees[tree].merges.parts_of(node);
            leaves.iter_mut().zip(inside).for_each(|(leaf, inside)| *leaf |= inside);
        }
        leaves
    }

    /// Whether each splat of the scene belongs to a selection of leaves.
    pub fn splats_of(&self, leaves: &[bool]) -> Vec<bool> {
        self.leaf.iter().map(|&leaf| leaf != NONE && leaves[leaf as usize]).collect()
    }

    /// Whether each splat of the scene belongs to a candidate.
    pub fn labels(&self, candidate: &GroupCandidate) -> Vec<bool> {
        self.splats_of(&self.leaves_of(candidate))
    }
}

/// Whether trees of a cue answer.
fn takes_part(boundaries: TreeBoundaries, cue: usize) -> bool {
    match boundaries {
        TreeBoundaries::All => true,
        TreeBoundaries::Photo => cue == PHOTO,
        TreeBoundaries::Geometry => cue == GAP,
    }
}

/// The first candidates that differ in size.
pub(super) fn apart(found: impl IntoIterator<Item = GroupCandidate>) -> Vec<GroupCandidate> {
    let mut kept: Vec<GroupCandidate> = Vec::new();
    for candidate in found {
        let apart =
            |k: &GroupCandidate| k.area.max(candidate.area) >= MIN_AREA_RATIO * k.area.min(candidate.area);
        if kept.len() < MAX_CANDIDATES && kept.iter().all(apart) {
            kept.push(candidate);
        }
    }
    kept
}

/// Expected IoU of a group. `gap`: how much higher its parent is, relative to the widest gap on its way to the root.
pub(super) fn expected(number: usize, tree: &GroupTree, node: u32, gap: f32) -> f32 {
    weighed(&EXPECTED, number, tree, node, gap)
}

/// Rank of a group among others; as [`expected`].
pub(super) fn rank(number: usize, tree: &GroupTree, node: u32, gap: f32) -> f32 {
    weighed(&RANK, number, tree, node, gap)
}

/// The sum of what is known of a group by some weights; as [`expected`].
fn weighed(of: &GroupWeights, number: usize, tree: &GroupTree, node: u32, gap: f32) -> f32 {
    let group = tree.groups[node as usize];
    let log_area = group.area.max(f32::MIN_POSITIVE).ln();
    let (cue, growth) = TREES[number];
    let flag = |is: bool| f32::from(u8::from(is));
    of.constant
        + of.log_area * log_area
        + of.log_area_squared * log_area * log_area
        + of.root_frame * group.frame.max(0.0).sqrt()
        + of.log_cut * (group.cut + CUT_FLOOR).ln()
        + of.gap * gap
        + of.nearer * group.nearer.max(0.0)
        + of.rim * group.rim
        + of.contrast * (group.rim - group.inner)
        + of.shape * ((group.outline + 1.0).ln() - 0.5 * log_area)
        + of.average * flag(growth == Growth::Average)
        + of.photo * flag(cue == PHOTO)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_tree::SplatGroup;

    #[test]
    fn the_rank_chooses_and_the_expected_iou_says_how_good_it_is() {
        // Leaf 0 is far below its parent, which stands before what is around it.
        let merges =
            MergeTree { leaves: 3, parent: vec![3, 3, 4, 4, 4], height: vec![0.0, 0.0, 0.0, 0.9, 1.0] };
        let group = |area, nearer| SplatGroup { area, nearer, cut: 0.5, ..SplatGroup::default() };
        let groups =
            vec![group(0.1, 0.0), group(0.2, 0.0), group(0.7, 0.0), group(0.3, 1.0), group(1.0, 0.0)];
        let trees = vec![GroupTree { merges, groups }];
        let tree = SceneTree { leaf: vec![0, 1, 2], trees, surfaces: Vec::new(), shown_by: vec![1; 3] };
        let found = tree.candidates(0, TreeBoundaries::All);
        assert_eq!(found[0].nodes, [(0, 0)]);
        assert_eq!(found[1].nodes, [(0, 3)]);
        assert!(found[0].score < found[1].score, "{found:?}");
    }

    #[test]
    fn a_pediment_is_a_thing_on_its_front_and_a_slab_of_the_ground_is_none() {
        let merges =
            MergeTree { leaves: 3, parent: vec![3, 3, 4, 4, 4], height: vec![0.0, 0.0, 0.0, 0.9, 1.0] };
        let group = |area, frame| SplatGroup { area, frame, ..SplatGroup::default() };
        let groups =
            vec![group(0.2, 0.02), group(0.5, 0.3), group(0.3, 0.02), group(0.7, 0.2), group(1.0, 0.3)];
        let trees = vec![GroupTree { merges, groups }];
        let surface =
            SceneSurface { leaves: vec![0, 1], facing: vec![0, 1], area: 0.7, frame: 0.2, farther: 0.5 };
        let tree = SceneTree { leaf: vec![0, 1, 2], trees, surfaces: vec![surface], shown_by: vec![1; 3] };
        let candidate = |node, score| GroupCandidate { nodes: vec![(0, node)], score, area: 0.2 };
        let is_thing = |node, score| tree.is_thing_on(&candidate(node, score), &tree.surfaces[0]);
        assert!(is_thing(0, 0.6) && !is_thing(0, 0.3), "it lies on the surface");
        assert!(is_thing(2, 0.3), "it lies elsewhere");
        assert!(!is_thing(1, 0.6), "the frames cut it off");
    }
}
