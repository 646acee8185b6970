//! Nested regions: superpixels merged pair by pair into one tree (an ultrametric contour map, Arbelaez et al., PAMI
//! 2011), the most alike neighbours first.

use super::boundary::Boundaries;
use super::watershed::neighbours;
use segwild_scene::Mask;
use std::cmp::{Ordering, Reverse};
use std::collections::{BTreeMap, BinaryHeap};
use std::sync::Arc;

/// Numbers in a region's colour and texture histograms: 8 each for L, a and b, then 5 for texture.
pub(crate) const BINS: usize = 29;

/// One region of the tree. Leaves are superpixels.
#[derive(Clone, Debug)]
pub(crate) struct RegionNode {
    /// The region this one is merged into; the root names itself.
    pub parent: u32,
    /// The two it was merged from; leaves name themselves.
    pub children: [u32; 2],
    /// How unlike its two children were, made monotone up the tree; 0 for leaves.
    pub altitude: f32,
    /// Pixels.
    pub area: f32,
    /// Where its leaves lie in [`Hierarchy::order`].
    pub first: u32,
    /// How many leaves it has.
    pub leaves: u32,
    /// Pixels on the photo's frame.
    pub frame: f32,
    /// Border with other regions: length in pixel sides, and the strength summed over it.
    pub border: Border,
    /// Sums over pixels: soft histograms.
    pub histogram: [f32; BINS],
}

impl RegionNode {
    /// A superpixel, whose pixels are not counted yet.
    pub fn leaf(i: u32, border: Border, histogram: [f32; BINS]) -> RegionNode {
        RegionNode {
            parent: i,
            children: [i, i],
            altitude: 0.0,
            area: 0.0,
            first: 0,
            leaves: 1,
            frame: 0.0,
            border,
            histogram,
        }
    }
}

/// A shared border.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Border {
    /// Length in pixel sides.
    pub length: f32,
    /// Boundary strength summed over them.
    pub strength: f32,
}

impl Border {
    fn add(&mut self, other: Border) {
        self.length += other.length;
        self.strength += other.strength;
    }

    /// Mean strength.
    pub fn mean(self) -> f32 {
        self.strength / self.length.max(1.0)
    }
}

/// The tree over one photo.
#[derive(Clone, Debug)]
pub(crate) struct Hierarchy {
    pub width: usize,
    pub height: usize,
    /// Superpixel of every pixel.
    pub labels: Arc<Vec<u32>>,
    /// Superpixels, then merges in the order they were made; the last is the whole photo.
    pub nodes: Vec<RegionNode>,
    /// Number of superpixels.
    pub leaves: usize,
    /// Superpixels such that every region's are neighbours.
    pub order: Vec<u32>,
    /// Neighbouring superpixels `(a, b)`, `a < b`, sorted.
    pub borders: Arc<Vec<(u32, u32, Border)>>,
}

#[derive(PartialEq)]
struct MergeCandidate {
    distance: f32,
    a: u32,
    b: u32,
}

impl Eq for MergeCandidate {}

impl PartialOrd for MergeCandidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for MergeCandidate {
    fn cmp(&self, other: &Self) -> Ordering {
        self.distance.total_cmp(&other.distance).then((self.a, self.b).cmp(&(other.a, other.b)))
    }
}

/// Chi-squared distance in [0, 1] of two histograms given as sums.
pub(crate) fn chi_squared(a: &[f32], b: &[f32]) -> f32 {
    let (na, nb) = (a.iter().sum::<f32>().max(1e-9), b.iter().sum::<f32>().max(1e-9));
    let mut sum = 0.0;
    for (x, y) in a.iter().zip(b) {
        let (x, y) = (x / na, y / nb);
        sum += (x - y) * (x - y) / (x + y + 1e-6);
    }
    0.5 * sum
}

/// What counts how much when regions are merged.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MergeWeights {
    /// Mean boundary strength along the shared border.
    pub border: f32,
    /// Difference of lightness.
    pub light: f32,
    /// Difference of chroma.
    pub chroma: f32,
    /// Difference of texture.
    pub texture: f32,
}

impl MergeWeights {
    /// The main tree's.
    pub fn main() -> MergeWeights {
        MergeWeights { border: 0.6, light: 0.4, chroma: 0.5, texture: 0.2 }
    }

    /// Other views of what belongs together, for more candidates: outlines first, light last (sunny and
    /// shaded sides of one thing), chroma first.
    pub fn others() -> [MergeWeights; 3] {
        [
            MergeWeights { border: 1.0, light: 0.2, chroma: 0.2, texture: 0.1 },
            MergeWeights { border: 0.5, light: 0.1, chroma: 0.6, texture: 0.2 },
            MergeWeights { border: 0.3, light: 0.5, chroma: 0.3, texture: 0.4 },
        ]
    }
}

