//! Convolutions, as products of weights and unfolded strips of the input.

use crate::layer::{LayerKind, WeightLayout};
use crate::map::Map;
use crate::product::{Strided, product};
use rayon::prelude::*;
use std::ops::Range;

/// Pixels that are unfolded together (im2col): they and their surroundings stay in the cache.
const STRIP: usize = 128;
/// Distance between rows of an unfolded strip. Not a power of two, which would crowd the cache.
const STRIP_WIDTH: usize = 144;
/// Planes of the result per task, where there are few strips; and where there are so many that all cores have work.
const PLANES: usize = 64;
const MORE_PLANES: usize = 256;
const MANY_STRIPS: usize = 64;
/// Taps that are unfolded and multiplied together: they and their weights stay in the cache.
const TAPS: usize = 288;
/// Tasks whose results are held until they are copied into their planes.
const WAVE: usize = 512;
/// Weight gradients are summed over at most so many pieces of the pixels, whatever the number of threads.
const PIECES: usize = 8;

/// A convolution with a square kernel over a border of zeros; the result has `1 / stride` of the size.
#[derive(Clone, Debug)]
pub struct Conv {
    input: usize,
    output: usize,
    kernel: usize,
    stride: usize,
    weights: Range<usize>,
}

/// How the taps of a kernel find their pixel in the unfolded map.
#[derive(Clone, Copy)]
pub(crate) enum TapReach {
    /// At a multiple of the stride.
    Stride(usize),
    /// Fractional stride: pixels of the map lie the stride apart, with zeros in the gaps.
    FractionalStride(usize),
}

/// Unfolds (im2col) the inputs of the kernel in some planes around the pixels `strip` of a result of `width`:
/// `[plane][row][column of the kernel]` rows of [`STRIP_WIDTH`].
fn unfold(
    (x, planes): (&Map, Range<usize>),
    kernel: usize,
    border: usize,
    reach: TapReach,
    width: usize,
    strip: Range<usize>,
    out: &mut [f32],
) {
    let (h, w) = (x.height as isize, x.width as isize);
    for (c, plane) in planes.map(|c| x.plane(c)).enumerate() {
        for i in 0..kernel {
            for j in 0..kernel {
                let row = &mut out[((c * kernel + i) * kernel + j) * STRIP_WIDTH..][..strip.len()];
                // Row by row of the result, as far as the strip goes.
                let mut at = strip.start;
                while at < strip.end {
                    let (y, from) = (at / width, at % width);
                    let to = width.min(from + strip.end - at);
                    let part = &mut row[at - strip.start..][..to - from];
                    let (v, u) = (y + i, j as isize - border as isize);
                    let source = match reach {
                        TapReach::Stride(s) => Some((y * s + i) as isize - border as isize),
                        TapReach::FractionalStride(s) => {
                            let v = v as isize - border as isize;
                            (v >= 0 && v % s as isize == 0).then_some(v / s as isize)
                        }
                    };
                    match source.filter(|v| (0..h).contains(v)) {
                        None => part.fill(0.0),
                        Some(v) => {
                            let line = &plane[(v * w) as usize..][..w as usize];
                            line_of(line, reach, u, from, part);
                        }
                    }
                    at += to - from;
                }
            }
        }
    }
}

/// One row of the unfolded strip, from result column `from` on, with the tap `u` columns to the right.
fn line_of(line: &[f32], reach: TapReach, u: isize, from: usize, part: &mut [f32]) {
    let w = line.len() as isize;
    match reach {
        TapReach::Stride(1) => {
            // A run inside the row, and zeros beyond its ends.
            let start = from as isize + u;
            let before = (-start).clamp(0, part.len() as isize) as usize;
            let inside = (w - start.max(0)).clamp(0, (part.len() - before) as isize) as usize;
            part[..before].fill(0.0);
            if inside > 0 {
                let first = start.max(0) as usize;
                part[before..before + inside].copy_from_slice(&line[first..first + inside]);
            }
            part[before + inside..].fill(0.0);
        }
        TapReach::Stride(s) => {
            for (k, to) in part.iter_mut().enumerate() {
                let x = ((from + k) * s) as isize + u;
                *to = if (0..w).contains(&x) { line[x as usize] } else { 0.0 };
            }
        }
        TapReach::FractionalStride(s) => {
            for (k, to) in part.iter_mut().enumerate() {
                let x = (from + k) as isize + u;
                let hit = x >= 0 && x % s as isize == 0 && x / (s as isize) < w;
                *to = if hit { line[x as usize / s] } else { 0.0 };
            }
        }
    }
}

