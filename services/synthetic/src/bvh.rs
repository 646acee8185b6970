//! A bounding-volume hierarchy over the solids.

use crate::shape::SolidShape;
use glam::{Vec3, Vec3A};

#[derive(Clone, Copy, Debug)]
struct BvhNode {
    low: Vec3A,
    high: Vec3A,
    /// Leaf: first entry of `order`. Branch: index of the second child (the first follows its parent).
    next: u32,
    /// Solids in a leaf; 0 for a branch.
    count: u32,
}

/// Finds what a ray meets without trying every solid.
#[derive(Clone, Debug)]
pub struct Bvh {
    nodes: Vec<BvhNode>,
    order: Vec<u32>,
}

/// Most solids in a leaf.
const LEAF: usize = 4;
/// Cost of a box test relative to a solid's (surface-area heuristic).
const BOX_COST: f32 = 0.6;
/// Deepest stack a traversal needs; the build falls back to halving before it is reached.
const STACK: usize = 32;

impl Bvh {
    /// Builds the hierarchy by the surface-area heuristic, swept over all three axes.
    pub fn new(shapes: &[SolidShape]) -> Bvh {
        // A hair of slack keeps rays that graze a face inside the box.
        let slack = |(low, high): (Vec3, Vec3)| (low - 1e-4, high + 1e-4);
        let bounds: Vec<(Vec3, Vec3)> = shapes.iter().map(|s| slack(s.bounds())).collect();
        let mut bvh = Bvh { nodes: Vec::new(), order: (0..shapes.len() as u32).collect() };
        if !shapes.is_empty() {
            bvh.split(&bounds, 0, shapes.len(), 0);
        }
        bvh
    }

    fn split(&mut self, bounds: &[(Vec3, Vec3)], from: usize, to: usize, level: usize) {
        let empty = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let grow = |a: (Vec3, Vec3), i: u32| {
            let b = bounds[i as usize];
            (a.0.min(b.0), a.1.max(b.1))
        };
        let area = |(low, high): (Vec3, Vec3)| {
            let s = high - low;
            s.x * s.y + s.y * s.z + s.z * s.x
        };
        let all = self.order[from..to].iter().fold(empty, |a, &i| grow(a, i));
        let at = self.nodes.len();
        let count = to - from;
        self.nodes.push(BvhNode {
            low: all.0.into(),
            high: all.1.into(),
            next: from as u32,
            count: count as u32,
        });
        let sort = |order: &mut [u32], axis: usize| {
            let centre = |i: u32| bounds[i as usize].0[axis] + bounds[i as usize].1[axis];
            order.sort_by(|&a, &b| centre(a).total_cmp(&centre(b)).then(a.cmp(&b)));
        };
        let mut best = (f32::INFINITY, 0, from + count / 2);
        for axis in 0..3 {
            let order = &mut self.order[from..to];
            sort(order, axis);
            let mut after = vec![0.0; count];
            let mut reach = empty;
            for k in (1..count).rev() {
                reach = grow(reach, order[k]);
                after[k] = area(reach) * (count - k) as f32;
            }
            reach = empty;
            for k in 1..count {
                reach = grow(reach, order[k - 1]);
                let cost = area(reach) * k as f32 + after[k];
                if cost < best.0 {
                    best = (cost, axis, from + k);
                }
            }
        }
        let worth = best.0 / area(all).max(1e-9) + 2.0 * BOX_COST < count as f32;
        if count == 1 || (count <= LEAF && !worth) {
            return;
        }
        sort(&mut self.order[from..to], best.1);
        let middle = if level + 16 < STACK { best.2 } else { from + count / 2 };
        self.split(bounds, from, middle, level + 1);
        self.nodes[at].count = 0;
        self.nodes[at].next = self.nodes.len() as u32;
        self.split(bounds, middle, to, level + 1);
    }