/// How unlike two regions look, 0..1: lightness, chroma and texture.
pub(crate) fn unlike(a: &RegionNode, b: &RegionNode, weights: MergeWeights) -> f32 {
    let (ha, hb) = (&a.histogram, &b.histogram);
    let light = chi_squared(&ha[..8], &hb[..8]);
    let chroma = 0.5 * (chi_squared(&ha[8..16], &hb[8..16]) + chi_squared(&ha[16..24], &hb[16..24]));
    let texture = chi_squared(&ha[24..], &hb[24..]);
    (weights.light * light + weights.chroma * chroma + weights.texture * texture).min(1.0)
}

/// How unlike two neighbouring regions are, about 0..1.
fn distance(a: &RegionNode, b: &RegionNode, border: Border, total: f32, weights: MergeWeights) -> f32 {
    let like = weights.border * border.mean() + unlike(a, b, weights);
    // A small region is merged early, whatever it looks like: at full weight from 1 % of the photo on.
    let size = (a.area.min(b.area) / (0.01 * total)).min(1.0).powf(0.3);
    like * size
}

impl Hierarchy {
    /// Builds the tree. `histograms` are soft bins per pixel, [`BINS`] planes.
    pub fn build(labels: Vec<u32>, leaves: usize, edges: &Boundaries, bins: &[&[f32]]) -> Hierarchy {
        debug_assert_eq!(bins.len(), BINS);
        let (w, h) = (edges.strength.width, edges.strength.height);
        let mut nodes: Vec<RegionNode> =
            (0..leaves as u32).map(|i| RegionNode::leaf(i, Border::default(), [0.0; BINS])).collect();
        let mut sides = Vec::new();
        for i in 0..w * h {
            let node = &mut nodes[labels[i] as usize];
            node.area += 1.0;
            let (x, y) = (i % w, i / w);
            if x == 0 || y == 0 || x + 1 == w || y + 1 == h {
                node.frame += 1.0;
            }
            for (bin, plane) in node.histogram.iter_mut().zip(bins) {
                *bin += plane[i];
            }
            for j in neighbours(i, w, h).filter(|&j| j > i && labels[j] != labels[i]) {
                let strength = edges.strength.data[i].max(edges.strength.data[j]);
                let (a, b) = (labels[i].min(labels[j]), labels[i].max(labels[j]));
                sides.push((a, b, strength));
            }
        }
        sides.sort_by_key(|s| (s.0, s.1));
        let mut borders: Vec<(u32, u32, Border)> = Vec::new();
        for (a, b, strength) in sides {
            match borders.last_mut() {
                Some(last) if (last.0, last.1) == (a, b) => last.2.add(Border { length: 1.0, strength }),
                _ => borders.push((a, b, Border { length: 1.0, strength })),
            }
        }
        for &(a, b, border) in &borders {
            nodes[a as usize].border.add(border);
            nodes[b as usize].border.add(border);
        }
        Hierarchy::of_leaves((w, h), labels, nodes, Arc::new(borders))
    }

    /// The main tree over superpixels that are known.
    pub fn of_leaves(
        (width, height): (usize, usize),
        labels: Vec<u32>,
        nodes: Vec<RegionNode>,
        borders: Arc<Vec<(u32, u32, Border)>>,
    ) -> Hierarchy {
        let (labels, leaves) = (Arc::new(labels), nodes.len());
        let mut tree = Hierarchy { width, height, labels, nodes, leaves, order: Vec::new(), borders };
        tree.grow(MergeWeights::main());
        tree
    }

    /// Another tree over the same superpixels.
    pub fn regrown(&self, weights: MergeWeights) -> Hierarchy {
        let mut tree = Hierarchy { nodes: self.nodes[..self.leaves].to_vec(), ..self.clone() };
        tree.order.clear();
        tree.grow(weights);
        tree
    }

    fn grow(&mut self, weights: MergeWeights) {
        merge(&mut self.nodes, &self.borders, (self.width * self.height) as f32, weights);
        self.arrange();
    }

    /// Fills in `order`, `first`: depth first from the root.
    fn arrange(&mut self) {
        let mut stack = vec![self.root()];
        while let Some(i) = stack.pop() {
            let node = &mut self.nodes[i as usize];
            node.first = self.order.len() as u32;
            if (i as usize) < self.leaves {
                self.order.push(i);
            } else {
                stack.extend([node.children[1], node.children[0]]);
            }
        }
    }

    /// The whole photo.
    pub fn root(&self) -> u32 {
        self.nodes.len() as u32 - 1
    }

    /// The superpixel that holds a position, or `None` outside the photo.
    pub fn leaf_at(&self, x: f32, y: f32) -> Option<u32> {
        if !(x >= 0.0 && y >= 0.0 && x < self.width as f32 && y < self.height as f32) {
            return None;
        }
        Some(self.labels[y as usize * self.width + x as usize])
    }