/// The product of `weights`, `[output][taps]`, with the unfolded input, plus offsets. `reach` and the `border` of zeros
/// above and left of the map say where the taps lie; the result has `height` rows of `width`.
pub(crate) fn convolve(
    x: &Map,
    (weights, offsets): (&[f32], Option<&[f32]>),
    (output, kernel, border, reach): (usize, usize, usize, TapReach),
    (height, width): (usize, usize),
) -> Map {
    let (n, taps) = (height * width, x.channels * kernel * kernel);
    let strips = n.div_ceil(STRIP);
    // Neither changes a number: each is a sum of its own, over all taps in order.
    let most = if strips < MANY_STRIPS { PLANES } else { MORE_PLANES };
    let blocks = output.div_ceil(most);
    let together = (TAPS / (kernel * kernel)).clamp(1, x.channels.max(1));
    let mut out = Map::zeros(output, height, width);
    let tasks = strips * blocks;
    // A wave at a time: what is not yet in its planes takes little memory.
    for wave in (0..tasks).step_by(WAVE) {
        let parts: Vec<Vec<f32>> = (wave..tasks.min(wave + WAVE))
            .into_par_iter()
            .map_init(
                || vec![0.0; together * kernel * kernel * STRIP_WIDTH],
                |unfolded, task| {
                    let (strip, block) = (task / blocks, task % blocks);
                    let strip = strip * STRIP..n.min((strip + 1) * STRIP);
                    let planes = block * most..output.min((block + 1) * most);
                    let mut part = vec![0.0; planes.len() * strip.len()];
                    if let Some(offsets) = offsets {
                        for (row, c) in part.chunks_exact_mut(strip.len()).zip(planes.clone()) {
                            row.fill(offsets[c]);
                        }
                    }
                    let weights = &weights[planes.start * taps..planes.end * taps];
                    for from in (0..x.channels).step_by(together) {
                        let some = from..x.channels.min(from + together);
                        let first = from * kernel * kernel;
                        let sizes = [planes.len(), some.len() * kernel * kernel, strip.len()];
                        unfold((x, some), kernel, border, reach, width, strip.clone(), unfolded);
                        let left = Strided::of(&weights[first..], taps);
                        product(left, (unfolded, STRIP_WIDTH), sizes, (&mut part, strip.len()), true);
                    }
                    part
                },
            )
            .collect();
        for (task, part) in (wave..).zip(&parts) {
            let (strip, block) = (task / blocks, task % blocks);
            let from = strip * STRIP;
            let long = n.min(from + STRIP) - from;
            for (k, row) in part.chunks_exact(long).enumerate() {
                out.data[(block * most + k) * n + from..][..long].copy_from_slice(row);
            }
        }
    }
    out
}

impl Conv {
    /// A convolution of `input` to `output` planes with `kernel` x `kernel` taps.
    pub fn new(
        layout: &mut WeightLayout,
        name: &str,
        [input, output]: [usize; 2],
        kernel: usize,
        stride: usize,
    ) -> Conv {
        let weights = layout.push(name, LayerKind::Conv { input, output, kernel, stride });
        Conv { input, output, kernel, stride, weights }
    }

    /// Its type and sizes.
    pub fn kind(&self) -> LayerKind {
        let Conv { input, output, kernel, stride, .. } = *self;
        LayerKind::Conv { input, output, kernel, stride }
    }

