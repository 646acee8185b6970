//! The convolutions of the two networks, as the package `lpips` cuts them out of torchvision's VGG-16 and AlexNet: forward,
//! and the gradient by the input. Their weights are never trained.

use super::head::head;
use super::pooling::{MaxPool, Winners};
use super::weights::{LpipsError, TensorTable};
use crate::conv::{TapReach, convolve};
use crate::map::Map;
use crate::product::{Strided, product};
use rayon::prelude::*;
use std::ops::Range;
use std::sync::OnceLock;

/// Pixels of a strided convolution whose gradients are spread together.
const STRIP: usize = 256;
/// Numbers whose signs one task keeps; a multiple of 64.
const SIGNS: usize = 1 << 14;

/// A convolution with a ReLU after it, and what comes before it.
#[derive(Clone, Copy, Debug)]
pub(super) struct LayerForm {
    /// Its key in the file, without `.weight` and `.bias`.
    pub key: &'static str,
    pub planes: [usize; 2],
    pub kernel: usize,
    pub stride: usize,
    /// Zeros around the input.
    pub border: usize,
    /// Max pooling before it.
    pub pool: Option<MaxPool>,
    /// Whether its features are compared.
    pub compared: bool,
}

const fn of(key: &'static str, planes: [usize; 2], compared: bool) -> LayerForm {
    LayerForm { key, planes, kernel: 3, stride: 1, border: 1, pool: None, compared }
}

const fn pooled(window: usize, form: LayerForm) -> LayerForm {
    LayerForm { pool: Some(MaxPool { window, stride: 2 }), ..form }
}

/// VGG-16, configuration D of Simonyan and Zisserman (2015), up to `relu5_3`.
pub(super) const VGG: [LayerForm; 13] = [
    of("net.slice1.0", [3, 64], false),
    of("net.slice1.2", [64, 64], true),
    pooled(2, of("net.slice2.5", [64, 128], false)),
    of("net.slice2.7", [128, 128], true),
    pooled(2, of("net.slice3.10", [128, 256], false)),
    of("net.slice3.12", [256, 256], false),
    of("net.slice3.14", [256, 256], true),
    pooled(2, of("net.slice4.17", [256, 512], false)),
    of("net.slice4.19", [512, 512], false),
    of("net.slice4.21", [512, 512], true),
    pooled(2, of("net.slice5.24", [512, 512], false)),
    of("net.slice5.26", [512, 512], false),
    of("net.slice5.28", [512, 512], true),
];

/// AlexNet as of Krizhevsky (2014), up to `relu5`.
pub(super) const ALEX: [LayerForm; 5] = [
    LayerForm { kernel: 11, stride: 4, border: 2, ..of("net.slice1.0", [3, 64], true) },
    LayerForm { kernel: 5, border: 2, ..pooled(3, of("net.slice2.3", [64, 192], true)) },
    pooled(3, of("net.slice3.6", [192, 384], true)),
    of("net.slice4.8", [384, 256], true),
    of("net.slice5.10", [256, 256], true),
];

impl LayerForm {
    /// Edge of its result, for an edge of so many pixels; 0 where nothing is left.
    pub fn size(&self, edge: usize) -> usize {
        let edge = self.pool.map_or(edge, |pool| pool.size(edge));
        match edge + 2 * self.border {
            padded if edge == 0 || padded < self.kernel => 0,
            padded => (padded - self.kernel) / self.stride + 1,
        }
    }

    /// How many input pixels lie along one step of its result.
    pub fn step(&self) -> usize {
        self.stride * self.pool.map_or(1, |pool| pool.stride)
    }
}

/// A convolution with its weights.
pub(super) struct FixedLayer {
    pub form: LayerForm,
    /// `[output][input][row][column]`.
    weights: Vec<f32>,
    offsets: Vec<f32>,
    /// `[input][output]`, kernels turned by half a turn: the weights of the gradient. Made when it is first wanted.
    turned: OnceLock<Vec<f32>>,
    /// Weight of each channel in the distance; empty where the features are not compared.
    pub head: Vec<f32>,
}

