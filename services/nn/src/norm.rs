//! Normalisation within one image. No statistics are shared across photos, as a batch norm would do.

use crate::layer::{LayerKind, WeightLayout};
use crate::map::Map;
use rayon::prelude::*;
use std::ops::Range;

/// Group norm; instance norm where every plane is a group.
#[derive(Clone, Debug)]
pub struct GroupNorm {
    channels: usize,
    groups: usize,
    weights: Range<usize>,
}

/// What [`GroupNorm::backward`] needs: normalised values, and one over each group's deviation.
#[derive(Clone, Debug)]
pub struct NormState {
    normal: Map,
    scale: Vec<f32>,
}

/// [`GroupNorm`] adds it to the variance.
pub const EPSILON: f64 = 1e-5;

impl GroupNorm {
    /// `channels` planes in `groups` groups of equal size.
    ///
    /// # Panics
    /// If the groups cannot be of equal size.
    pub fn new(layout: &mut WeightLayout, name: &str, channels: usize, groups: usize) -> GroupNorm {
        assert!(groups > 0 && channels.is_multiple_of(groups), "{channels} planes in {groups} groups");
        GroupNorm { channels, groups, weights: layout.push(name, LayerKind::Norm { channels, groups }) }
    }

    /// Its type and sizes.
    pub fn kind(&self) -> LayerKind {
        LayerKind::Norm { channels: self.channels, groups: self.groups }
    }

    /// Range of its weights.
    pub fn weights(&self) -> Range<usize> {
        self.weights.clone()
    }

    /// Normalised planes.
    pub fn forward(&self, weights: &[f32], x: Map) -> (Map, NormState) {
        assert_eq!(x.channels, self.channels, "planes");
        let n = x.pixels();
        let mut normal = x;
        let scale: Vec<f32> = normal
            .data
            .par_chunks_mut(n * self.channels / self.groups)
            .map(|group| {
                let many = group.len() as f64;
                let mean = sums(group, |v| v) / many;
                let centre = mean as f32;
                let variance = sums(group, |v| (v - centre) * (v - centre)) / many;
                let scale = (1.0 / (variance + EPSILON).sqrt()) as f32;
                group.iter_mut().for_each(|v| *v = (*v - centre) * scale);
                scale
            })
            .collect();
        let (factors, offsets) = weights[self.weights.clone()].split_at(self.channels);
        let mut out = normal.clone();
        out.data.par_chunks_mut(n).enumerate().for_each(|(c, plane)| {
            plane.iter_mut().for_each(|v| *v = *v * factors[c] + offsets[c]);
        });
        (out, NormState { normal, scale })
    }

    /// Gradient of the input; adds that of the weights to `sums`.
    pub fn backward(&self, weights: &[f32], state: &NormState, mut grad: Map, sums: &mut [f32]) -> Map {
        let n = grad.pixels();
        let factors = &weights[self.weights.clone()][..self.channels];
        let (to_factors, to_offsets) = sums[self.weights.clone()].split_at_mut(self.channels);
        for c in 0..self.channels {
            let (g, x) = (grad.plane(c), state.normal.plane(c));
            to_factors[c] += pair_sum(g, x) as f32;
            to_offsets[c] += self::sums(g, |v| v) as f32;
        }
        let size = self.channels / self.groups;
        grad.data.par_chunks_mut(n * size).zip(state.normal.data.par_chunks(n * size)).enumerate().for_each(
            |(k, (grad, normal))| {
                for (c, plane) in grad.chunks_exact_mut(n).enumerate() {
                    plane.iter_mut().for_each(|g| *g *= factors[k * size + c]);
                }
                let many = grad.len() as f64;
                let mean = (self::sums(grad, |v| v) / many) as f32;
                let along = (pair_sum(grad, normal) / many) as f32;
                for (g, x) in grad.iter_mut().zip(normal) {
                    *g = state.scale[k] * (*g - mean - x * along);
                }
            },
        );
        grad
    }
}

/// Sum of a function of the values: short runs in f32, their sums in f64.
fn sums(values: &[f32], f: impl Fn(f32) -> f32) -> f64 {
    values.chunks(64).map(|run| f64::from(run.iter().map(|&v| f(v)).sum::<f32>())).sum()
}

fn pair_sum(a: &[f32], b: &[f32]) -> f64 {
    let run = |(a, b): (&[f32], &[f32])| f64::from(a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>());
    a.chunks(64).zip(b.chunks(64)).map(run).sum()
}