    /// Range of its weights.
    pub fn weights(&self) -> Range<usize> {
        self.weights.clone()
    }

    pub(crate) fn planes(&self) -> [usize; 2] {
        [self.input, self.output]
    }

    pub(crate) fn stride(&self) -> usize {
        self.stride
    }

    fn border(&self) -> usize {
        self.kernel / 2
    }

    fn size(&self, x: &Map) -> (usize, usize) {
        (x.height.div_ceil(self.stride), x.width.div_ceil(self.stride))
    }

    /// Output planes for the input `x`.
    pub fn forward(&self, weights: &[f32], x: &Map) -> Map {
        assert_eq!(x.channels, self.input, "planes");
        let own = &weights[self.weights.clone()];
        let (kernels, offsets) = own.split_at(own.len() - self.output);
        let form = (self.output, self.kernel, self.border(), TapReach::Stride(self.stride));
        convolve(x, (kernels, Some(offsets)), form, self.size(x))
    }

    /// Gradient of the input, where it is `wanted`; adds that of the weights to `sums`.
    pub fn backward(
        &self,
        weights: &[f32],
        x: &Map,
        grad: &Map,
        sums: &mut [f32],
        wanted: bool,
    ) -> Option<Map> {
        assert_eq!((grad.height, grad.width), self.size(x), "size");
        let own = &mut sums[self.weights.clone()];
        let (kernels, offsets) = own.split_at_mut(self.weights.len() - self.output);
        for (c, sum) in offsets.iter_mut().enumerate() {
            *sum += total(grad.plane(c));
        }
        self.kernel_gradient(x, grad, kernels);
        wanted.then(|| {
            // The transposed convolution is a convolution of fractional stride with the kernel turned round.
            let own = &weights[self.weights.clone()];
            let (k, taps) = (self.kernel, self.kernel * self.kernel);
            let mut turned = vec![0.0; self.input * self.output * taps];
            for o in 0..self.output {
                for i in 0..self.input {
                    for t in 0..taps {
                        turned[(i * self.output + o) * taps + taps - 1 - t] =
                            own[(o * self.input + i) * taps + t];
                    }
                }
            }
            let reach =
                if self.stride == 1 { TapReach::Stride(1) } else { TapReach::FractionalStride(self.stride) };
            convolve(
                grad,
                (&turned, None),
                (self.input, k, k - 1 - self.border(), reach),
                (x.height, x.width),
            )
        })
    }

    /// Adds the sum over pixels of gradient times unfolded input.
    fn kernel_gradient(&self, x: &Map, grad: &Map, sums: &mut [f32]) {
        let (n, taps) = (grad.pixels(), self.input * self.kernel * self.kernel);
        let strips = n.div_ceil(STRIP);
        let piece = strips.div_ceil(PIECES);
        let pieces: Vec<Vec<f32>> = (0..strips.div_ceil(piece))
            .into_par_iter()
            .map(|p| {
                let mut unfolded = vec![0.0; taps * STRIP_WIDTH];
                let mut turned = vec![0.0; STRIP * self.output];
                let mut sums = vec![0.0; taps * self.output];
                for strip in p * piece..strips.min((p + 1) * piece) {
                    let strip = strip * STRIP..n.min((strip + 1) * STRIP);
                    let reach = TapReach::Stride(self.stride);
                    unfold(
                        (x, 0..x.channels),
                        self.kernel,
                        self.border(),
                        reach,
                        grad.width,
                        strip.clone(),
                        &mut unfolded,
                    );
                    for c in 0..self.output {
                        for (k, g) in grad.plane(c)[strip.clone()].iter().enumerate() {
                            turned[k * self.output + c] = *g;
                        }
                    }
                    let sizes = [taps, strip.len(), self.output];
                    let left = Strided::of(&unfolded, STRIP_WIDTH);
                    product(left, (&turned, self.output), sizes, (&mut sums, self.output), true);
                }
                sums
            })
            .collect();
        for piece in pieces {
            for (t, row) in piece.chunks_exact(self.output).enumerate() {
                for (c, v) in row.iter().enumerate() {
                    sums[c * taps + t] += v;
                }
            }
        }
    }
}

