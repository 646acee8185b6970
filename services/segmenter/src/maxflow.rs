//! Maximum flow by Boykov and Kolmogorov's two search trees (PAMI 2004), with whole-number capacities, so that
//! the minimum cut is exact and the same on every machine.

use std::collections::VecDeque;

const NONE: u32 = u32::MAX;
const TERMINAL: u32 = u32::MAX - 1;
const ORPHAN: u32 = u32::MAX - 2;

#[derive(Clone, Copy, PartialEq, Eq)]
enum Side {
    Free,
    Source,
    Sink,
}

/// A flow network between a source and a sink. Arc `a` and its reverse are `a` and `a ^ 1`.
pub struct FlowNetwork {
    first: Vec<u32>,
    next: Vec<u32>,
    to: Vec<u32>,
    capacity: Vec<i64>,
    /// Residual capacity from the source (positive) or to the sink (negative).
    terminal: Vec<i64>,
    flow: i64,
    side: Vec<Side>,
    /// The arc towards the parent, or one of the three marks above.
    parent: Vec<u32>,
    stamp: Vec<u32>,
    depth: Vec<u32>,
    active: VecDeque<u32>,
    queued: Vec<bool>,
    orphans: VecDeque<u32>,
    time: u32,
}

impl FlowNetwork {
    /// A network of `nodes` nodes and no arc.
    pub fn new(nodes: usize) -> FlowNetwork {
        FlowNetwork::with_arcs(nodes, 0)
    }

    /// The same with memory for so many arcs, two per edge. Of millions of splats they are most of what a cut takes, and arrays
    /// that grow hold up to three times as much while they are copied.
    pub fn with_arcs(nodes: usize, arcs: usize) -> FlowNetwork {
        FlowNetwork {
            first: vec![NONE; nodes],
            next: Vec::with_capacity(arcs),
            to: Vec::with_capacity(arcs),
            capacity: Vec::with_capacity(arcs),
            terminal: vec![0; nodes],
            flow: 0,
            side: vec![Side::Free; nodes],
            parent: vec![NONE; nodes],
            stamp: vec![0; nodes],
            depth: vec![0; nodes],
            active: VecDeque::new(),
            queued: vec![false; nodes],
            orphans: VecDeque::new(),
            time: 0,
        }
    }

    /// Capacities from the source to a node and from the node to the sink; added to earlier ones.
    pub fn add_terminal(&mut self, node: usize, source: u32, sink: u32) {
        let (mut source, mut sink) = (i64::from(source), i64::from(sink));
        let before = self.terminal[node];
        if before > 0 {
            source += before;
        } else {
            sink -= before;
        }
        self.flow += source.min(sink);
        self.terminal[node] = source - sink;
    }

    /// An arc from `a` to `b` and one back.
    pub fn add_edge(&mut self, a: usize, b: usize, forward: u32, backward: u32) {
        for (from, to, capacity) in [(a, b, forward), (b, a, backward)] {
            let arc = self.to.len() as u32;
            self.to.push(to as u32);
            self.capacity.push(i64::from(capacity));
            self.next.push(self.first[from]);
            self.first[from] = arc;
        }
    }

    /// Pushes all the flow there is and returns it: the capacity of the minimum cut.
    pub fn solve(&mut self) -> i64 {
        for node in 0..self.first.len() {
            if self.terminal[node] != 0 {
                self.side[node] = if self.terminal[node] > 0 { Side::Source } else { Side::Sink };
                self.parent[node] = TERMINAL;
                self.depth[node] = 1;
                self.activate(node as u32);
            }
        }
        while let Some(&node) = self.active.front() {
            if self.parent[node as usize] != NONE
                && let Some(arc) = self.grow(node)
            {
                // The node stays active: it may touch the other tree elsewhere.
                self.time += 1;
                self.augment(arc);
                self.adopt();
                continue;
            }
            self.active.pop_front();
            self.queued[node as usize] = false;
        }
        self.flow
    }

    /// After [`FlowNetwork::solve`]: whether a node lies on the source's side of the minimum cut.
    pub fn in_source(&self, node: usize) -> bool {
        self.side[node] == Side::Source
    }

    fn activate(&mut self, node: u32) {
        if !self.queued[node as usize] {
            self.queued[node as usize] = true;
            self.active.push_back(node);
        }
    }

    fn arcs(&self, node: u32) -> u32 {
        self.first[node as usize]
    }

    /// Grows the node's tree by its free neighbours; the arc from the source's tree into the sink's, if it meets it.
    fn grow(&mut self, node: u32) -> Option<u32> {
        let side = self.side[node as usize];
        let mut arc = self.arcs(node);
        while arc != NONE {
            let open = if side == Side::Source {
                self.capacity[arc as usize]
            } else {
                self.capacity[arc as usize ^ 1]
            };
            if open > 0 {
                let other = self.to[arc as usize] as usize;
                if self.side[other] == Side::Free {
                    self.side[other] = side;
                    self.hang(other, arc ^ 1, node);
                    self.activate(other as u32);
                } else if self.side[other] != side {
                    return Some(if side == Side::Source { arc } else { arc ^ 1 });
                } else if self.stamp[other] <= self.stamp[node as usize]
                    && self.depth[other] > self.depth[node as usize] + 1
                {
                    // A shorter way to the root.
                    self.hang(other, arc ^ 1, node);
                }
            }
            arc = self.next[arc as usize];
        }
        None
    }

