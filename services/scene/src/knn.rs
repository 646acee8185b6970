//! Exact nearest neighbours in three dimensions: a balanced kd-tree with buckets.

use rayon::prelude::*;

/// Points per bucket at most.
const BUCKET: usize = 12;

/// Queries whose results are held at once, beside those that are in their rows already.
const QUERIES_AT_ONCE: usize = 1 << 16;

/// Queries that one task answers.
const QUERIES_OF_TASK: usize = 256;

/// Stands for "no neighbour".
pub const NONE: u32 = u32::MAX;

/// Coordinates beyond this overflow when squared; such points have no neighbours.
const FAR: f32 = 1e15;

/// The nearest neighbours of every point.
#[derive(Clone, Debug, PartialEq)]
pub struct Neighbours {
    /// Neighbours per point.
    pub k: usize,
    /// `[point][rank]`, nearest first, flat; [`NONE`] where there are fewer than `k`.
    pub index: Vec<u32>,
    /// Squared distances, laid out as `index`; infinite where there is none.
    pub distance2: Vec<f32>,
}

#[derive(Clone, Copy)]
struct KnnEntry {
    position: [f32; 3],
    id: u32,
}

struct Tree {
    entries: Vec<KnnEntry>,
    /// Axis and position of each split, as a heap: the children of `i` are `2 i + 1` and `2 i + 2`.
    splits: Vec<(u8, f32)>,
    depth: u32,
}

/// Points among which the nearest to any other point is found.
pub struct NearestPoint {
    tree: Tree,
}

impl NearestPoint {
    /// Points that are not finite are nobody's nearest.
    pub fn of(points: &[[f32; 3]]) -> NearestPoint {
        NearestPoint { tree: Tree::new(entries_of(points)) }
    }

    /// Index of the point nearest to a position, and the distance; `None` where there is none.
    ///
    /// ```
    /// use segwild_scene::knn::NearestPoint;
    /// let points = NearestPoint::of(&[[0.0; 3], [1.0, 0.0, 0.0], [f32::NAN; 3]]);
    /// assert_eq!(points.to([0.75, 0.0, 0.0]), Some((1, 0.25)));
    /// assert_eq!(NearestPoint::of(&[]).to([0.0; 3]), None);
    /// ```
    pub fn to(&self, position: [f32; 3]) -> Option<(usize, f32)> {
        let mut best = [(f32::INFINITY, NONE)];
        let query = KnnEntry { position, id: NONE };
        self.tree.search(0, 0, 0..self.tree.entries.len(), &query, [0.0; 3], &mut best);
        let [(distance2, id)] = best;
        (id != NONE).then(|| (id as usize, distance2.sqrt()))
    }
}

fn entries_of(points: &[[f32; 3]]) -> Vec<KnnEntry> {
    let usable = |p: &[f32; 3]| p.iter().all(|x| x.abs() < FAR);
    let all = points.iter().enumerate().filter(|(_, p)| usable(p));
    all.map(|(i, &position)| KnnEntry { position, id: i as u32 }).collect()
}

/// Squared distance of two points. It is the one of [`Neighbours::distance2`], to the last bit, in either order.
#[inline]
pub fn distance2(a: [f32; 3], b: [f32; 3]) -> f32 {
    let d = [0, 1, 2].map(|axis| a[axis] - b[axis]);
    d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
}

/// The `k` nearest other points of every point, exactly; points that are not finite have none and are nobody's
/// neighbour. Equal distances are resolved the same way on every run. Besides the result it takes 16 bytes per point.
pub fn nearest(points: &[[f32; 3]], k: usize) -> Neighbours {
    let mut out = Neighbours {
        k,
        index: vec![NONE; points.len() * k],
        distance2: vec![f32::INFINITY; points.len() * k],
    };
    if k == 0 {
        return out;
    }
    let tree = Tree::new(entries_of(points));
    let mut found = vec![(f32::INFINITY, NONE); tree.entries.len().min(QUERIES_AT_ONCE) * k];
    // Queries run in the tree's order, in which consecutive ones touch the same buckets.
    for queries in tree.entries.chunks(QUERIES_AT_ONCE) {
        let rows = &mut found[..queries.len() * k];
        let tasks = rows.par_chunks_mut(QUERIES_OF_TASK * k).zip(queries.par_chunks(QUERIES_OF_TASK));
        tasks.for_each(|(rows, queries)| {
            for (best, query) in rows.chunks_exact_mut(k).zip(queries) {
                best.fill((f32::INFINITY, NONE));
                tree.search(0, 0, 0..tree.entries.len(), query, [0.0; 3], best);
            }
        });
        for (query, row) in queries.iter().zip(rows.chunks_exact(k)) {
            let at = query.id as usize * k;
            for (rank, &(distance2, id)) in row.iter().enumerate() {
                out.index[at + rank] = id;
                out.distance2[at + rank] = distance2;
            }
        }
    }
    out
}

