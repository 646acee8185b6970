//! Label spreading over the neighbour graph: what is known of some splats is carried to those of which nothing is.

use crate::Graph;
use rayon::prelude::*;

/// What is believed of a splat before its prior: `share` of `weight` says "inside".
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Belief {
    /// Weight that says inside, at most `weight`.
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
/// `anchors` hold what the evidence says (weight 0: nothing), `affinities` one number per edge of the graph.
/// `beliefs` is where the walk starts and ends, so that a later call goes on from an earlier one; each of the
/// `steps` carries labels one edge further. The same bytes whatever the number of threads.
pub fn spread(
    graph: &Graph,
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