/// What the gradient of a layer needs of its forward pass.
struct LayerTrace {
    /// Height and width before the pooling, and after it.
    sizes: [(usize, usize); 2],
    winners: Winners,
    /// A bit per number of the result: whether the ReLU let it pass.
    passed: Vec<u64>,
    /// Gradient of the distance in this layer.
    head: Option<Map>,
}

/// The part of an image whose distance is computed, inside a larger crop that its features depend on.
pub(super) struct ComparedPart {
    /// Rows and columns of the crop in the image.
    pub crop: [Range<usize>; 2],
    /// Those of the part, inside the crop.
    pub inner: [Range<usize>; 2],
    /// Height and width of the image.
    pub image: [usize; 2],
}

impl FixedLayer {
    pub fn read(form: LayerForm, table: &TensorTable, head: Vec<f32>) -> Result<FixedLayer, LpipsError> {
        let ([input, output], k) = (form.planes, form.kernel);
        Ok(FixedLayer {
            form,
            weights: table.numbers(&format!("{}.weight", form.key), &[output, input, k, k])?,
            offsets: table.numbers(&format!("{}.bias", form.key), &[output])?,
            turned: OnceLock::new(),
            head,
        })
    }

    /// The result before the ReLU, of an input after the pooling.
    fn forward(&self, x: &Map) -> Map {
        let LayerForm { planes, kernel, stride, border, .. } = self.form;
        let size = |edge: usize| LayerForm { pool: None, ..self.form }.size(edge);
        let taps = (planes[1], kernel, border, TapReach::Stride(stride));
        convolve(x, (&self.weights, Some(&self.offsets)), taps, (size(x.height), size(x.width)))
    }

    /// Gradient of the input after the pooling, of this height and width.
    fn backward(&self, grad: &Map, (height, width): (usize, usize)) -> Map {
        let LayerForm { planes: [input, output], kernel, stride, border, .. } = self.form;
        if stride > 1 {
            return self.spread(grad, (height, width));
        }
        let turned = self.turned.get_or_init(|| {
            let taps = kernel * kernel;
            let mut turned = vec![0.0; self.weights.len()];
            turned.par_chunks_exact_mut(output * taps).enumerate().for_each(|(i, turned)| {
                for (o, turned) in turned.chunks_exact_mut(taps).enumerate() {
                    let own = &self.weights[(o * input + i) * taps..][..taps];
                    turned.iter_mut().zip(own.iter().rev()).for_each(|(to, v)| *to = *v);
                }
            });
            turned
        });
        let taps = (input, kernel, kernel - 1 - border, TapReach::Stride(1));
        convolve(grad, (turned, None), taps, (height, width))
    }

    /// The same where the stride is more than 1: what each result's gradient adds to the inputs under its kernel.
    fn spread(&self, grad: &Map, (height, width): (usize, usize)) -> Map {
        let LayerForm { planes: [input, output], kernel, stride, border, .. } = self.form;
        let (n, taps) = (grad.pixels(), kernel * kernel);
        let mut before = Map::zeros(input, height, width);
        before.data.par_chunks_exact_mut((height * width).max(1)).enumerate().for_each(|(i, plane)| {
            let mut unfolded = vec![0.0; taps * STRIP];
            for from in (0..n).step_by(STRIP) {
                let long = STRIP.min(n - from);
                let left = Strided { data: &self.weights[i * taps..], rows: 1, columns: input * taps };
                let sizes = [taps, output, long];
                product(left, (&grad.data[from..], n), sizes, (&mut unfolded, STRIP), false);
                for (t, row) in unfolded.chunks_exact(STRIP).enumerate() {
                    for (k, v) in row[..long].iter().enumerate() {
                        let (y, x) = ((from + k) / grad.width, (from + k) % grad.width);
                        let (y, x) = (y * stride + t / kernel, x * stride + t % kernel);
                        if (border..border + height).contains(&y) && (border..border + width).contains(&x) {
                            plane[(y - border) * width + x - border] += v;
                        }
                    }
                }
            }
        });
        before
    }
}