    /// A region and everything it is part of, up to the whole photo.
    pub fn chain(&self, from: u32) -> impl Iterator<Item = u32> + '_ {
        std::iter::successors(Some(from), |&i| {
            let parent = self.nodes[i as usize].parent;
            (parent != i).then_some(parent)
        })
    }

    /// The largest region that holds `leaf` and was merged at or under `altitude`.
    pub fn region_at(&self, leaf: u32, altitude: f32) -> u32 {
        self.chain(leaf).take_while(|&i| self.nodes[i as usize].altitude <= altitude).last().unwrap_or(leaf)
    }

    /// The superpixels of a region.
    pub fn leaves_of(&self, region: u32) -> &[u32] {
        let node = &self.nodes[region as usize];
        &self.order[node.first as usize..(node.first + node.leaves) as usize]
    }

    /// The smallest region that holds both superpixels.
    pub fn meet(&self, a: u32, b: u32) -> u32 {
        self.chain(a).find(|&r| self.holds(r, b)).unwrap_or(self.root())
    }

    /// Whether `region` holds `leaf`.
    pub fn holds(&self, region: u32, leaf: u32) -> bool {
        let node = &self.nodes[region as usize];
        let at = self.nodes[leaf as usize].first;
        at >= node.first && at < node.first + node.leaves
    }

    /// The pixels of the superpixels that are set.
    pub fn mask(&self, inside: &[bool]) -> Mask {
        Mask::from_fn(self.width as u32, self.height as u32, |x, y| {
            inside[self.labels[y as usize * self.width + x as usize] as usize]
        })
    }

    /// The pixels of a region.
    pub fn region_mask(&self, region: u32) -> Mask {
        let mut inside = vec![false; self.leaves];
        self.leaves_of(region).iter().for_each(|&l| inside[l as usize] = true);
        self.mask(&inside)
    }

    /// Mean of a plane over every superpixel.
    pub fn means(&self, plane: &[f32]) -> Vec<f32> {
        let mut sums = vec![0.0; self.leaves];
        for (&label, &v) in self.labels.iter().zip(plane) {
            sums[label as usize] += v;
        }
        for (sum, node) in sums.iter_mut().zip(&self.nodes) {
            *sum /= node.area;
        }
        sums
    }
}

/// Merges the most alike neighbours until one region is left, appending to `nodes`.
fn merge(nodes: &mut Vec<RegionNode>, borders: &[(u32, u32, Border)], total: f32, weights: MergeWeights) {
    let leaves = nodes.len();
    let mut around: Vec<BTreeMap<u32, Border>> = vec![BTreeMap::new(); leaves];
    let mut heap = BinaryHeap::new();
    for &(a, b, border) in borders {
        around[a as usize].insert(b, border);
        around[b as usize].insert(a, border);
        let distance = distance(&nodes[a as usize], &nodes[b as usize], border, total, weights);
        heap.push(Reverse(MergeCandidate { distance, a, b }));
    }
    let mut alive = vec![true; leaves];
    while let Some(Reverse(MergeCandidate { distance: unlike, a, b })) = heap.pop() {
        let (ia, ib) = (a as usize, b as usize);
        if !alive[ia] || !alive[ib] {
            continue;
        }
        let id = nodes.len() as u32;
        let shared = around[ia][&b];
        let (na, nb) = (&nodes[ia], &nodes[ib]);
        let mut histogram = na.histogram;
        histogram.iter_mut().zip(&nb.histogram).for_each(|(x, y)| *x += y);
        let node = RegionNode {
            parent: id,
            children: [a, b],
            altitude: unlike.max(na.altitude).max(nb.altitude),
            area: na.area + nb.area,
            first: 0,
            leaves: na.leaves + nb.leaves,
            frame: na.frame + nb.frame,
            border: Border {
                length: na.border.length + nb.border.length - 2.0 * shared.length,
                strength: (na.border.strength + nb.border.strength - 2.0 * shared.strength).max(0.0),
            },
            histogram,
        };
        (alive[ia], alive[ib]) = (false, false);
        (nodes[ia].parent, nodes[ib].parent) = (id, id);
        let mut joined = std::mem::take(&mut around[ia]);
        for (other, border) in std::mem::take(&mut around[ib]) {
            joined.entry(other).or_default().add(border);
        }
        joined.remove(&a);
        joined.remove(&b);
        for (&other, &border) in &joined {
            let io = other as usize;
            around[io].remove(&a);
            around[io].remove(&b);
            around[io].insert(id, border);
            let distance = distance(&nodes[io], &node, border, total, weights);
            heap.push(Reverse(MergeCandidate { distance, a: other, b: id }));
        }
        nodes.push(node);
        around.push(joined);
        alive.push(true);
    }
}

/// Objectness of a region: how far its merge with the rest lies above the merges inside it, and how clear its outline is; less
/// for crumbs and for regions that the frame cuts off or that fill it.
pub(crate) fn standing(tree: &Hierarchy, region: u32) -> f32 {
    let node = &tree.nodes[region as usize];
    let total = (tree.width * tree.height) as f32;
    let above = tree.nodes[node.parent as usize].altitude;
    let top = tree.nodes[tree.root() as usize].altitude.max(1e-6);
    let persistence = (above - node.altitude).max(0.0) / top;
    let share = node.area / total;
    let size = (share / 0.02).min(1.0).sqrt() * ((1.0 - share) / 0.5).clamp(0.0, 1.0);
    let framed = node.frame / (node.border.length + node.frame).max(1.0);
    (persistence + 0.5 * node.border.mean()) * size * (1.0 - framed)
}