    fn hang(&mut self, child: usize, arc_to_parent: u32, parent: u32) {
        self.parent[child] = arc_to_parent;
        self.stamp[child] = self.stamp[parent as usize];
        self.depth[child] = self.depth[parent as usize] + 1;
    }

    /// Pushes flow along the path through `middle`, which leads from the source's tree into the sink's.
    fn augment(&mut self, middle: u32) {
        let mut amount = self.capacity[middle as usize];
        for (start, towards_root) in [(middle ^ 1, 1), (middle, 0)] {
            let mut node = self.to[start as usize] as usize;
            while self.parent[node] != TERMINAL {
                let arc = self.parent[node];
                amount = amount.min(self.capacity[arc as usize ^ towards_root]);
                node = self.to[arc as usize] as usize;
            }
            amount = amount.min(self.terminal[node].abs());
        }
        self.capacity[middle as usize] -= amount;
        self.capacity[middle as usize ^ 1] += amount;
        for (start, towards_root) in [(middle ^ 1, 1), (middle, 0)] {
            let mut node = self.to[start as usize] as usize;
            while self.parent[node] != TERMINAL {
                let used = self.parent[node] as usize ^ towards_root;
                self.capacity[used] -= amount;
                self.capacity[used ^ 1] += amount;
                let up = self.to[self.parent[node] as usize] as usize;
                if self.capacity[used] == 0 {
                    self.parent[node] = ORPHAN;
                    self.orphans.push_front(node as u32);
                }
                node = up;
            }
            self.terminal[node] -= self.terminal[node].signum() * amount;
            if self.terminal[node] == 0 {
                self.parent[node] = ORPHAN;
                self.orphans.push_front(node as u32);
            }
        }
        self.flow += amount;
    }

    /// Finds each orphan a new parent of its own tree that still reaches the root, or frees it.
    fn adopt(&mut self) {
        while let Some(orphan) = self.orphans.pop_front() {
            let side = self.side[orphan as usize];
            let open = |net: &FlowNetwork, arc: u32| {
                // Flow runs from the parent to the orphan in the source's tree, the other way in the sink's.
                if side == Side::Source {
                    net.capacity[arc as usize ^ 1] > 0
                } else {
                    net.capacity[arc as usize] > 0
                }
            };
            let mut best = (u32::MAX, NONE);
            let mut arc = self.arcs(orphan);
            while arc != NONE {
                let other = self.to[arc as usize];
                if open(self, arc)
                    && self.side[other as usize] == side
                    && self.parent[other as usize] != NONE
                    && let Some(depth) = self.root_depth(other)
                    && depth < best.0
                {
                    best = (depth, arc);
                }
                arc = self.next[arc as usize];
            }
            self.parent[orphan as usize] = best.1;
            if best.1 != NONE {
                self.stamp[orphan as usize] = self.time;
                self.depth[orphan as usize] = best.0 + 1;
                continue;
            }
            let mut arc = self.arcs(orphan);
            while arc != NONE {
                let other = self.to[arc as usize];
                let parent = self.parent[other as usize];
                if self.side[other as usize] == side && parent != NONE {
                    if open(self, arc) {
                        self.activate(other);
                    }
                    if parent < ORPHAN && self.to[parent as usize] == orphan {
                        self.parent[other as usize] = ORPHAN;
                        self.orphans.push_back(other);
                    }
                }
                arc = self.next[arc as usize];
            }
            self.side[orphan as usize] = Side::Free;
        }
    }

    /// Steps to the root, `None` when the way ends at an orphan; marks the way, so that it is walked once per adoption.
    fn root_depth(&mut self, start: u32) -> Option<u32> {
        let mut node = start as usize;
        let mut steps = 0;
        let root = loop {
            if self.stamp[node] == self.time {
                break self.depth[node];
            }
            match self.parent[node] {
                TERMINAL => {
                    self.stamp[node] = self.time;
                    self.depth[node] = 1;
                    break 1;
                }
                ORPHAN | NONE => return None,
                arc => {
                    node = self.to[arc as usize] as usize;
                    steps += 1;
                }
            }
        };
        let depth = root + steps;
        let (mut node, mut left) = (start as usize, depth);
        while self.stamp[node] != self.time {
            self.stamp[node] = self.time;
            self.depth[node] = left;
            left -= 1;
            node = self.to[self.parent[node] as usize] as usize;
        }
        Some(depth)
    }
}