    /// Nearest solid along a ray between `least` and `most`: its index and distance.
    pub fn closest(
        &self,
        shapes: &[SolidShape],
        o: Vec3,
        d: Vec3,
        least: f32,
        most: f32,
    ) -> Option<(usize, f32)> {
        let (mut best, mut found) = (most, None);
        self.walk(
            o,
            d,
            |i, bound| {
                if let Some(t) = shapes[i].hit(o, d, least)
                    && t < best
                {
                    best = t;
                    found = Some((i, t));
                }
                *bound = best;
                false
            },
            most,
        );
        found
    }

    /// Whether anything lies along a ray between `least` and `most`.
    pub fn blocked(&self, shapes: &[SolidShape], o: Vec3, d: Vec3, least: f32, most: f32) -> bool {
        let mut blocked = false;
        self.walk(
            o,
            d,
            |i, _| {
                blocked = shapes[i].hit(o, d, least).is_some_and(|t| t < most);
                blocked
            },
            most,
        );
        blocked
    }

    /// Visits solids whose boxes the ray crosses nearer than the bound, nearer boxes first, until `visit` says stop.
    fn walk(&self, o: Vec3, d: Vec3, mut visit: impl FnMut(usize, &mut f32) -> bool, most: f32) {
        let (o, inverse) = (Vec3A::from(o), Vec3A::from(d).recip());
        let enter = |node: &BvhNode, bound: f32| {
            let (a, b) = ((node.low - o) * inverse, (node.high - o) * inverse);
            let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
            // Plain comparisons: `f32::max` would guard against NaNs that boxes of solids cannot have.
            let near = if near > 0.0 { near } else { 0.0 };
            let far = if far < bound { far } else { bound };
            if near <= far { near } else { f32::INFINITY }
        };
        let mut bound = most;
        let mut stack = [(0u32, 0.0f32); STACK];
        let mut depth = 0;
        let Some(root) = self.nodes.first() else { return };
        let mut current = (0u32, enter(root, bound));
        if current.1.is_infinite() {
            return;
        }
        loop {
            let node = &self.nodes[current.0 as usize];
            let mut go = None;
            if node.count > 0 {
                for k in node.next..node.next + node.count {
                    if visit(self.order[k as usize] as usize, &mut bound) {
                        return;
                    }
                }
            } else {
                let (a, b) = (current.0 + 1, node.next);
                let (ta, tb) = (enter(&self.nodes[a as usize], bound), enter(&self.nodes[b as usize], bound));
                let (near, far) = if ta <= tb { ((a, ta), (b, tb)) } else { ((b, tb), (a, ta)) };
                if near.1.is_finite() {
                    go = Some(near);
                    if far.1.is_finite() {
                        stack[depth] = far;
                        depth += 1;
                    }
                }
            }
            current = match go {
                Some(next) => next,
                None => loop {
                    if depth == 0 {
                        return;
                    }
                    depth -= 1;
                    if stack[depth].1 < bound {
                        break stack[depth];
                    }
                },
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Rng;
    use crate::shape::tests::some_shapes;

    #[test]
    fn the_hierarchy_finds_what_trying_every_solid_finds() {
        let mut rng = Rng::new(6, 0);
        let shapes = some_shapes(&mut rng);
        let bvh = Bvh::new(&shapes);
        let mut met = 0;
        for _ in 0..4000 {
            let o = rng.triple(-8.0, 8.0);
            let d = (rng.triple(-3.0, 3.0) - o).normalize();
            let each = shapes.iter().filter_map(|s| s.hit(o, d, 1e-4)).fold(f32::INFINITY, f32::min);
            let found = bvh.closest(&shapes, o, d, 1e-4, 1e4).map_or(f32::INFINITY, |h| h.1);
            assert_eq!(each, found);
            assert_eq!(bvh.blocked(&shapes, o, d, 1e-4, 1e4), each.is_finite());
            met += usize::from(each.is_finite());
        }
        assert!(met > 400);
    }
}
