//! A colour model of inside and outside over superpixels: kernel density in colour and position, so that pixels that resemble
//! the object but lie elsewhere count little.

use super::colour::Lab;
use super::tree::Hierarchy;
use std::sync::OnceLock;

/// Superpixels as points in colour and place.
pub(crate) struct ColourSamples {
    /// (L, a, b) in CIE units over the kernel's width, then (x, y) in photo diagonals.
    points: Vec<[f32; 5]>,
    area: Vec<f32>,
    /// Pixels of all.
    total: f32,
    /// Found at the first refinement.
    nearby: OnceLock<SimilarSuperpixels>,
}

/// Width of the colour kernel, in CIE units.
const COLOUR: f32 = 7.0;

/// Reach of refinements, in photo diagonals.
const NEARBY: f32 = 0.05;

/// Superpixels of which those that are similar are kept, at most: photos have fewer, and a damaged cache may say anything.
const MOST_NEARBY: usize = 2048;

impl ColourSamples {
    /// The superpixels of a photo.
    pub fn of(tree: &Hierarchy, lab: &Lab) -> ColourSamples {
        let (w, h) = (tree.width, tree.height);
        let diagonal = ((w * w + h * h) as f32).sqrt();
        let mut points = vec![[0.0f32; 5]; tree.leaves];
        for (i, &label) in tree.labels.iter().enumerate() {
            let p = &mut points[label as usize];
            p[0] += lab.l.data[i] / COLOUR;
            p[1] += 1.4 * lab.a.data[i] / COLOUR;
            p[2] += 1.4 * lab.b.data[i] / COLOUR;
            p[3] += (i % w) as f32 / diagonal;
            p[4] += (i / w) as f32 / diagonal;
        }
        for (p, node) in points.iter_mut().zip(&tree.nodes) {
            p.iter_mut().for_each(|v| *v /= node.area);
        }
        ColourSamples::at(points, tree)
    }

    /// The superpixels of a tree, whose points are known.
    pub fn at(points: Vec<[f32; 5]>, tree: &Hierarchy) -> ColourSamples {
        let area: Vec<f32> = tree.nodes[..tree.leaves].iter().map(|n| n.area).collect();
        ColourSamples { points, total: area.iter().sum(), area, nearby: OnceLock::new() }
    }

    /// Each superpixel as a point.
    pub fn points(&self) -> &[[f32; 5]] {
        &self.points
    }

    /// Posterior of being inside, in [0, 1], per superpixel: the share of `inside` among the superpixels of similar colour within
    /// about `reach` photo diagonals (itself left out), shrunk to 1/2 where few are similar. `inside` is in [0, 1]; superpixels
    /// with weight 0 do not vote.
    pub fn posterior(&self, inside: &[f32], weight: &[f32], reach: f32) -> Vec<f32> {
        let posterior = |i| self.posterior_of(inside, weight, self.similar(i, reach));
        (0..self.points.len()).map(posterior).collect()
    }

    /// The same within [`NEARBY`]. Which superpixels are similar is kept: a click refines each photo round after round.
    pub fn posterior_nearby(&self, inside: &[f32], weight: &[f32]) -> Vec<f32> {
        if self.points.len() > MOST_NEARBY {
            return self.posterior(inside, weight, NEARBY);
        }
        let nearby = self.nearby.get_or_init(|| SimilarSuperpixels::of(self));
        let posterior = |i| self.posterior_of(inside, weight, nearby.of_superpixel(i));
        (0..self.points.len()).map(posterior).collect()
    }

    fn posterior_of(
        &self,
        inside: &[f32],
        weight: &[f32],
        similar: impl Iterator<Item = (usize, f32)>,
    ) -> f32 {
        let prior = 5e-4 * self.total;
        let (mut yes, mut no) = (0.0f32, 0.0f32);
        for (j, kernel) in similar {
            if weight[j] != 0.0 {
                let vote = self.area[j] * weight[j] * kernel;
                yes += vote * inside[j];
                no += vote * (1.0 - inside[j]);
            }
        }
        (yes + 0.5 * prior) / (yes + no + prior)
    }

    /// The other superpixels that are near and of similar colour, in order, with their kernels.
    fn similar(&self, i: usize, reach: f32) -> impl Iterator<Item = (usize, f32)> {
        let near = 1.0 / (2.0 * reach * reach);
        let p = &self.points[i];
        self.points.iter().enumerate().filter_map(move |(j, q)| {
            let distance = ((p[3] - q[3]) * (p[3] - q[3]) + (p[4] - q[4]) * (p[4] - q[4])) * near;
            if distance > 5.0 || j == i {
                return None;
            }
            let colour = (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f32>();
            if colour > 12.0 { None } else { Some((j, (-0.5 * colour - distance).exp())) }
        })
    }

    /// Bytes of what [`ColourSamples::posterior_nearby`] has kept.
    pub fn nearby_bytes(&self) -> usize {
        self.nearby.get().map_or(0, |nearby| size_of_val(&*nearby.similar))
    }
}

/// Which superpixels are near each other and of similar colour.
struct SimilarSuperpixels {
    /// Where those of each superpixel begin, and the end.
    first: Vec<u32>,
    /// Superpixels with their kernels.
    similar: Vec<(u32, f32)>,
}

impl SimilarSuperpixels {
    fn of(samples: &ColourSamples) -> SimilarSuperpixels {
        let (mut first, mut similar) = (vec![0], Vec::new());
        for i in 0..samples.points.len() {
            similar.extend(samples.similar(i, NEARBY).map(|(j, kernel)| (j as u32, kernel)));
            first.push(similar.len() as u32);
        }
        similar.shrink_to_fit();
        SimilarSuperpixels { first, similar }
    }

    fn of_superpixel(&self, i: usize) -> impl Iterator<Item = (usize, f32)> {
        let own = &self.similar[self.first[i] as usize..self.first[i + 1] as usize];
        own.iter().map(|&(j, kernel)| (j as usize, kernel))
    }
}
