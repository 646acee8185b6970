//! Trees grown from the graph of splats: by its distances, and by those in its eigenvectors.

use super::graph::{SplatEdge, SplatGraph, TreeBuilder, quantile};
use super::spectral::{self, Affinities};
use super::tree::{GroupTree, Growth, SceneTree, SplatGroup, TREES};
use rayon::prelude::*;
use segwild_vision::linkage::{LinkageCost, LinkageEdge, MergeTree, agglomerate};

/// Distance `sigma` at which the affinity of two splats has fallen to 1/e (method, section 13). IoU by half, half more: +.103,
/// -.006 on the demo.
const AFFINITY_DISTANCE: f32 = 0.1;

/// Numbers of the spectral embedding per splat (method, section 13). IoU by half, half more: -.005, -.018 on the demo.
const EIGENVECTORS: usize = 12;

/// Share `a` of a spectral tree's distances that comes from the edge itself; the rest is the distance in the embedding (method,
/// section 13). Half and half more changed no measured click.
const EDGE_WEIGHT: f32 = 0.4;

/// Quantile of the distances in the embedding that counts as 1 (method, section 13). By choice. IoU by half, half more: +.028,
/// 0 on the demo.
const EMBEDDING_UNIT: f64 = 0.99;

/// The largest distance in the embedding that counts, in that unit (method, section 13). By choice. IoU by half, half more:
/// -.007, 0 on the demo.
const MAX_EMBEDDING: f32 = 1.5;

/// What the spectral tree's merges cost (method, section 13): small groups go first. `least`: Half and half more changed no
/// measured click. `size`: Half and half more changed no measured click.
const SPECTRAL_COST: LinkageCost = LinkageCost { least: 0.01, size: 0.2 };

/// Nodes of trees that grow at once, at some 700 bytes each: beyond, trees grow one after the other.
const NODES_AT_ONCE: usize = 8 << 20;

impl TreeBuilder<'_> {
    /// The trees and the surfaces of the views.
    pub fn grow(self) -> SceneTree {
        let (graph, shown_by) = (self.graph(), self.shown_by());
        // What was held of each view is most of the memory, and no tree needs it.
        drop(self);
        let surfaces = graph.find_surfaces();
        let trees = graph.grow();
        SceneTree { leaf: graph.node, trees, surfaces, shown_by }
    }
}

impl SplatGraph {
    /// All trees.
    pub fn grow(&self) -> Vec<GroupTree> {
        let at_once = (NODES_AT_ONCE / self.areas.len().max(1)).clamp(1, TREES.len());
        let grown = |trees: &[(usize, Growth)]| -> Vec<GroupTree> {
            trees.par_iter().map(|&(cue, growth)| self.tree(cue, growth)).collect()
        };
        TREES.chunks(at_once).flat_map(grown).collect()
    }

    fn tree(&self, cue: usize, growth: Growth) -> GroupTree {
        let of = |e: &SplatEdge, distance: f32| LinkageEdge { a: e.a, b: e.b, distance, weight: e.weight };
        let merges = match growth {
            Growth::Average => {
                let edges = self.edges.iter().map(|e| of(e, e.distances[cue]));
                agglomerate(&self.areas, edges, LinkageCost { least: 0.01, ..LinkageCost::AVERAGE })
            }
            Growth::Spectral => {
                let embedded = self.embedded(cue);
                let edges = self
                    .edges
                    .iter()
                    .zip(&embedded)
                    .map(|(e, far)| of(e, EDGE_WEIGHT * e.distances[cue] + (1.0 - EDGE_WEIGHT) * far));
                agglomerate(&self.areas, edges, SPECTRAL_COST)
            }
        };
        self.described(merges, cue)
    }

    /// Per edge, the distance of its ends in the spectral embedding, in [0, 1.5].
    fn embedded(&self, cue: usize) -> Vec<f32> {
        let edges = self.edges.iter().map(|e| (e.a, e.b, affinity(e.distances[cue])));
        let rows = spectral::embedding(Affinities::of(self.areas.len(), edges), EIGENVECTORS);
        let row = |i: u32| &rows[i as usize * EIGENVECTORS..(i as usize + 1) * EIGENVECTORS];
        let apart = |e: &SplatEdge| {
            let squares = row(e.a).iter().zip(row(e.b)).map(|(x, y)| (x - y) * (x - y));
            squares.sum::<f32>().sqrt()
        };
        let mut embedded: Vec<f32> = self.edges.par_iter().map(apart).collect();
        let one = quantile(embedded.clone(), EMBEDDING_UNIT).max(1e-12);
        embedded.iter_mut().for_each(|d| *d = (*d / one).min(MAX_EMBEDDING));
        embedded
    }

