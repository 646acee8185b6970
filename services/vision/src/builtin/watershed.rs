//! Superpixels: the catchment basins of the boundary strength (Meyer's flooding).

use super::plane::FloatPlane;
use std::cmp::{Ordering, Reverse};
use std::collections::{BTreeMap, BinaryHeap, VecDeque};

/// Labels every pixel with its basin, `0..count`, in the order of the basins' first pixels; ties go to the pixel that
/// came first, so the result depends on nothing else. Basins under `least` pixels join the neighbour over
/// the lowest pass.
pub(crate) fn basins(strength: &FloatPlane, least: usize) -> (Vec<u32>, usize) {
    let (w, h) = (strength.width, strength.height);
    const LEVELS: usize = 512;
    let level: Vec<u16> =
        strength.data.iter().map(|&v| (v.clamp(0.0, 1.0) * (LEVELS - 1) as f32) as u16).collect();
    let mut label = vec![u32::MAX; w * h];
    let count = minima(&level, w, h, &mut label);
    // A queue per level; a pixel enters at its own level, or at the level being flooded if that is higher.
    let mut queues: Vec<VecDeque<u32>> = vec![VecDeque::new(); LEVELS];
    let mut queued: Vec<bool> = label.iter().map(|&l| l != u32::MAX).collect();
    for i in 0..w * h {
        if label[i] != u32::MAX {
            for j in neighbours(i, w, h) {
                if !queued[j] {
                    queued[j] = true;
                    queues[level[j] as usize].push_back(j as u32);
                }
            }
        }
    }
    for flood in 0..LEVELS {
        while let Some(i) = queues[flood].pop_front() {
            let i = i as usize;
            let mut best: Option<(u16, u32)> = None;
            for j in neighbours(i, w, h) {
                if label[j] != u32::MAX {
                    let candidate = (level[j], label[j]);
                    if best.is_none_or(|b| candidate.0 < b.0) {
                        best = Some(candidate);
                    }
                }
            }
            label[i] = best.expect("a queued pixel has a labelled neighbour").1;
            for j in neighbours(i, w, h) {
                if !queued[j] {
                    queued[j] = true;
                    queues[(level[j] as usize).max(flood)].push_back(j as u32);
                }
            }
        }
    }
    absorb(&mut label, count, &strength.data, w, h, least)
}

/// The up to four neighbours of pixel `i`.
pub(crate) fn neighbours(i: usize, w: usize, h: usize) -> impl Iterator<Item = usize> {
    // One division of half the width: this runs many times for every pixel.
    let x = (i as u32 % w as u32) as usize;
    [
        (i >= w).then(|| i - w),
        (x > 0).then(|| i - 1),
        (x + 1 < w).then(|| i + 1),
        (i + w < w * h).then(|| i + w),
    ]
    .into_iter()
    .flatten()
}

/// Labels the regional minima (flat areas with no lower neighbour); returns how many there are.
fn minima(level: &[u16], w: usize, h: usize, label: &mut [u32]) -> usize {
    let mut seen = vec![false; level.len()];
    let (mut count, mut flat) = (0, Vec::new());
    for start in 0..level.len() {
        if seen[start] {
            continue;
        }
        seen[start] = true;
        flat.clear();
        flat.push(start);
        let (mut next, mut lowest) = (0, true);
        while next < flat.len() {
            let i = flat[next];
            next += 1;
            for j in neighbours(i, w, h) {
                if level[j] < level[i] {
                    lowest = false;
                } else if level[j] == level[i] && !seen[j] {
                    seen[j] = true;
                    flat.push(j);
                }
            }
        }
        if lowest {
            flat.iter().for_each(|&i| label[i] = count);
            count += 1;
        }
    }
    count as usize
}

/// Joins small basins to the neighbour over the lowest pass, then numbers what is left in order.
fn absorb(label: &mut [u32], count: usize, s: &[f32], w: usize, h: usize, least: usize) -> (Vec<u32>, usize) {
    let mut area = vec![0usize; count];
    label.iter().for_each(|&l| area[l as usize] += 1);
    let mut passes = Vec::new();
    for i in 0..label.len() {
        for j in neighbours(i, w, h).filter(|&j| j > i && label[j] != label[i]) {
            if area[label[i] as usize] < least || area[label[j] as usize] < least {
                passes.push((s[i].max(s[j]), label[i].min(label[j]), label[i].max(label[j])));
            }
        }
    }
    passes.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut root: Vec<u32> = (0..count as u32).collect();
    fn find(root: &mut [u32], mut i: u32) -> u32 {
        while root[i as usize] != i {
            root[i as usize] = root[root[i as usize] as usize];
            i = root[i as usize];
        }
        i
    }
    for (_, a, b) in passes {
        let (a, b) = (find(&mut root, a), find(&mut root, b));
        if a != b && area[a as usize].min(area[b as usize]) < least {
            let (keep, gone) = (a.min(b), a.max(b));
            root[gone as usize] = keep;
            area[keep as usize] += area[gone as usize];
        }
    }
    let mut number = vec![u32::MAX; count];
    let mut next = 0;
    let labels = label
        .iter()
        .map(|&l| {
            let r = find(&mut root, l) as usize;
            if number[r] == u32::MAX {
                number[r] = next;
                next += 1;
            }
            number[r]
        })
        .collect();
    (labels, next as usize)
}

