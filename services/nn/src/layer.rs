//! Where the weights of a network lie.

use std::ops::Range;

/// What a layer is; sizes as another engine needs them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Convolution with a square kernel: `[out][in][row][column]`, then `[out]` offsets.
    Conv {
        /// Planes in.
        input: usize,
        /// Planes out.
        output: usize,
        /// Side of the kernel.
        kernel: usize,
        /// Pixels between two places of the kernel.
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
    /// What it is.
    pub kind: Kind,
    /// Its weights, offsets last.
    pub weights: Range<usize>,
}

/// The layers of a network in the order of their weights.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Layout {
    layers: Vec<Layer>,
}

impl Layout {
    /// Nothing yet.
    pub fn new() -> Layout {
        Layout::default()
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

    /// Adds a layer behind the others.
    pub(crate) fn push(&mut self, name: &str, kind: Kind) -> Range<usize> {
        let size = match kind {
            Kind::Conv { input, output, kernel, .. } => output * input * kernel * kernel + output,
            Kind::Up { input, output } => 4 * output * input + output,
            Kind::Norm { channels, .. } => 2 * channels,
            Kind::Dense { input, output } => input * output + output,
        };
        let weights = self.len()..self.len() + size;
        self.layers.push(Layer { name: name.to_owned(), kind, weights: weights.clone() });
        weights
    }

    /// Weights to begin with: deviations that keep the size of what passes a layer followed by a ReLU (He), offsets 0,
    /// norms that do not change anything. `normal` draws from the standard normal distribution.
    pub fn begin(&self, mut normal: impl FnMut() -> f32) -> Vec<f32> {
        let mut out = Vec::with_capacity(self.len());
        for layer in &self.layers {
            let (fan, offsets) = match layer.kind {
                Kind::Conv { input, output, kernel, .. } => (input * kernel * kernel, output),
                Kind::Up { input, output } | Kind::Dense { input, output } => (input, output),
                Kind::Norm { channels, .. } => {
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