/// A sum in f64, in order.
pub(crate) fn total(values: &[f32]) -> f32 {
    values.chunks(64).map(|v| f64::from(v.iter().sum::<f32>())).sum::<f64>() as f32
}

/// A transposed convolution, kernel and stride 2: twice the size.
#[derive(Clone, Debug)]
pub struct Up {
    input: usize,
    output: usize,
    weights: Range<usize>,
}

impl Up {
    /// From `input` to `output` planes.
    pub fn new(layout: &mut WeightLayout, name: &str, [input, output]: [usize; 2]) -> Up {
        Up { input, output, weights: layout.push(name, LayerKind::Up { input, output }) }
    }

    /// Its type and sizes.
    pub fn kind(&self) -> LayerKind {
        LayerKind::Up { input: self.input, output: self.output }
    }

    /// Range of its weights.
    pub fn weights(&self) -> Range<usize> {
        self.weights.clone()
    }

    pub(crate) fn planes(&self) -> [usize; 2] {
        [self.input, self.output]
    }

    /// The planes at twice the size.
    pub fn forward(&self, weights: &[f32], x: &Map) -> Map {
        assert_eq!(x.channels, self.input, "planes");
        let own = &weights[self.weights.clone()];
        let (kernels, offsets) = own.split_at(own.len() - self.output);
        // Each of the four new pixels is a product with the old one: four results, then laid side by side.
        let four =
            convolve(x, (kernels, None), (4 * self.output, 1, 0, TapReach::Stride(1)), (x.height, x.width));
        let mut out = Map::zeros(self.output, 2 * x.height, 2 * x.width);
        let n = out.pixels();
        for (c, plane) in out.data.chunks_exact_mut(n).enumerate() {
            for q in 0..4 {
                for (y, row) in four.plane(4 * c + q).chunks_exact(x.width).enumerate() {
                    let start = (2 * y + q / 2) * 2 * x.width + q % 2;
                    for (to, v) in plane[start..].iter_mut().step_by(2).zip(row) {
                        *to = v + offsets[c];
                    }
                }
            }
        }
        out
    }

    /// Gradient of the input; adds that of the weights to `sums`.
    pub fn backward(&self, weights: &[f32], x: &Map, grad: &Map, sums: &mut [f32]) -> Map {
        let mut four = Map::zeros(4 * self.output, x.height, x.width);
        let n = x.pixels();
        for (k, plane) in four.data.chunks_exact_mut(n).enumerate() {
            let (c, q) = (k / 4, k % 4);
            for (y, row) in plane.chunks_exact_mut(x.width).enumerate() {
                let start = (2 * y + q / 2) * 2 * x.width + q % 2;
                for (to, v) in row.iter_mut().zip(grad.plane(c)[start..].iter().step_by(2)) {
                    *to = *v;
                }
            }
        }
        let kernels = self.weights.len() - self.output;
        for c in 0..self.output {
            sums[self.weights.start + kernels + c] += total(grad.plane(c));
        }
        // A 1 x 1 convolution remains.
        let inner = Conv { input: self.input, output: 4 * self.output, kernel: 1, stride: 1, weights: 0..0 };
        inner.kernel_gradient(x, &four, &mut sums[self.weights.clone()][..kernels]);
        let own = &weights[self.weights.clone()][..kernels];
        let mut turned = vec![0.0; kernels];
        for o in 0..4 * self.output {
            for i in 0..self.input {
                turned[i * 4 * self.output + o] = own[o * self.input + i];
            }
        }
        convolve(&four, (&turned, None), (self.input, 1, 0, TapReach::Stride(1)), (x.height, x.width))
    }
}