/// Squared colour difference (CIE units) that superpixels are taken to have at least: keeps them of like size where the photo
/// is flat.
const EVEN: f32 = 10.0;
/// Boundary strength that neighbours are taken to have at least.
const CLEAR: f32 = 0.2;

/// A merge of two superpixels that may be made: its cost, and which they are and when they came to be.
#[derive(PartialEq)]
struct Merge {
    cost: f32,
    pair: (u32, u32),
    born: (u32, u32),
}

impl Eq for Merge {}

impl PartialOrd for Merge {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Merge {
    fn cmp(&self, other: &Self) -> Ordering {
        self.cost.total_cmp(&other.cost).then(self.pair.cmp(&other.pair))
    }
}

/// Merges neighbouring basins until `target` are left, those first whose joining loses least of the photo (Ward's rule:
/// the growth of the squared error when both get one mean), the more the clearer the boundary between them. `planes` are
/// what a superpixel should have one value of; `strength` is in [0, 1].
pub(crate) fn joined(
    labels: &[u32],
    count: usize,
    planes: &[&FloatPlane],
    strength: &FloatPlane,
    target: usize,
) -> (Vec<u32>, usize) {
    let (w, h) = (strength.width, strength.height);
    let mut area = vec![0.0f32; count];
    let mut sums = vec![vec![0.0f32; planes.len()]; count];
    let mut around: Vec<BTreeMap<u32, (f32, f32)>> = vec![BTreeMap::new(); count];
    for i in 0..w * h {
        let a = labels[i];
        area[a as usize] += 1.0;
        sums[a as usize].iter_mut().zip(planes).for_each(|(s, p)| *s += p.data[i]);
        for j in neighbours(i, w, h).filter(|&j| labels[j] != a) {
            let side = around[a as usize].entry(labels[j]).or_default();
            *side = (side.0 + 1.0, side.1 + strength.data[i].max(strength.data[j]));
        }
    }
    let cost = |area: &[f32], sums: &[Vec<f32>], a: usize, b: usize, side: (f32, f32)| {
        let gap: f32 = sums[a].iter().zip(&sums[b]).map(|(x, y)| (x / area[a] - y / area[b]).powi(2)).sum();
        let ward = area[a] * area[b] / (area[a] + area[b]);
        ward * (gap + EVEN) * (CLEAR + side.1 / side.0)
    };
    let mut heap = BinaryHeap::new();
    let mut born = vec![0u32; count];
    for (a, sides) in around.iter().enumerate() {
        for (&b, &side) in sides.range(a as u32 + 1..) {
            let cost = cost(&area, &sums, a, b as usize, side);
            heap.push(Reverse(Merge { cost, pair: (a as u32, b), born: (0, 0) }));
        }
    }
    let mut root: Vec<u32> = (0..count as u32).collect();
    let mut left = count;
    while left > target {
        let Some(Reverse(merge)) = heap.pop() else { break };
        let (a, b) = (merge.pair.0 as usize, merge.pair.1 as usize);
        if root[a] != merge.pair.0 || root[b] != merge.pair.1 || (born[a], born[b]) != merge.born {
            continue;
        }
        left -= 1;
        root[b] = a as u32;
        area[a] += area[b];
        let gone = std::mem::take(&mut sums[b]);
        sums[a].iter_mut().zip(gone).for_each(|(x, y)| *x += y);
        born[a] += 1;
        for (other, side) in std::mem::take(&mut around[b]) {
            around[other as usize].remove(&(b as u32));
            if other as usize != a {
                for (from, to) in [(a, other as usize), (other as usize, a)] {
                    let both = around[from].entry(to as u32).or_default();
                    *both = (both.0 + side.0, both.1 + side.1);
                }
            }
        }
        for (&other, &side) in &around[a] {
            let o = other as usize;
            let pair = (merge.pair.0.min(other), merge.pair.0.max(other));
            let cost = cost(&area, &sums, a, o, side);
            heap.push(Reverse(Merge { cost, pair, born: (born[pair.0 as usize], born[pair.1 as usize]) }));
        }
    }
    // Follow the merges to the root; new numbers are in the order of first pixels.
    let mut number = vec![u32::MAX; count];
    let mut next = 0;
    let merged = labels
        .iter()
        .map(|&l| {
            let mut r = l;
            while root[r as usize] != r {
                r = root[r as usize];
            }
            if number[r as usize] == u32::MAX {
                number[r as usize] = next;
                next += 1;
            }
            number[r as usize]
        })
        .collect();
    (merged, next as usize)
}
