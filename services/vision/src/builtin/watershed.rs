//! Superpixels: the catchment basins of the boundary strength (Meyer's flooding).

use super::plane::Plane;
use std::collections::VecDeque;

/// Labels every pixel with its basin, `0..count`, in the order of the basins' first pixels; ties go to the pixel that
/// came first, so the result depends on nothing else. Basins under `least` pixels join the neighbour over
/// the lowest pass.
pub(crate) fn basins(strength: &Plane, least: usize) -> (Vec<u32>, usize) {
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
    let (x, y) = (i % w, i / w);
    [(y > 0).then(|| i - w), (x > 0).then(|| i - 1), (x + 1 < w).then(|| i + 1), (y + 1 < h).then(|| i + w)]
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
