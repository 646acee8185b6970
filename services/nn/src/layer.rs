//! Layout of the weights of a network in one flat slice.

use std::ops::Range;

/// Type of a layer, with the sizes that an engine needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LayerKind {
    /// Convolution with a square kernel: `[out][in][row][column]`, then `[out]` offsets.
    Conv {
        /// Planes in.
        input: usize,
        /// Planes out.
        output: usize,
        /// Side of the kernel.
        kernel: usize,
        /// Pixels from one position of the kernel to the next.
        stride: usize,
    },
    /// Transposed convolution, kernel and stride 2: `[out][row][column][in]`, then `[out]` offsets.
    Up {
        /// Planes in.
        input: usize,
        /// Planes out.
        output: usize,
    },
    /// Group norm: `[channel]` factors, then `[channel]` offsets.
    Norm {
        /// Planes.
        channels: usize,
        /// Groups of planes that share mean and variance.
        groups: usize,
    },
    /// All to all: `[in][out]`, then `[out]` offsets.
    Dense {
        /// Numbers in.
        input: usize,
        /// Numbers out.
        output: usize,
    },
}

/// A layer of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layer {
    /// Its name, unique in the network.
    pub name: String,
    /// Its type and sizes.
    pub kind: LayerKind,
    /// Its weights, offsets last.
    pub weights: Range<usize>,
}

/// The layers of a network in the order of their weights.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WeightLayout {
    layers: Vec<Layer>,
}

impl WeightLayout {
    /// No layers.
    pub fn new() -> WeightLayout {
        WeightLayout::default()
    }

    /// All layers.
    pub fn layers(&self) -> &[Layer] {
        &self.layers
    }

    /// Number of weights.
    pub fn len(&self) -> usize {
        self.layers.last().map_or(0, |l| l.weights.end)
    }

    /// Whether there is no weight.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Adds a layer after the others.
    pub(crate) fn push(&mut self, name: &str, kind: LayerKind) -> Range<usize> {
        let size = match kind {
            LayerKind::Conv { input, output, kernel, .. } => output * input * kernel * kernel + output,
            LayerKind::Up { input, output } => 4 * output * input + output,
            LayerKind::Norm { channels, .. } => 2 * channels,
            LayerKind::Dense { input, output } => input * output + output,
        };
        let weights = self.len()..self.len() + size;
        self.layers.push(Layer { name: name.to_owned(), kind, weights: weights.clone() });
        weights
    }

    /// Initial weights: He initialisation (the deviation keeps the variance through a layer with a ReLU), offsets 0, norms
    /// with factor 1. `normal` samples the standard normal distribution.
    pub fn initial_weights(&self, mut normal: impl FnMut() -> f32) -> Vec<f32> {
        let mut out = Vec::with_capacity(self.len());
        for layer in &self.layers {
            let (fan, offsets) = match layer.kind {
                LayerKind::Conv { input, output, kernel, .. } => (input * kernel * kernel, output),
                LayerKind::Up { input, output } | LayerKind::Dense { input, output } => (input, output),
                LayerKind::Norm { channels, .. } => {
                    out.extend((0..2 * channels).map(|i| if i < channels { 1.0 } else { 0.0 }));
                    continue;
                }
            };
            let deviation = (2.0 / fan as f32).sqrt();
            out.extend((0..layer.weights.len() - offsets).map(|_| deviation * normal()));
            out.extend((0..offsets).map(|_| 0.0));
        }
        out
    }
}
