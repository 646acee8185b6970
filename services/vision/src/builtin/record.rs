//! The regions of a photo as a cached record: superpixels, and statistics of each. Trees are grown from the record again, in a
//! twentieth of the time that computing it takes.

use super::analysis::Analysis;
use super::colours::ColourSamples;
use super::tree::{BINS, Border, Hierarchy, RegionNode};
use std::sync::Arc;
use wincode::{SchemaRead, SchemaWrite};

/// The regions of one photo, to be kept ([`RegionCache`]).
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Regions {
    /// Width and height of the photo at analysis size, in pixels.
    size: [u32; 2],
    /// Superpixels row by row: which, and for how many pixels.
    runs: Vec<(u16, u32)>,
    /// Per superpixel: pixels, those of them on the photo's frame, and length and strength of its borders.
    leaves: Vec<[f32; 4]>,
    /// Per superpixel: its soft histograms.
    histograms: Vec<[f32; BINS]>,
    /// Per superpixel: its point in colour and position.
    points: Vec<[f32; 5]>,
    /// Neighbours, the first of which is the smaller, with length and strength of the border between them.
    borders: Vec<(u16, u16, [f32; 2])>,
}

/// Keeps regions for later processes.
pub trait RegionCache: Send + Sync {
    /// What is kept under a name; `None` where nothing is, or where it cannot be read.
    fn regions(&self, name: &str) -> Option<Regions>;
    /// Keeps regions under a name. What cannot be kept is computed again when it is needed.
    fn keep(&self, name: &str, regions: &Regions);
}

impl Regions {
    /// What is to be kept of an analysis.
    pub(super) fn of(analysis: &Analysis) -> Regions {
        let tree = &analysis.tree;
        let mut runs: Vec<(u16, u32)> = Vec::new();
        // There are far fewer superpixels than 65,536.
        for label in tree.labels.iter().map(|&label| label as u16) {
            match runs.last_mut() {
                Some((last, length)) if *last == label => *length += 1,
                _ => runs.push((label, 1)),
            }
        }
        let leaves = &tree.nodes[..tree.leaves];
        Regions {
            size: [tree.width as u32, tree.height as u32],
            runs,
            leaves: leaves.iter().map(|n| [n.area, n.frame, n.border.length, n.border.strength]).collect(),
            histograms: leaves.iter().map(|n| n.histogram).collect(),
            points: analysis.samples.points().to_vec(),
            borders: tree
                .borders
                .iter()
                .map(|&(a, b, border)| (a as u16, b as u16, [border.length, border.strength]))
                .collect(),
        }
    }

    /// Without its last run of pixels.
    #[cfg(test)]
    pub(super) fn cut_short(&mut self) {
        self.runs.pop();
    }

    /// The analysis that this was kept of; `None` where it is none of a photo of that size.
    pub(super) fn analysis(&self, width: usize, height: usize) -> Option<Analysis> {
        let count = self.leaves.len();
        let pixels: usize = self.runs.iter().map(|run| run.1 as usize).sum();
        let fits = count > 0
            && self.size.map(|n| n as usize) == [width, height]
            && pixels == width * height
            && self.runs.iter().all(|run| usize::from(run.0) < count)
            && self.borders.iter().all(|&(a, b, _)| a < b && usize::from(b) < count)
            && (self.histograms.len(), self.points.len()) == (count, count);
        if !fits {
            return None;
        }
        let labels = self.runs.iter().flat_map(|&(label, length)| (0..length).map(move |_| u32::from(label)));
        let nodes = self.leaves.iter().zip(&self.histograms).enumerate();
        let leaf =
            |(i, (&[area, frame, length, strength], &histogram)): (usize, (&[f32; 4], &[f32; BINS]))| {
                RegionNode {
                    area,
                    frame,
                    ..RegionNode::leaf(i as u32, Border { length, strength }, histogram)
                }
            };
        let border = |&(a, b, [length, strength]): &(u16, u16, [f32; 2])| {
            (u32::from(a), u32::from(b), Border { length, strength })
        };
        let tree = Hierarchy::of_leaves(
            (width, height),
            labels.collect(),
            nodes.map(leaf).collect(),
            Arc::new(self.borders.iter().map(border).collect()),
        );
        let samples = ColourSamples::at(self.points.clone(), &tree);
        Some(Analysis::new(tree, samples))
    }
}
