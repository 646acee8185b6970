//! Agglomerative clustering of the nodes of a weighted graph: of a photo's regions, and of a scene's splats.

use crate::links::NodeLinks;
use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;
use wincode::{SchemaRead, SchemaWrite};

/// An undirected edge between two nodes, `a < b`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkageEdge {
    /// One node.
    pub a: u32,
    /// The other.
    pub b: u32,
    /// How unlike the two are; at least 0.
    pub distance: f32,
    /// How much the distance counts in means; over 0.
    pub weight: f32,
}

/// A binary tree of merges. Nodes are leaves first, then merges in the order they were made; the last is the root.
#[derive(Clone, Debug, Default, PartialEq, SchemaRead, SchemaWrite)]
pub struct MergeTree {
    /// Number of leaves.
    pub leaves: usize,
    /// The node that each node was merged into; the root names itself.
    pub parent: Vec<u32>,
    /// Cost at which a node was made; never falls towards the root. 0 for leaves.
    pub height: Vec<f32>,
}

impl MergeTree {
    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.parent.len()
    }

    /// Whether there is no node.
    pub fn is_empty(&self) -> bool {
        self.parent.is_empty()
    }

    /// Whether it is a tree of that many leaves: it may have been read from a file.
    pub fn is_sound(&self, leaves: usize) -> bool {
        let nodes = self.parent.len();
        let up = |(i, &parent): (usize, &u32)| {
            (parent as usize) < nodes && (parent as usize > i || i + 1 == nodes)
        };
        self.leaves == leaves
            && nodes == (2 * leaves).saturating_sub(1)
            && self.height.len() == nodes
            && self.height.iter().all(|h| h.is_finite())
            && self.parent.iter().enumerate().all(up)
    }

    /// The smallest node that holds both.
    pub fn meet(&self, mut a: u32, mut b: u32) -> u32 {
        // A node's parent has a larger number.
        while a != b {
            if a < b {
                a = self.parent[a as usize];
            } else {
                b = self.parent[b as usize];
            }
        }
        a
    }

    /// A node and everything it is part of, up to the root.
    pub fn ancestors(&self, from: u32) -> impl Iterator<Item = u32> + '_ {
        std::iter::successors(Some(from), |&i| {
            let parent = self.parent[i as usize];
            (parent != i).then_some(parent)
        })
    }

    /// Sums of numbers of the leaves, per node.
    pub fn sums(&self, of_leaves: &[f32]) -> Vec<f64> {
        let mut sums: Vec<f64> = of_leaves.iter().map(|&x| f64::from(x)).collect();
        sums.resize(self.len(), 0.0);
        for i in 0..self.len() {
            let parent = self.parent[i] as usize;
            if parent != i {
                sums[parent] += sums[i];
            }
        }
        sums
    }

    /// Per node, whether it is `node` or a part of it.
    pub fn parts_of(&self, node: u32) -> Vec<bool> {
        let mut inside = vec![false; self.len()];
        for i in (0..self.len()).rev() {
            inside[i] = i as u32 == node || (self.parent[i] as usize != i && inside[self.parent[i] as usize]);
        }
        inside
    }
}

/// What two nodes cost to merge: their mean distance, and a factor that lets small ones go first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LinkageCost {
    /// Distance that even equal nodes have.
    pub least: f64,
    /// Exponent of the smaller node's share of the whole; 0 is average linkage.
    pub size: f64,
}

impl LinkageCost {
    /// Average linkage.
    pub const AVERAGE: LinkageCost = LinkageCost { least: 0.0, size: 0.0 };

    fn of(&self, distance: f64, share: f64) -> f64 {
        if self.size == 0.0 {
            distance + self.least
        } else {
            (distance + self.least) * (share + 1e-6).powf(self.size)
        }
    }
}

#[derive(PartialEq)]
struct PendingMerge {
    cost: f64,
    a: u32,
    b: u32,
}

impl Eq for PendingMerge {}

