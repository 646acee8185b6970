//! Optional refinement of a selection by a minimum cut of the neighbour graph (method, section 6).

use crate::NeighbourGraph;
use crate::maxflow::FlowNetwork;

/// Whole-number steps per unit of energy.
const STEPS: f32 = 10_000.0;

/// The labels that minimise `sum_i -log P(label_i) + sum_ij w_ij [label_i != label_j]`.
///
/// `probability` has one number per splat, how likely it belongs to the object; `affinities` one per edge.
/// Splats in `frozen` are never selected, nor are those whose probability is not a number.
pub fn graph_cut(
    graph: &NeighbourGraph,
    affinities: &[f32],
    probability: &[f32],
    frozen: Option<&[bool]>,
) -> Vec<bool> {
    let n = graph.len();
    let capacity = |energy: f32| (energy * STEPS).clamp(0.0, 1e9) as u32;
    let barred = |i: usize| frozen.is_some_and(|f| f[i]) || probability[i].is_nan();
    // An edge is in the rows of both of its ends.
    let mut network = FlowNetwork::with_arcs(n, affinities.len());
    for i in 0..n {
        if barred(i) {
            network.add_terminal(i, 0, capacity(f32::MAX));
            continue;
        }
        let p = probability[i].clamp(0.01, 0.99);
        // A node on the sink's side is background: that cuts its arc from the source.
        network.add_terminal(i, capacity(-(1.0 - p).ln()), capacity(-p.ln()));
        for edge in graph.edges(i) {
            let j = graph.neighbour(edge);
            if j > i && !barred(j) {
                let weight = capacity(affinities[edge]);
                network.add_edge(i, j, weight, weight);
            }
        }
    }
    network.solve();
    (0..n).map(|i| network.in_source(i) && !barred(i)).collect()
}
