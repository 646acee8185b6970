//! The groups of a scene that a text may describe: its parts, what they are parts of, and what they are made of.

use super::query::{MAX_PART_AREA, MIN_AREA, expected};
use super::{GroupCandidate, NONE, SceneTree};
use std::collections::HashSet;

/// Groups that a text may describe, at most: each costs embeddings of some crops.
pub const MOST_DESCRIBABLE: usize = 192;

/// Least ratio of the areas of two groups one of which holds the other (docs/method.md, section 13.1). By choice; smaller steps hardly
/// show in a crop.
const MIN_NESTED_RATIO: f32 = 1.5;

/// IoU in light from which a group that holds a part is one that is listed already, by another tree (section 13.1). By choice.
const ALIKE_HOLDERS: f64 = 0.9;

/// Groups above a part, and levels of halves below it. By choice: a window is two levels below its wall, a house two above its
/// door.
const LEVELS: usize = 2;

/// Groups by their leaves, whichever tree they are of.
struct KnownGroups<'a> {
    tree: &'a SceneTree,
    /// Light of each leaf.
    light: Vec<f64>,
    /// Leaves of each group, and their light.
    groups: Vec<(Vec<bool>, f64)>,
}

impl KnownGroups<'_> {
    fn of(tree: &SceneTree) -> KnownGroups<'_> {
        KnownGroups { tree, light: tree.leaf_light().map(f64::from).collect(), groups: Vec::new() }
    }

    /// Takes a group in. `false` where one of nearly the same leaves is known.
    fn adds(&mut self, group: &GroupCandidate) -> bool {
        let leaves = self.tree.leaves_of(group);
        let own = self.light.iter().zip(&leaves).enumerate().filter(|(_, (_, inside))| **inside);
        let own: Vec<(usize, f64)> = own.map(|(leaf, (light, _))| (leaf, *light)).collect();
        let light: f64 = own.iter().map(|(_, light)| light).sum();
        let alike = self.groups.iter().any(|(other, of_other)| {
            // Whatever they share, their IoU is no more than the ratio of their light.
            if light.min(*of_other) < ALIKE_HOLDERS * light.max(*of_other) {
                return false;
            }
            let shared: f64 = own.iter().filter(|(leaf, _)| other[*leaf]).map(|(_, light)| light).sum();
            shared >= ALIKE_HOLDERS * (light + of_other - shared)
        });
        if !alike {
            self.groups.push((leaves, light));
        }
        !alike
    }
}

/// The first of both, then the second of both, and so on.
fn by_turns<T>(one: Vec<T>, other: Vec<T>) -> Vec<T> {
    let (mut one, mut other) = (one.into_iter(), other.into_iter());
    let mut all = Vec::with_capacity(one.len() + other.len());
    while one.len() + other.len() > 0 {
        all.extend(one.next().into_iter().chain(other.next()));
    }
    all
}

impl SceneTree {
    /// Groups that a text may describe: the scene's parts in their order, then by turns a group that holds one and a group that makes
    /// one up, each kind by the order of the parts. Of groups that hold parts, none has nearly the leaves of another. They are at
    /// most [`MOST_DESCRIBABLE`], no smaller than a candidate of a click, and none is the scene.
    pub fn describable(&self) -> Vec<GroupCandidate> {
        let parts = self.parts().groups;
        let children: Vec<Vec<[u32; 2]>> = (0..self.trees.len()).map(|tree| self.children(tree)).collect();
        let mut known: HashSet<(usize, u32)> = parts.iter().map(|part| part.nodes[0]).collect();
        let (mut above, mut below) = (Vec::new(), Vec::new());
        let mut holders = KnownGroups::of(self);
        for part in &parts {
            holders.adds(part);
        }
        for &(tree, node) in parts.iter().map(|part| &part.nodes[0]) {
            above.extend(
                self.holders(tree, node)
                    .into_iter()
                    .filter(|holder| {
                        known.insert((tree, *holder)) && holders.adds(&self.described(tree, *holder))
                    })
                    .map(|holder| (tree, holder)),
            );
            let mut level = vec![node];
            for _ in 0..LEVELS {
                level = level
                    .iter()
                    .filter_map(|&node| self.halves(tree, node, &children[tree]))
                    .flatten()
                    .collect();
                below.extend(
                    level.iter().filter(|half| known.insert((tree, **half))).map(|&half| (tree, half)),
                );
            }
        }
        let more = by_turns(above, below).into_iter().map(|(tree, node)| self.described(tree, node));
        parts.into_iter().chain(more).take(MOST_DESCRIBABLE).collect()
    }

