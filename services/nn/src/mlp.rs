//! A stack of dense layers over many points.

use crate::layer::{LayerKind, WeightLayout};
use crate::product::{Strided, product};
use std::ops::Range;

/// Dense layers with a ReLU after each but the last.
#[derive(Clone, Debug)]
pub struct Mlp {
    sizes: Vec<usize>,
    weights: Vec<Range<usize>>,
    last_relu: bool,
}

/// Outputs of each layer, the input first.
#[derive(Clone, Debug)]
pub struct Activations(Vec<Vec<f32>>);

impl Activations {
    /// Output of the last layer, `[point][number]`.
    pub fn result(&self) -> &[f32] {
        self.0.last().expect("at least the input")
    }

    /// The input of the last layer, `[point][number]`.
    pub fn before_last(&self) -> &[f32] {
        &self.0[self.0.len() - 2]
    }
}

impl Mlp {
    /// Layers between `sizes` numbers; `last_relu`: a ReLU after the last one too.
    pub fn new(layout: &mut WeightLayout, name: &str, sizes: &[usize], last_relu: bool) -> Mlp {
        let weights = sizes.windows(2).enumerate().map(|(i, pair)| {
            layout.push(&format!("{name}.{i}"), LayerKind::Dense { input: pair[0], output: pair[1] })
        });
        Mlp { sizes: sizes.to_vec(), weights: weights.collect(), last_relu }
    }

    /// Numbers per point in and out.
    pub fn ends(&self) -> (usize, usize) {
        (self.sizes[0], *self.sizes.last().expect("sizes"))
    }

    /// Where the last layer's weights lie: `[in][out]`, then offsets.
    pub fn last(&self) -> Range<usize> {
        self.weights.last().expect("a layer").clone()
    }

    /// Its layers: numbers in and out, where the weights lie, and whether a ReLU follows.
    pub fn layers(&self) -> impl Iterator<Item = ([usize; 2], Range<usize>, bool)> {
        self.weights
            .iter()
            .enumerate()
            .map(|(k, weights)| ([self.sizes[k], self.sizes[k + 1]], weights.clone(), self.relu_after(k)))
    }

    fn relu_after(&self, layer: usize) -> bool {
        layer + 1 < self.weights.len() || self.last_relu
    }

    /// Runs the points `x`, `[point][number]`.
    ///
    /// # Panics
    /// If `x` is not whole points.
    pub fn forward(&self, weights: &[f32], x: Vec<f32>) -> Activations {
        assert!(x.len().is_multiple_of(self.sizes[0]), "points");
        let points = x.len() / self.sizes[0];
        let mut all = vec![x];
        for (layer, range) in self.weights.iter().enumerate() {
            let [input, output] = [self.sizes[layer], self.sizes[layer + 1]];
            let (matrix, offsets) = weights[range.clone()].split_at(input * output);
            let mut out = vec![0.0; points * output];
            out.chunks_exact_mut(output).for_each(|point| point.copy_from_slice(offsets));
            let x = Strided::of(&all[layer], input);
            product(x, (matrix, output), [points, input, output], (&mut out, output), true);
            if self.relu_after(layer) {
                out.iter_mut().for_each(|v| *v = v.max(0.0));
            }
            all.push(out);
        }
        Activations(all)
    }

    /// The weight matrices, transposed, for [`Mlp::backward`].
    pub fn turned(&self, weights: &[f32]) -> Vec<Vec<f32>> {
        let turn = |(layer, range): (usize, &Range<usize>)| {
            let [input, output] = [self.sizes[layer], self.sizes[layer + 1]];
            let from = &weights[range.clone()];
            let mut to = vec![0.0; input * output];
            for i in 0..input {
                for o in 0..output {
                    to[o * input + i] = from[i * output + o];
                }
            }
            to
        };
        self.weights.iter().enumerate().map(turn).collect()
    }

    /// Gradient of the first `wanted` numbers of each point, `[point][wanted]`, from that of the result. Adds the gradient of
    /// the weights to `sums`, whose first element belongs to the first weight of the first layer.
    pub fn backward(
        &self,
        turned: &[Vec<f32>],
        of: &Activations,
        mut grad: Vec<f32>,
        sums: &mut [f32],
        wanted: usize,
    ) -> Vec<f32> {
        let first = self.weights[0].start;
        let points = of.0[0].len() / self.sizes[0];
        for (layer, range) in self.weights.iter().enumerate().rev() {
            let [input, output] = [self.sizes[layer], self.sizes[layer + 1]];
            if self.relu_after(layer) {
                grad.iter_mut().zip(&of.0[layer + 1]).for_each(|(g, v)| *g = if *v > 0.0 { *g } else { 0.0 });
            }
            let own = &mut sums[range.start - first..range.end - first];
            let (matrix, offsets) = own.split_at_mut(input * output);
            for point in grad.chunks_exact(output) {
                offsets.iter_mut().zip(point).for_each(|(sum, g)| *sum += g);
            }
            let x = Strided::transposed(&of.0[layer], input);
            product(x, (&grad, output), [input, points, output], (matrix, output), true);
            let wanted = if layer == 0 { wanted } else { input };
            let mut next = vec![0.0; points * wanted];
            let grad_of = Strided::of(&grad, output);
            product(grad_of, (&turned[layer], input), [points, output, wanted], (&mut next, wanted), false);
            grad = next;
        }
        grad
    }

    /// Number of weights of all layers together; they lie side by side.
    pub fn range(&self) -> Range<usize> {
        self.weights[0].start..self.last().end
    }
}
