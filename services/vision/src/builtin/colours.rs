//! A colour model of inside and outside over superpixels: kernel density in colour and position, so that pixels that resemble
//! the object but lie elsewhere count little.

use super::colour::Lab;
use super::tree::Hierarchy;

/// Superpixels as points in colour and place.
pub(crate) struct ColourSamples {
    /// (L, a, b) in CIE units over the kernel's width, then (x, y) in photo diagonals.
    points: Vec<[f32; 5]>,
    area: Vec<f32>,
}

/// Width of the colour kernel, in CIE units.
const COLOUR: f32 = 7.0;

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
        ColourSamples { points, area: tree.nodes[..tree.leaves].iter().map(|n| n.area).collect() }
    }

    /// Each superpixel as a point.
    pub fn points(&self) -> &[[f32; 5]] {
        &self.points
    }

    /// Posterior of being inside, in [0, 1], per superpixel: the share of `inside` among the superpixels of similar colour within
    /// about `reach` photo diagonals (itself left out), shrunk to 1/2 where few are similar. `inside` is in [0, 1]; superpixels
    /// with weight 0 do not vote.
    pub fn posterior(&self, inside: &[f32], weight: &[f32], reach: f32) -> Vec<f32> {
        let total: f32 = self.area.iter().sum();
        let near = 1.0 / (2.0 * reach * reach);
        let prior = 5e-4 * total;
        (0..self.points.len())
            .map(|i| {
                let p = &self.points[i];
                let (mut yes, mut no) = (0.0f32, 0.0f32);
                for (j, q) in self.points.iter().enumerate() {
                    let distance = ((p[3] - q[3]) * (p[3] - q[3]) + (p[4] - q[4]) * (p[4] - q[4])) * near;
                    if distance > 5.0 || j == i || weight[j] == 0.0 {
                        continue;
                    }
                    let colour = (0..3).map(|k| (p[k] - q[k]) * (p[k] - q[k])).sum::<f32>();
                    if colour > 12.0 {
                        continue;
                    }
                    let vote = self.area[j] * weight[j] * (-0.5 * colour - distance).exp();
                    yes += vote * inside[j];
                    no += vote * (1.0 - inside[j]);
                }
                (yes + 0.5 * prior) / (yes + no + prior)
            })
            .collect()
    }
}