impl PartialOrd for PendingMerge {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for PendingMerge {
    fn cmp(&self, other: &Self) -> Ordering {
        self.cost.total_cmp(&other.cost).then((self.a, self.b).cmp(&(other.a, other.b)))
    }
}

/// Two costs that differ by less than this part count as one.
const SAME: f64 = 1e-4;

/// How much higher than the last merge unconnected nodes are joined.
const UNCONNECTED: f64 = 1.2;

/// A distance and its weight, summed over the edges between two nodes.
#[derive(Clone, Copy, Default)]
struct EdgeSum {
    distance: f64,
    weight: f64,
}

/// Merges the cheapest pair of linked nodes until one is left. `sizes` has one number per node, 0 or more. The distance of two
/// nodes is the weighted mean over the edges between them. Edges are gone through twice.
pub fn agglomerate(
    sizes: &[f32],
    edges: impl Iterator<Item = LinkageEdge> + Clone,
    cost: LinkageCost,
) -> MergeTree {
    let n = sizes.len();
    let total = sizes.iter().map(|&s| f64::from(s)).sum::<f64>().max(f64::MIN_POSITIVE);
    let mut share: Vec<f64> = sizes.iter().map(|&s| f64::from(s) / total).collect();
    let mut counts = vec![0u32; n];
    for e in edges.clone() {
        counts[e.a as usize] += 1;
        counts[e.b as usize] += 1;
    }
    let with_capacity = |count: u32| NodeLinks::<EdgeSum>::with_capacity(count as usize);
    let mut around: Vec<NodeLinks<EdgeSum>> = counts.into_iter().map(with_capacity).collect();
    for e in edges {
        let (distance, weight) = (f64::from(e.distance) * f64::from(e.weight), f64::from(e.weight));
        for (from, to) in [(e.a, e.b), (e.b, e.a)] {
            let link = around[from as usize].entry(to);
            *link = EdgeSum { distance: link.distance + distance, weight: link.weight + weight };
        }
    }
    let of = |share: &[f64], a: u32, b: u32, link: EdgeSum| {
        cost.of(link.distance / link.weight, share[a as usize].min(share[b as usize]))
    };
    let candidate = |share: &[f64], a: u32, b: u32, link: EdgeSum| {
        Reverse(PendingMerge { cost: of(share, a, b, link), a: a.min(b), b: a.max(b) })
    };
    let mut heap: BinaryHeap<Reverse<PendingMerge>> = BinaryHeap::new();
    for (a, links) in around.iter().enumerate() {
        let a = a as u32;
        let to_later = links.iter().filter(|(b, _)| *b > a);
        heap.extend(to_later.map(|(b, link)| candidate(&share, a, b, link)));
    }
    let mut tree = MergeTree {
        leaves: n,
        parent: (0..(2 * n).saturating_sub(1) as u32).collect(),
        height: vec![0.0; (2 * n).saturating_sub(1)],
    };
    // Nodes live in slots: a merge keeps the slot with more links.
    let mut node: Vec<u32> = (0..n as u32).collect();
    let mut alive = vec![true; n];
    let (mut next, mut height) = (n, 0.0f64);
    let mut join = |next: &mut usize, a: u32, b: u32, height: f64| {
        (tree.parent[a as usize], tree.parent[b as usize]) = (*next as u32, *next as u32);
        tree.height[*next] = height as f32;
        *next += 1;
        *next as u32 - 1
    };
    while let Some(Reverse(PendingMerge { cost: was, a, b })) = heap.pop() {
        let (mut i, mut j) = (a as usize, b as usize);
        let link = match around[i].get(b) {
            Some(link) if alive[i] && alive[j] => link,
            _ => continue,
        };
        let now = of(&share, a, b, link);
        if now > was * (1.0 + SAME) + 1e-12 {
            heap.push(candidate(&share, a, b, link));
            continue;
        }
        if around[i].len() < around[j].len() {
            (i, j) = (j, i);
        }
        height = height.max(now);
        node[i] = join(&mut next, node[i], node[j], height);
        alive[j] = false;
        share[i] += share[j];
        around[i].remove(j as u32);
        for (other, link) in std::mem::take(&mut around[j]).iter() {
            if other as usize == i {
                continue;
            }
            let there = &mut around[other as usize];
            there.remove(j as u32);
            let both = there.entry(i as u32);
            *both = EdgeSum { distance: both.distance + link.distance, weight: both.weight + link.weight };
            let both = *both;
            *around[i].entry(other) = both;
            heap.push(candidate(&share, i as u32, other, both));
        }
    }
    let mut roots = (0..n).filter(|&i| alive[i]).map(|i| node[i]);
    if let Some(mut root) = roots.next() {
        height *= UNCONNECTED;
        for other in roots {
            root = join(&mut next, root, other, height);
        }
    }
    tree
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edge(a: u32, b: u32, distance: f32) -> LinkageEdge {
        LinkageEdge { a, b, distance, weight: 1.0 }
    }

    /// Two tight triples with a weak link between them, and a node that nothing links.
    fn two_groups() -> MergeTree {
        let edges = [edge(0, 1, 0.1), edge(1, 2, 0.2), edge(2, 3, 0.9), edge(3, 4, 0.1), edge(4, 5, 0.2)];
        agglomerate(&[1.0; 7], edges.into_iter(), LinkageCost::AVERAGE)
    }

    #[test]
    fn nodes_merge_in_the_order_of_their_distances() {
        let tree = two_groups();
        assert_eq!(tree.len(), 13);
        assert_eq!(tree.meet(0, 2), tree.meet(1, 2));
        assert!(tree.height[tree.meet(0, 2) as usize] < 0.3);
        assert!((tree.height[tree.meet(0, 5) as usize] - 0.9).abs() < 1e-6);
        let root = tree.meet(0, 6);
        assert_eq!(root as usize, tree.len() - 1);
        assert!(tree.height[root as usize] > 0.9, "unconnected nodes join last");
    }

    #[test]
    fn heights_never_fall_towards_the_root_and_every_leaf_is_counted_once() {
        let tree = two_groups();
        for i in 0..tree.len() {
            assert!(tree.height[tree.parent[i] as usize] >= tree.height[i]);
        }
        let sums = tree.sums(&[1.0; 7]);
        assert_eq!(sums[tree.len() - 1], 7.0);
        let group = tree.meet(3, 5);
        let parts = tree.parts_of(group);
        assert_eq!((0..7).filter(|&leaf| parts[leaf]).collect::<Vec<_>>(), [3, 4, 5]);
        assert_eq!(tree.ancestors(3).last(), Some(root(&tree)));
    }

    fn root(tree: &MergeTree) -> u32 {
        tree.len() as u32 - 1
    }

    #[test]
    fn the_mean_of_a_border_decides_and_not_its_weakest_point() {
        // 0-1 and 2-3 are pairs; between them one low edge and one high one.
        let edges = [edge(0, 1, 0.1), edge(2, 3, 0.1), edge(0, 2, 0.2), edge(1, 3, 0.8), edge(3, 4, 0.4)];
        let tree = agglomerate(&[1.0; 5], edges.into_iter(), LinkageCost::AVERAGE);
        assert!((tree.height[tree.meet(0, 3) as usize] - 0.5).abs() < 1e-6);
        assert!(tree.meet(2, 4) < tree.meet(0, 3), "4 joins 2 and 3 first");
    }

    #[test]
    fn small_nodes_merge_first_where_size_counts() {
        let edges = [edge(0, 1, 0.3), edge(1, 2, 0.31)];
        let sizes = [10.0, 10.0, 0.1];
        let by_distance = agglomerate(&sizes, edges.into_iter(), LinkageCost::AVERAGE);
        let by_size = agglomerate(&sizes, edges.into_iter(), LinkageCost { least: 0.01, size: 0.2 });
        assert!(by_distance.meet(0, 1) < by_distance.meet(1, 2));
        assert!(by_size.meet(1, 2) < by_size.meet(0, 1));
    }

    #[test]
    fn a_tree_of_other_leaves_or_with_a_parent_below_its_child_is_refused() {
        let tree = two_groups();
        assert!(tree.is_sound(7) && !tree.is_sound(6));
        let damaged = |change: &dyn Fn(&mut MergeTree)| {
            let mut tree = tree.clone();
            change(&mut tree);
            !tree.is_sound(7)
        };
        assert!(damaged(&|tree| tree.parent[9] = 3));
        assert!(damaged(&|tree| tree.parent[2] = u32::MAX));
        assert!(damaged(&|tree| tree.height[8] = f32::NAN));
        assert!(damaged(&|tree| tree.height.truncate(5)));
    }

    #[test]
    fn no_node_makes_an_empty_tree_and_one_node_a_root() {
        let of = |sizes: &[f32]| agglomerate(sizes, std::iter::empty(), LinkageCost::AVERAGE);
        assert!(of(&[]).is_empty());
        assert_eq!(of(&[1.0]).parent, [0]);
    }
}