impl Neighbours {
    /// Mean distance of every point to its neighbours; infinite where there is none.
    pub fn mean_distances(&self) -> Vec<f32> {
        let mean = |row: &[f32]| {
            let (sum, count) =
                row.iter().filter(|d| d.is_finite()).fold((0.0, 0), |(s, n), d| (s + d.sqrt(), n + 1));
            if count == 0 { f32::INFINITY } else { sum / count as f32 }
        };
        self.distance2.chunks(self.k.max(1)).map(mean).collect()
    }
}

impl Tree {
    fn new(mut entries: Vec<KnnEntry>) -> Tree {
        let mut depth = 0;
        while entries.len().div_ceil(1 << depth) > BUCKET {
            depth += 1;
        }
        let mut splits = vec![(0, 0.0); (1 << depth) - 1];
        let levels = split(&mut entries, depth);
        // `split` returns the nodes in pre-order; the heap order is what the search walks.
        let mut next = levels.into_iter();
        fill(&mut splits, 0, depth, &mut next);
        Tree { entries, splits, depth }
    }

    /// Visits the buckets nearest first. `offset` is the vector from the query to the node's cell; no point of the
    /// cell is nearer than its length.
    fn search(
        &self,
        node: usize,
        level: u32,
        range: std::ops::Range<usize>,
        query: &KnnEntry,
        offset: [f32; 3],
        best: &mut [(f32, u32)],
    ) {
        let k = best.len();
        if level == self.depth {
            for entry in &self.entries[range] {
                let candidate = (distance2(entry.position, query.position), entry.id);
                if candidate < best[k - 1] && entry.id != query.id {
                    let mut at = k - 1;
                    while at > 0 && candidate < best[at - 1] {
                        best[at] = best[at - 1];
                        at -= 1;
                    }
                    best[at] = candidate;
                }
            }
            return;
        }
        let (axis, position) = self.splits[node];
        let axis = axis as usize;
        let middle = range.start + range.len() / 2;
        let to_plane = position - query.position[axis];
        let (low, high) = (range.start..middle, middle..range.end);
        let (near, far) = if to_plane > 0.0 { (0, 1) } else { (1, 0) };
        let halves = [low, high];
        self.search(2 * node + 1 + near, level + 1, halves[near].clone(), query, offset, best);
        let mut beyond = offset;
        beyond[axis] = to_plane;
        let bound = beyond[0] * beyond[0] + beyond[1] * beyond[1] + beyond[2] * beyond[2];
        // The rounding of the bound must not hide a point; points at exactly the worst distance are not
        // worth a visit, or a pile of duplicates would be searched whole.
        if bound * 0.999_999 < best[k - 1].0 {
            self.search(2 * node + 1 + far, level + 1, halves[far].clone(), query, beyond, best);
        }
    }
}

/// Sorts entries into the halves of the median along the widest axis, down to `depth`; the splits in pre-order.
fn split(entries: &mut [KnnEntry], depth: u32) -> Vec<(u8, f32)> {
    if depth == 0 {
        return Vec::new();
    }
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for entry in entries.iter() {
        for a in 0..3 {
            low[a] = low[a].min(entry.position[a]);
            high[a] = high[a].max(entry.position[a]);
        }
    }
    let mut axis = 0;
    for a in 1..3 {
        if high[a] - low[a] > high[axis] - low[axis] {
            axis = a;
        }
    }
    let middle = entries.len() / 2;
    entries.select_nth_unstable_by(middle, |a, b| {
        a.position[axis].total_cmp(&b.position[axis]).then(a.id.cmp(&b.id))
    });
    let position = entries[middle].position[axis];
    let (left, right) = entries.split_at_mut(middle);
    let (left, right) = if left.len() > 4096 {
        rayon::join(|| split(left, depth - 1), || split(right, depth - 1))
    } else {
        (split(left, depth - 1), split(right, depth - 1))
    };
    let mut nodes = vec![(axis as u8, position)];
    nodes.extend(left);
    nodes.extend(right);
    nodes
}

fn fill(heap: &mut [(u8, f32)], node: usize, depth: u32, preorder: &mut impl Iterator<Item = (u8, f32)>) {
    if depth == 0 {
        return;
    }
    if let Some(split) = preorder.next() {
        heap[node] = split;
        fill(heap, 2 * node + 1, depth - 1, preorder);
        fill(heap, 2 * node + 2, depth - 1, preorder);
    }
}