    /// Per node of a tree, the two that it was made of; [`NONE`] for leaves.
    fn children(&self, tree: usize) -> Vec<[u32; 2]> {
        let merges = &self.trees[tree].merges;
        let mut children = vec![[NONE; 2]; merges.len()];
        for (node, &parent) in
            merges.parent.iter().enumerate().filter(|(node, parent)| **parent as usize != *node)
        {
            let slots = &mut children[parent as usize];
            let free = usize::from(slots[0] != NONE);
            slots[free] = node as u32;
        }
        children
    }

    fn area(&self, tree: usize, node: u32) -> f32 {
        self.trees[tree].groups[node as usize].area
    }

    /// The smallest groups that hold a node and are larger by [`MIN_NESTED_RATIO`] each.
    fn holders(&self, tree: usize, node: u32) -> Vec<u32> {
        let (mut found, mut area) = (Vec::new(), self.area(tree, node));
        for holder in self.trees[tree].merges.ancestors(node).skip(1) {
            let of_holder = self.area(tree, holder);
            if found.len() == LEVELS || of_holder > MAX_PART_AREA {
                break;
            }
            if of_holder >= MIN_NESTED_RATIO * area {
                found.push(holder);
                area = of_holder;
            }
        }
        found
    }

    /// The two groups that a node falls apart into, once what is smaller than a candidate has fallen off.
    fn halves(&self, tree: usize, mut node: u32, children: &[[u32; 2]]) -> Option<[u32; 2]> {
        loop {
            let [a, b] = children[node as usize];
            if a == NONE || b == NONE {
                return None;
            }
            let (large, small) = if self.area(tree, a) >= self.area(tree, b) { (a, b) } else { (b, a) };
            if self.area(tree, small) >= MIN_AREA {
                return Some([large, small]);
            }
            node = large;
        }
    }

    /// A node as a candidate. How much higher its parent is does not count.
    fn described(&self, tree: usize, node: u32) -> GroupCandidate {
        let score = expected(tree, &self.trees[tree], node, 0.0);
        GroupCandidate { nodes: vec![(tree, node)], score, area: self.area(tree, node) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_tree::tree::TREES;
    use crate::scene_tree::{GroupTree, MergeTree, SplatGroup};

    #[test]
    fn a_node_has_the_groups_around_it_and_the_halves_that_are_no_crumbs() {
        // Leaves 0 to 4; 5 = 0 + 1, where 1 is a crumb; 6 = 5 + 2; 7 = 6 + 3; 8 = all.
        let areas = [0.1, 0.001, 0.1, 0.2, 0.5, 0.101, 0.201, 0.401, 0.901];
        let groups = areas.map(|area| SplatGroup { area, ..SplatGroup::default() }).to_vec();
        let merges = MergeTree {
            leaves: 5,
            parent: vec![5, 5, 6, 7, 8, 6, 7, 8, 8],
            height: vec![0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 4.0],
        };
        let tree = GroupTree { merges, groups };
        let tree = SceneTree {
            leaf: (0..5).collect(),
            trees: vec![tree; TREES.len()],
            surfaces: Vec::new(),
            shown_by: vec![2; 5],
        };
        assert!(tree.fits(5));
        assert_eq!(tree.holders(0, 0), [6, 7], "5 is hardly larger, and 8 is the scene");
        let children = tree.children(0);
        assert_eq!(tree.halves(0, 7, &children), Some([6, 3]));
        assert_eq!((tree.halves(0, 6, &children), tree.halves(0, 5, &children)), (Some([5, 2]), None));
        let mut known = KnownGroups::of(&tree);
        let adds = [(0, 7), (3, 7), (0, 6), (1, 0), (2, 5), (2, 2)]
            .map(|(of, node)| known.adds(&tree.described(of, node)));
        assert_eq!(adds, [true, false, true, true, false, true], "by whichever tree; 5 is 0 and a crumb");
        assert_eq!(by_turns(vec![1, 2, 3], vec![7]), [1, 7, 2, 3]);
        let found = tree.describable();
        assert!(found.len() <= MOST_DESCRIBABLE && found.iter().all(|group| group.area <= MAX_PART_AREA));
        let parts = tree.parts().groups;
        assert_eq!(found[..parts.len()], parts[..]);
        let mut nodes: Vec<(usize, u32)> = found.iter().map(|group| group.nodes[0]).collect();
        nodes.sort_unstable();
        nodes.dedup();
        assert_eq!(nodes.len(), found.len(), "each once");
    }
}
