//! The minimum cut against all cuts of small networks.

use proptest::prelude::*;
use segwild_segmenter::FlowNetwork;

type Arc = (usize, usize, u32, u32);

fn capacity_of(cut: u32, terminals: &[(u32, u32)], arcs: &[Arc]) -> i64 {
    let source = |i: usize| cut >> i & 1 == 1;
    let ends: i64 =
        terminals.iter().enumerate().map(|(i, t)| i64::from(if source(i) { t.1 } else { t.0 })).sum();
    let crossing: i64 = arcs
        .iter()
        .map(|&(a, b, forward, backward)| match (source(a), source(b)) {
            (true, false) => i64::from(forward),
            (false, true) => i64::from(backward),
            _ => 0,
        })
        .sum();
    ends + crossing
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn flow_is_the_smallest_cut_and_the_sides_are_one(
        terminals in proptest::collection::vec((0u32..12, 0u32..12), 1..11),
        raw in proptest::collection::vec((0usize..11, 0usize..11, 0u32..9, 0u32..9), 0..40),
    ) {
        let n = terminals.len();
        let arcs: Vec<Arc> = raw.into_iter().map(|(a, b, f, r)| (a % n, b % n, f, r)).filter(|a| a.0 != a.1).collect();
        let mut network = FlowNetwork::new(n);
        for (i, t) in terminals.iter().enumerate() {
            // In two parts: capacities add up.
            network.add_terminal(i, t.0 / 2, t.1);
            network.add_terminal(i, t.0 - t.0 / 2, 0);
        }
        for a in &arcs {
            network.add_edge(a.0, a.1, a.2, a.3);
        }
        let flow = network.solve();
        let best = (0..1u32 << n).map(|cut| capacity_of(cut, &terminals, &arcs)).min().unwrap();
        prop_assert_eq!(flow, best);
        let own = (0..n).filter(|&i| network.in_source(i)).fold(0, |cut, i| cut | 1 << i);
        prop_assert_eq!(capacity_of(own, &terminals, &arcs), best);
    }
}

#[test]
fn a_noisy_grid_is_smoothed() {
    // 60 x 60 nodes, left half object; every 17th node is wrong. Smoothing puts all of them right.
    let side = 60;
    let truth = |i: usize| i % side < side / 2;
    let mut network = FlowNetwork::new(side * side);
    for i in 0..side * side {
        let seems = truth(i) != (i % 17 == 0);
        network.add_terminal(i, if seems { 30 } else { 10 }, if seems { 10 } else { 30 });
        if i % side + 1 < side {
            network.add_edge(i, i + 1, 12, 12);
        }
        if i + side < side * side {
            network.add_edge(i, i + side, 12, 12);
        }
    }
    network.solve();
    let wrong = (0..side * side).filter(|&i| network.in_source(i) != truth(i)).count();
    assert!(wrong <= 4, "{wrong} of {}", side * side);
}
