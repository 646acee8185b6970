//! The regions that hold a position, from all trees, each with a score.

use super::analysis::Analysis;
use super::tree::standing;

/// A region that holds the queried position.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RegionCandidate {
    /// Which of [`Analysis::trees`].
    pub tree: usize,
    /// The region in that tree.
    pub region: u32,
    /// Pixels.
    pub area: f32,
    /// Objectness: the region's [`standing`] in its tree, times its mean best IoU with a region of the other trees, which weigh
    /// boundaries, lightness and chroma differently.
    pub score: f32,
}

/// Every region of every tree that holds a superpixel, tree by tree, small to large.
pub(crate) fn around(analysis: &Analysis, leaf: u32) -> Vec<RegionCandidate> {
    let trees: Vec<_> = analysis.trees().collect();
    let chains: Vec<Vec<u32>> = trees.iter().map(|t| t.chain(leaf).collect()).collect();
    // Position in the chain of the smallest region that holds each superpixel: chains nest, so areas shared by a region
    // of one tree and a region of another are sums over a small table of positions.
    let depths: Vec<Vec<u16>> = trees
        .iter()
        .zip(&chains)
        .map(|(tree, chain)| {
            let mut depth = vec![0u16; tree.leaves];
            for (k, pair) in chain.windows(2).enumerate() {
                let [a, b] = tree.nodes[pair[1] as usize].children;
                let new = if a == pair[0] { b } else { a };
                tree.leaves_of(new).iter().for_each(|&l| depth[l as usize] = k as u16 + 1);
            }
            depth
        })
        .collect();
    let mut out = Vec::new();
    for (k, (tree, chain)) in trees.iter().zip(&chains).enumerate() {
        let mut agreement = vec![0.0f32; chain.len()];
        for (m, other) in chains.iter().enumerate().filter(|(m, _)| *m != k) {
            let (rows, columns) = (chain.len(), other.len());
            let mut shared = vec![0.0f32; rows * columns];
            for (l, node) in tree.nodes[..tree.leaves].iter().enumerate() {
                shared[depths[k][l] as usize * columns + depths[m][l] as usize] += node.area;
            }
            for r in 0..rows {
                for c in 0..columns {
                    let up = if r > 0 { shared[(r - 1) * columns + c] } else { 0.0 };
                    let left = if c > 0 { shared[r * columns + c - 1] } else { 0.0 };
                    let both = if r > 0 && c > 0 { shared[(r - 1) * columns + c - 1] } else { 0.0 };
                    shared[r * columns + c] += up + left - both;
                }
            }
            for (r, best) in agreement.iter_mut().enumerate() {
                let area = tree.nodes[chain[r] as usize].area;
                let iou = (0..columns)
                    .map(|c| {
                        let other_area = trees[m].nodes[other[c] as usize].area;
                        shared[r * columns + c] / (area + other_area - shared[r * columns + c])
                    })
                    .fold(0.0, f32::max);
                *best += iou / (chains.len() - 1) as f32;
            }
        }
        for (&region, agreement) in chain.iter().zip(agreement) {
            let trust = if chains.len() > 1 { agreement } else { 1.0 };
            out.push(RegionCandidate {
                tree: k,
                region,
                area: tree.nodes[region as usize].area,
                score: standing(tree, region) * trust,
            });
        }
    }
    out
}