    /// A tree over the graph's nodes with its groups.
    fn described(&self, merges: MergeTree, cue: usize) -> GroupTree {
        // Per node of the tree: sums over the edges and borders of its leaves, and over those inside it. An edge is inside from
        // the node on at which its ends meet.
        let mut sums =
            RimSums { ends: vec![[0.0; RIM]; merges.len()], inside: vec![[0.0; RIM]; merges.len()] };
        for e in &self.edges {
            let distance = e.distances[cue];
            sums.add(&merges, e.a, e.b, [affinity(distance), distance, 1.0, 0.0, 0.0]);
        }
        let mut nearer = vec![0.0; self.areas.len()];
        for border in &self.borders {
            sums.add(&merges, border.a, border.b, [0.0, 0.0, 0.0, border.length, border.occluding]);
            nearer[border.a as usize] += border.nearer;
            nearer[border.b as usize] -= border.nearer;
        }
        sums.accumulate(&merges);
        let (areas, void, frame) =
            (merges.sums(&self.areas), merges.sums(&self.void), merges.sums(&self.frame));
        let nearer = merges.sums(&nearer);
        let (area, volume) = (areas.last().copied().unwrap_or(0.0), sums.ends.last().map_or(0.0, |s| s[0]));
        let ratio = |a: f64, b: f64| if b > 1e-12 { (a / b) as f32 } else { 0.0 };
        let group = |i: usize| {
            let [affinity, distance, edges, length, occluding] = sums.rim(i);
            let outline = length + void[i];
            SplatGroup {
                area: ratio(areas[i], area),
                rim: ratio(distance, edges),
                inner: ratio(sums.inside[i][1], sums.inside[i][2]),
                cut: ratio(affinity, sums.ends[i][0].min(volume - sums.ends[i][0])).min(1.0),
                outline: outline as f32,
                occluding: ratio(occluding + void[i], outline),
                nearer: ratio(nearer[i] + void[i], occluding + void[i]),
                frame: ratio(frame[i], outline + frame[i]),
            }
        };
        let groups = (0..merges.len()).map(group).collect();
        GroupTree { merges, groups }
    }
}

/// Affinity of two splats.
fn affinity(distance: f32) -> f32 {
    (-distance / AFFINITY_DISTANCE).exp()
}

/// Numbers that are summed over edges and borders: affinity, distance and number of edges; length and occluding length of
/// borders.
const RIM: usize = 5;

/// Sums over what has an end in a node, counted once per end, and over what lies inside it.
struct RimSums {
    ends: Vec<[f64; RIM]>,
    inside: Vec<[f64; RIM]>,
}

impl RimSums {
    fn add(&mut self, merges: &MergeTree, a: u32, b: u32, numbers: [f32; RIM]) {
        let numbers = numbers.map(f64::from);
        let add = |sums: &mut [f64; RIM]| sums.iter_mut().zip(numbers).for_each(|(sum, x)| *sum += x);
        add(&mut self.ends[a as usize]);
        add(&mut self.ends[b as usize]);
        add(&mut self.inside[merges.meet(a, b) as usize]);
    }

    /// Adds every node's sums to its parent's.
    fn accumulate(&mut self, merges: &MergeTree) {
        for sums in [&mut self.ends, &mut self.inside] {
            for i in 0..merges.len() {
                let (own, parent) = (sums[i], merges.parent[i] as usize);
                if parent != i {
                    sums[parent].iter_mut().zip(own).for_each(|(sum, x)| *sum += x);
                }
            }
        }
    }

    /// Sums over what has one end in a node and the other outside.
    fn rim(&self, i: usize) -> [f64; RIM] {
        std::array::from_fn(|k| (self.ends[i][k] - 2.0 * self.inside[i][k]).max(0.0))
    }
}
