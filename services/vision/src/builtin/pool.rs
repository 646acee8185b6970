//! Every candidate set for a click: the regions around it in all trees, and sets that are one merge from them.
//!
//! A tree that joins a thing with its background too early never gives the thing. But it often gives it but for one
//! part: so every region around the click is also taken with one neighbour more, and with one part less (pairs of
//! regions, as in Arbelaez et al., "Multiscale combinatorial grouping", CVPR 2014).

use super::analysis::Analysis;
use super::colours::ColourSamples;
use super::shape::{SetShape, SuperpixelPositions};
use super::tree::{Hierarchy, standing};
use std::collections::HashSet;

/// Least pixels of a candidate.
const LEAST: f32 = 16.0;
/// Largest share of the photo of a candidate.
const MOST: f32 = 0.85;
/// Least and largest share of the photo of a region that is taken with a part more or less.
const WHOLE: [f32; 2] = [0.001, 0.5];
/// Largest share of the photo of such a part, and its least share of the region.
const PART: [f32; 2] = [0.3, 0.1];

/// A set of superpixels with its measures.
#[derive(Clone, Debug)]
pub(crate) struct RegionSet {
    pub inside: Vec<bool>,
    pub shape: SetShape,
}

/// What is computed once per prompt.
pub(crate) struct Ground<'a> {
    pub analysis: &'a Analysis,
    pub positions: SuperpixelPositions,
    pub samples: &'a ColourSamples,
    /// Pixels of every superpixel.
    pub areas: Vec<f32>,
    /// Cost per pixel side of passing over every border of the tree.
    pub open: Vec<f32>,
    /// Neighbours of every superpixel.
    pub around: Vec<Vec<u32>>,
}

/// Cost per pixel side of passing between neighbouring superpixels: from the boundary along their border and from how
/// late the tree merges them.
fn openness(tree: &Hierarchy) -> Vec<f32> {
    tree.borders
        .iter()
        .map(|&(a, b, border)| {
            let meet = tree.nodes[tree.meet(a, b) as usize].altitude;
            (-3.0 * border.mean() - 2.0 * meet).exp() + 0.02
        })
        .collect()
}

impl<'a> Ground<'a> {
    /// Of a photo.
    pub fn of(analysis: &'a Analysis) -> Ground<'a> {
        let mut around = vec![Vec::new(); analysis.tree.leaves];
        for &(a, b, _) in analysis.tree.borders.iter() {
            around[a as usize].push(b);
            around[b as usize].push(a);
        }
        Ground {
            analysis,
            around,
            positions: SuperpixelPositions::of(analysis),
            samples: &analysis.samples,
            areas: analysis.tree.nodes[..analysis.tree.leaves].iter().map(|node| node.area).collect(),
            open: openness(&analysis.tree),
        }
    }

    /// Every candidate that holds superpixel `leaf`, tree by tree; each set once.
    pub fn around(&self, leaf: u32) -> Vec<RegionSet> {
        self.sets(leaf).into_iter().map(|(inside, _)| self.region_set(inside)).collect()
    }

    /// The sets of [`Ground::around`], and how well each stands in its tree ([`standing`]); 0 where it is no region of one.
    pub fn sets(&self, leaf: u32) -> Vec<(Vec<bool>, f32)> {
        let tree = &self.analysis.tree;
        let total = (tree.width * tree.height) as f32;
        let mut sets: Vec<(Vec<bool>, f32)> = Vec::new();
        let mut known = HashSet::new();
        let mut keep = |inside: Vec<bool>, standing: f32| {
            let area = self.area(&inside);
            if area >= LEAST && area <= MOST * total && known.insert(inside.clone()) {
                sets.push((inside, standing));
            }
        };
        for tree in self.analysis.trees() {
            let chain: Vec<u32> = tree.chain(leaf).collect();
            chain.iter().for_each(|&r| keep(set_of(tree, r), standing(tree, r)));
            // What every step of the chain joined.
            let parts: Vec<u32> = chain
                .windows(2)
                .map(|pair| {
                    let [a, b] = tree.nodes[pair[1] as usize].children;
                    if a == pair[0] { b } else { a }
                })
                .collect();
            let touching = first_touching(tree, &parts);
            for (r, &region) in chain.iter().enumerate() {
                let area = tree.nodes[region as usize].area;
                if area < WHOLE[0] * total || area > WHOLE[1] * total {
                    continue;
                }
                for (q, &part) in parts.iter().enumerate() {
                    let size = tree.nodes[part as usize].area;
                    if size > PART[0] * total || size < PART[1] * area {
                        continue;
                    }
                    // The last part taken away, or the next one added, gives a region of the chain itself.
                    if q > r && touching[q] <= r {
                        let mut inside = set_of(tree, region);
                        tree.leaves_of(part).iter().for_each(|&l| inside[l as usize] = true);
                        keep(inside, 0.0);
                    } else if q + 1 < r {
                        let mut inside = set_of(tree, region);
                        tree.leaves_of(part).iter().for_each(|&l| inside[l as usize] = false);
                        keep(inside, 0.0);
                    }
                }
            }
        }
        sets
    }

    /// A set with its measures.
    pub fn region_set(&self, inside: Vec<bool>) -> RegionSet {
        RegionSet { shape: SetShape::of(self.analysis, &self.positions, &inside), inside }
    }

    /// Pixels of a set.
    pub fn area(&self, inside: &[bool]) -> f32 {
        self.areas.iter().zip(inside).map(|(&area, &i)| if i { area } else { 0.0 }).sum()
    }
}

/// The superpixels of a region.
pub(crate) fn set_of(tree: &Hierarchy, region: u32) -> Vec<bool> {
    let mut inside = vec![false; tree.leaves];
    tree.leaves_of(region).iter().for_each(|&l| inside[l as usize] = true);
    inside
}

/// For each part that a chain of regions from a superpixel on joins, the number of the chain's first region that shares a border
/// with it.
fn first_touching(tree: &Hierarchy, parts: &[u32]) -> Vec<usize> {
    // The number of the first region that holds each superpixel: part q makes region q + 1 of region q.
    let mut held_from = vec![0; tree.leaves];
    for (q, &part) in parts.iter().enumerate() {
        tree.leaves_of(part).iter().for_each(|&leaf| held_from[leaf as usize] = q + 1);
    }
    let mut first = vec![usize::MAX; parts.len()];
    for &(a, b, _) in tree.borders.iter() {
        let (a, b) = (held_from[a as usize], held_from[b as usize]);
        if a != b {
            let part = &mut first[a.max(b) - 1];
            *part = a.min(b).min(*part);
        }
    }
    first
}