/// Sets numbers below 0 to 0 and leaves NaN as it is.
fn relu(map: &mut Map) {
    let piece = |piece: &mut [f32]| piece.iter_mut().for_each(|v| *v = if *v < 0.0 { 0.0 } else { *v });
    map.data.par_chunks_mut(SIGNS).for_each(piece);
}

/// A bit per number: whether it is above 0.
fn passed(map: &Map) -> Vec<u64> {
    let mut bits = vec![0u64; map.data.len().div_ceil(64)];
    bits.par_chunks_mut(SIGNS / 64).zip(map.data.par_chunks(SIGNS)).for_each(|(bits, numbers)| {
        for (bits, numbers) in bits.iter_mut().zip(numbers.chunks(64)) {
            *bits = numbers.iter().enumerate().map(|(k, v)| u64::from(*v > 0.0) << k).sum();
        }
    });
    bits
}

/// Sets the gradients of numbers that the ReLU stopped to 0.
fn stop(grad: &mut Map, passed: &[u64]) {
    grad.data.par_chunks_mut(SIGNS).zip(passed.par_chunks(SIGNS / 64)).for_each(|(grad, bits)| {
        for (k, g) in grad.iter_mut().enumerate() {
            if bits[k / 64] >> (k % 64) & 1 == 0 {
                *g = 0.0;
            }
        }
    });
}

/// The distance in a part of an image, and its gradient by the network's input where that is wanted. Input is the crop.
///
/// A layer's distance is the mean over the pixels of its features, so the parts of an image add up.
pub(super) fn compare(
    layers: &[FixedLayer],
    [mut render, mut target]: [Map; 2],
    part: &ComparedPart,
    wanted: bool,
) -> (f64, Option<Map>) {
    let (mut sizes, mut step, mut distance) = (part.image, 1, 0.0);
    let mut traces = Vec::new();
    for layer in layers {
        let before = (render.height, render.width);
        let mut winners = Winners::new();
        if let Some(pool) = layer.form.pool {
            (render, winners) = pool.forward(&render);
            target = pool.forward(&target).0;
        }
        let after = (render.height, render.width);
        render = layer.forward(&render);
        relu(&mut render);
        target = layer.forward(&target);
        relu(&mut target);
        sizes = sizes.map(|edge| layer.form.size(edge));
        step *= layer.form.step();
        let mut grad = None;
        if layer.form.compared {
            let inside = [0, 1].map(|axis| {
                let most = [render.height, render.width][axis];
                // The last part of an image goes on to the end of the features.
                let last = part.crop[axis].start + part.inner[axis].end == part.image[axis];
                let to = if last { most } else { (part.inner[axis].end / step).min(most) };
                (part.inner[axis].start / step).min(to)..to
            });
            let mean = 1.0 / (sizes[0] * sizes[1]) as f64;
            let (sum, by_render) =
                head([&render, &target], &layer.head, inside, wanted.then_some(mean as f32));
            distance += sum * mean;
            grad = by_render;
        }
        if wanted {
            let passed = passed(&render);
            traces.push(LayerTrace { sizes: [before, after], winners, passed, head: grad });
        }
    }
    if !wanted {
        return (distance, None);
    }
    let mut grad = None;
    for (layer, trace) in layers.iter().zip(traces).rev() {
        // The last layer is compared: there is a gradient from the first turn on.
        let mut sum = trace.head.unwrap_or_else(|| Map::zeros(0, 0, 0));
        if let Some(later) = grad.take() {
            sum = if sum.data.is_empty() { later } else { sum_of(sum, &later) };
        }
        stop(&mut sum, &trace.passed);
        let [before, after] = trace.sizes;
        let sum = layer.backward(&sum, after);
        grad = Some(match layer.form.pool {
            Some(pool) => pool.backward(&sum, &trace.winners, before),
            None => sum,
        });
    }
    (distance, grad)
}

fn sum_of(mut a: Map, b: &Map) -> Map {
    a.add(b);
    a
}
