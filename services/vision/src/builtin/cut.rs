//! Minimum cut of a small graph (Dinic's algorithm over whole-number capacities, so that it ends and always
//! ends the same way).

/// A two-label energy over nodes: unary costs and pairwise costs for neighbours that differ.
pub(crate) struct GraphCut {
    heads: Vec<Vec<u32>>,
    arcs: Vec<(u32, i64)>,
    nodes: usize,
}

/// Capacity per unit of energy.
const UNIT: f32 = 16384.0;

fn whole(cost: f32) -> i64 {
    // A cost that is not a number binds nothing.
    if cost.is_nan() { 0 } else { (cost.clamp(0.0, 1e6) * UNIT) as i64 }
}

impl GraphCut {
    /// A graph of `nodes` nodes without costs.
    pub fn new(nodes: usize) -> GraphCut {
        GraphCut { heads: vec![Vec::new(); nodes + 2], arcs: Vec::new(), nodes }
    }

    fn arc(&mut self, from: usize, to: usize, forward: i64, back: i64) {
        self.heads[from].push(self.arcs.len() as u32);
        self.arcs.push((to as u32, forward));
        self.heads[to].push(self.arcs.len() as u32);
        self.arcs.push((from as u32, back));
    }

    /// Costs of labelling node `i` inside and outside; both at least 0.
    pub fn unary(&mut self, i: usize, inside: f32, outside: f32) {
        let (inside, outside) = (whole(inside), whole(outside));
        let least = inside.min(outside);
        let (source, sink) = (self.nodes, self.nodes + 1);
        if outside > least {
            self.arc(source, i, outside - least, 0);
        } else if inside > least {
            self.arc(i, sink, inside - least, 0);
        }
    }

    /// Cost of labelling `i` and `j` differently.
    pub fn pair(&mut self, i: usize, j: usize, cost: f32) {
        let cost = whole(cost);
        self.arc(i, j, cost, cost);
    }

    /// The labelling of least energy: true = inside.
    pub fn solve(mut self) -> Vec<bool> {
        let (source, sink) = (self.nodes, self.nodes + 1);
        let mut level = vec![u32::MAX; self.nodes + 2];
        loop {
            level.fill(u32::MAX);
            level[source] = 0;
            let mut queue = vec![source as u32];
            let mut next = 0;
            while next < queue.len() {
                let i = queue[next] as usize;
                next += 1;
                for &arc in &self.heads[i] {
                    let (to, capacity) = self.arcs[arc as usize];
                    if capacity > 0 && level[to as usize] == u32::MAX {
                        level[to as usize] = level[i] + 1;
                        queue.push(to);
                    }
                }
            }
            if level[sink] == u32::MAX {
                return level[..self.nodes].iter().map(|&l| l != u32::MAX).collect();
            }
            self.blocking_flow(&level, source, sink);
        }
    }

    /// Augments along shortest paths until none is left; the path is kept by hand, so depth is no matter.
    fn blocking_flow(&mut self, level: &[u32], source: usize, sink: usize) {
        let mut turn = vec![0usize; self.heads.len()];
        let mut path: Vec<u32> = Vec::new();
        let mut at = source;
        loop {
            if at == sink {
                let flow = path.iter().map(|&a| self.arcs[a as usize].1).min().unwrap_or(0);
                let mut back_to = 0;
                for (k, &a) in path.iter().enumerate().rev() {
                    self.arcs[a as usize].1 -= flow;
                    self.arcs[(a ^ 1) as usize].1 += flow;
                    if self.arcs[a as usize].1 == 0 {
                        back_to = k;
                    }
                }
                at = self.arcs[(path[back_to] ^ 1) as usize].0 as usize;
                path.truncate(back_to);
                continue;
            }
            let mut moved = false;
            while turn[at] < self.heads[at].len() {
                let arc = self.heads[at][turn[at]];
                let (to, capacity) = self.arcs[arc as usize];
                if capacity > 0 && level[to as usize] == level[at] + 1 {
                    path.push(arc);
                    at = to as usize;
                    moved = true;
                    break;
                }
                turn[at] += 1;
            }
            if !moved {
                let Some(arc) = path.pop() else { return };
                at = self.arcs[(arc ^ 1) as usize].0 as usize;
                turn[at] += 1;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// No labelling of a small graph has less energy than the one found.
        #[test]
        fn a_cut_is_minimal(
            unary in prop::collection::vec((0u8..20, 0u8..20), 1..8),
            pairs in prop::collection::vec((0usize..8, 0usize..8, 0u8..12), 0..14),
        ) {
            let n = unary.len();
            let pairs: Vec<_> = pairs.into_iter().filter(|p| p.0 < n && p.1 < n && p.0 != p.1).collect();
            let mut cut = GraphCut::new(n);
            for (i, &(inside, outside)) in unary.iter().enumerate() {
                cut.unary(i, f32::from(inside), f32::from(outside));
            }
            for &(i, j, cost) in &pairs {
                cut.pair(i, j, f32::from(cost));
            }
            let energy = |label: &dyn Fn(usize) -> bool| -> u32 {
                let own: u32 = unary.iter().enumerate().map(|(i, u)| u32::from(if label(i) { u.0 } else { u.1 })).sum();
                own + pairs.iter().map(|&(i, j, c)| if label(i) != label(j) { u32::from(c) } else { 0 }).sum::<u32>()
            };
            let found = cut.solve();
            let least = (0u32..1 << n).map(|bits| energy(&|i| bits >> i & 1 == 1)).min().unwrap();
            prop_assert_eq!(energy(&|i| found[i]), least);
        }
    }
}
