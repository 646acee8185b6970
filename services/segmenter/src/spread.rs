//! Label spreading over the neighbour graph, from splats with evidence to splats without.

use crate::NeighbourGraph;
use rayon::prelude::*;

/// The belief about a splat before its prior: `inside` of `weight` is for "inside".
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Belief {
    /// Weight for inside, at most `weight`.
    pub inside: f32,
    /// How much is known, in [0, 1]: 1 where evidence is plenty, falling with each step away from it.
    pub weight: f32,
}

impl Belief {
    /// Probability of lying inside, where nothing known counts as `prior`.
    pub fn probability(&self, prior: f32) -> f32 {
        self.inside + (1.0 - self.weight) * prior
    }
}

/// One random walk with decay per step, absorbed by the anchors:
/// `b_i = a_i + (1 - |a_i|) decay * (sum_j w_ij b_j / sum_j w_ij)`.
///
/// `anchors` hold the beliefs of the evidence (weight 0: none), `affinities` one number per edge of the graph.
/// `beliefs` is where the walk starts and ends, so that a later call goes on from an earlier one; each of the
/// `steps` carries labels one edge further. The same bytes whatever the number of threads.
pub fn spread(
    graph: &NeighbourGraph,
    affinities: &[f32],
    anchors: &[Belief],
    decay: f32,
    steps: u32,
    beliefs: &mut Vec<Belief>,
) {
    beliefs.resize(anchors.len(), Belief::default());
    let mut next = beliefs.clone();
    for _ in 0..steps {
        next.par_iter_mut().enumerate().with_min_len(1024).for_each(|(i, out)| {
            let anchor = anchors[i];
            let open = (1.0 - anchor.weight).max(0.0) * decay;
            let (mut inside, mut weight, mut total) = (0.0, 0.0, 0.0);
            if open > 0.0 {
                for edge in graph.edges(i) {
                    let (w, b) = (affinities[edge], beliefs[graph.neighbour(edge)]);
                    inside += w * b.inside;
                    weight += w * b.weight;
                    total += w;
                }
            }
            let scale = if total > 0.0 { open / total } else { 0.0 };
            *out = Belief { inside: anchor.inside + scale * inside, weight: anchor.weight + scale * weight };
        });
        std::mem::swap(beliefs, &mut next);
    }
}
