//! Sky without a network: superpixels of the colour and smoothness of sky that can be reached from the smooth top of the photo
//! without crossing a clear boundary.

use super::analysis::{Analysis, PixelFeatures};
use super::plane::FloatPlane;
use super::refine::{Energy, cut};
use super::tree::MergeWeights;
use segwild_scene::{Mask, sigmoid};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// The sky's pixels; none when nothing at the top resembles sky.
pub(crate) fn sky(pixels: &PixelFeatures) -> Mask {
    let analysis = &*pixels.analysis;
    let tree = &analysis.tree;
    let (w, h) = (tree.width, tree.height);
    let nothing = Mask::empty(w as u32, h as u32);
    let likeness = sky_likeness(pixels);
    let mut top = vec![0.0f32; tree.leaves];
    for x in 0..w {
        top[tree.labels[x] as usize] += 1.0;
    }
    let seeds: Vec<usize> = (0..tree.leaves).filter(|&i| top[i] > 0.0 && likeness[i] > 0.0).collect();
    let covered: f32 = seeds.iter().map(|&i| top[i]).sum();
    if covered < 0.1 * w as f32 {
        return nothing;
    }
    let reach = bottlenecks(analysis, &seeds, &likeness);
    let inside: Vec<f32> =
        (0..tree.leaves).map(|i| sigmoid(3.0 * (1.0 - reach[i] / 0.25) + likeness[i])).collect();
    let labels = cut(analysis, &Energy { inside, smooth: 6.0 }, 0.0);
    tree.mask(&from_top(analysis, &labels, &top))
}

/// Log-odds that a superpixel is sky by its own colour and smoothness.
fn sky_likeness(pixels: &PixelFeatures) -> Vec<f32> {
    let tree = &pixels.analysis.tree;
    let (gx, gy) = pixels.lab.l.blurred(0.8).gradient();
    let rough = FloatPlane::new(
        tree.width,
        tree.height,
        gx.data.iter().zip(&gy.data).map(|(x, y)| (x * x + y * y).sqrt()).collect(),
    );
    let rough = tree.means(&rough.data);
    let (l, a, b) =
        (tree.means(&pixels.lab.l.data), tree.means(&pixels.lab.a.data), tree.means(&pixels.lab.b.data));
    let rows: Vec<f32> =
        (0..tree.labels.len()).map(|i| (i / tree.width) as f32 / tree.height as f32).collect();
    let rows = tree.means(&rows);
    (0..tree.leaves)
        .map(|i| {
            let smooth = 1.0 - 0.7 * rough[i];
            // Blue and light grey are likely, green and brown are not; warm light counts only when it is bright.
            let blue = ((-b[i]) / 10.0).clamp(-1.0, 1.0) * if b[i] > 0.0 && l[i] > 65.0 { 0.3 } else { 1.0 };
            let light = ((l[i] - 45.0) / 25.0).clamp(-1.0, 1.0);
            let green = ((-a[i] - 6.0) / 6.0).clamp(0.0, 1.0) * ((b[i] + 6.0) / 8.0).clamp(0.0, 1.0);
            let height = 0.5 - rows[i];
            smooth + 0.7 * blue + 0.5 * light - 2.0 * green + 2.0 * height
        })
        .collect()
}

/// For every superpixel the worst step on the best way to it from a seed (0 at the seeds): the boundary crossed, the
/// change of colour, and how unlike sky the superpixel entered is.
fn bottlenecks(analysis: &Analysis, seeds: &[usize], likeness: &[f32]) -> Vec<f32> {
    let tree = &analysis.tree;
    let mut around: Vec<Vec<(u32, f32)>> = vec![Vec::new(); tree.leaves];
    for &(a, b, border) in tree.borders.iter() {
        let unlike =
            super::tree::unlike(&tree.nodes[a as usize], &tree.nodes[b as usize], MergeWeights::main());
        let step = 0.6 * border.mean() + 0.4 * unlike;
        around[a as usize].push((b, step));
        around[b as usize].push((a, step));
    }
    let mut reach = vec![f32::INFINITY; tree.leaves];
    // Steps are not negative, so their bits are in order.
    let mut heap = BinaryHeap::new();
    for &s in seeds {
        reach[s] = 0.0;
        heap.push(Reverse((0u32, s as u32)));
    }
    while let Some(Reverse((bits, i))) = heap.pop() {
        let at = f32::from_bits(bits);
        if at > reach[i as usize] {
            continue;
        }
        for &(j, step) in &around[i as usize] {
            let enter = step + 0.1 * (-likeness[j as usize]).clamp(0.0, 3.0);
            let next = at.max(enter);
            if next < reach[j as usize] {
                reach[j as usize] = next;
                heap.push(Reverse((next.to_bits(), j)));
            }
        }
    }
    reach.iter().map(|r| r.min(2.0)).collect()
}

/// The labelled superpixels that hang together with labelled ones at the top.
fn from_top(analysis: &Analysis, labels: &[bool], top: &[f32]) -> Vec<bool> {
    let tree = &analysis.tree;
    let mut kept: Vec<bool> = labels.iter().zip(top).map(|(&l, &t)| l && t > 0.0).collect();
    loop {
        let mut grown = false;
        for &(a, b, _) in tree.borders.iter() {
            let (a, b) = (a as usize, b as usize);
            if labels[a] && labels[b] && kept[a] != kept[b] {
                (kept[a], kept[b]) = (true, true);
                grown = true;
            }
        }
        if !grown {
            return kept;
        }
    }
}
