//! LPIPS, the learned perceptual image patch similarity (Zhang et al. 2018), version 0.1: how different two images seem to
//! people, by the features of a network that was trained to classify photos.
//!
//! It computes what the Python package `lpips` computes with `normalize=True`, and the gradient by one of the images. Its
//! weights are a file that the user has: this project ships none.

mod backbone;
mod head;
mod pooling;
#[cfg(test)]
mod tests;
mod untrained;
mod weights;

pub use weights::LpipsError;

use crate::map::Map;
use backbone::{ALEX, ComparedPart, FixedLayer, LayerForm, VGG, compare};
use rayon::prelude::*;
use std::fmt;
use std::ops::Range;
use weights::TensorTable;

/// Pixels of an image that is compared in one piece.
const ONE_PIECE: usize = 640 * 512;
/// Edge of the parts of larger images. A multiple of every stride.
const PART: usize = 384;
/// Pixels around a part that its features depend on: 91 to 105 in VGG-16, up to 96 in AlexNet. A multiple of every stride.
const AROUND: usize = 112;
/// Bytes per pixel of a piece: of the comparison alone, and with the gradient (`lpips_cost`, an example of this crate).
const PER_PIXEL: [usize; 2] = [1_400, 1_800];

/// The network whose features are compared. Distances of one do not compare with those of the other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LpipsNet {
    /// VGG-16: the usual one for a loss.
    Vgg,
    /// AlexNet: the usual one for scores, and some twenty times as fast.
    Alex,
}

impl LpipsNet {
    /// The name that the package `lpips` has for it.
    pub fn name(self) -> &'static str {
        match self {
            LpipsNet::Vgg => "vgg",
            LpipsNet::Alex => "alex",
        }
    }

    fn layers(self) -> &'static [LayerForm] {
        match self {
            LpipsNet::Vgg => &VGG,
            LpipsNet::Alex => &ALEX,
        }
    }

    /// Whether an image of this height and width leaves features in the last layer: 16 pixels either way for VGG-16, 31 for
    /// AlexNet.
    pub fn fits(self, height: usize, width: usize) -> bool {
        let left = |edge: usize| self.layers().iter().fold(edge, |edge, form| form.size(edge));
        left(height) > 0 && left(width) > 0
    }

    /// Bytes that a comparison takes beside the two images, or one with the gradient, and the weights with it.
    pub fn bytes(self, pixels: usize, gradient: bool) -> usize {
        let numbers = |form: &LayerForm| form.planes[0] * form.planes[1] * form.kernel * form.kernel;
        let weights: usize = self.layers().iter().map(numbers).sum();
        let piece = pixels.min(ONE_PIECE.max((PART + 2 * AROUND).pow(2)));
        4 * weights * (1 + usize::from(gradient)) + piece * PER_PIXEL[usize::from(gradient)]
    }
}

impl fmt::Display for LpipsNet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// The distance with its weights.
pub struct Lpips {
    net: LpipsNet,
    /// What the network's input is shifted by, per channel, and then divided by.
    shift: Vec<f32>,
    scale: Vec<f32>,
    layers: Vec<FixedLayer>,
}

impl fmt::Debug for Lpips {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Lpips").field("net", &self.net).finish_non_exhaustive()
    }
}

impl Lpips {
    /// The weights as a file of them has them: the state_dict of `lpips.LPIPS(net="vgg")` or `(net="alex")` of the Python
    /// package `lpips`, as `.safetensors`. Which of the two it is, its tensors say.
    ///
    /// # Errors
    /// When it is no such file, or a tensor is missing, has another shape or holds a number that is none. The words name the
    /// tensor.
    pub fn parse(bytes: &[u8]) -> Result<Lpips, LpipsError> {
        let table = TensorTable::of(bytes)?;
        let last = |net: LpipsNet| net.layers().last().map_or("", |form| form.key);
        let is = |net: &LpipsNet| table.has(&format!("{}.weight", last(*net)));
        let net = [LpipsNet::Vgg, LpipsNet::Alex].into_iter().find(is).ok_or(LpipsError::Net)?;
        let shift = table.numbers("scaling_layer.shift", &[1, 3, 1, 1])?;
        let positive = |v: f32| v >= 1e-3;
        let scale =
            table.numbers_that("scaling_layer.scale", &[1, 3, 1, 1], positive, "it must be .001 or more")?;
        let mut heads = Vec::new();
        for (k, form) in net.layers().iter().filter(|form| form.compared).enumerate() {
            let (mut key, shape) = (format!("lin{k}.model.1.weight"), [1, form.planes[1], 1, 1]);
            // The package has two names for the same numbers, and what saves them may keep either.
            let other = format!("lins.{k}.model.1.weight");
            if !table.has(&key) && table.has(&other) {
                key = other;
            }
            heads.push(table.numbers_that(&key, &shape, |v| v >= 0.0, "a distance has no negative part")?);
        }
        let mut heads = heads.into_iter();
        let mut layers = Vec::new();
        for &form in net.layers() {
            let head = if form.compared { heads.next().unwrap_or_default() } else { Vec::new() };
            layers.push(FixedLayer::read(form, &table, head)?);
        }
        Ok(Lpips { net, shift, scale, layers })
    }

    /// The network.
    pub fn net(&self) -> LpipsNet {
        self.net
    }

    /// The distance of two images: 0 for equal ones, about 1 for very different ones; NaN where a number of them is. Images
    /// are three planes, sRGB in [0, 1]. `None` where they are too small ([`LpipsNet::fits`]).
    ///
    /// # Panics
    /// If an image has not three planes, or the sizes differ.
    pub fn distance(&self, render: &Map, target: &Map) -> Option<f64> {
        Some(self.in_parts([render, target], false, (ONE_PIECE, PART))?.0)
    }

    /// The same, with the gradient by the first image. A gradient that is not finite is 0.
    ///
    /// # Panics
    /// As [`Lpips::distance`].
    pub fn gradient(&self, render: &Map, target: &Map) -> Option<(f64, Map)> {
        let (distance, grad) = self.in_parts([render, target], true, (ONE_PIECE, PART))?;
        Some((distance, grad?))
    }

    /// Images of more than `one_piece` pixels are compared in parts of this edge, so that memory is bounded: the distance is
    /// the same, since each part's crop holds all that its features depend on.
    fn in_parts(
        &self,
        [render, target]: [&Map; 2],
        wanted: bool,
        (one_piece, edge): (usize, usize),
    ) -> Option<(f64, Option<Map>)> {
        let size = |map: &Map| (map.channels, map.height, map.width, map.data.len());
        let (height, width) = (render.height, render.width);
        assert_eq!(size(render), (3, height, width, 3 * height * width), "render: three planes");
        assert_eq!(size(render), size(target), "render and target: size");
        if !self.net.fits(height, width) {
            return None;
        }
        let edge = if height * width <= one_piece { usize::MAX } else { edge };
        let mut grad = wanted.then(|| Map::zeros(3, height, width));
        let mut distance = 0.0;
        for (rows, rows_inside) in parts(height, edge) {
            for (columns, columns_inside) in parts(width, edge) {
                let crop = [rows.clone(), columns.clone()];
                let inner = [rows_inside.clone(), columns_inside];
                let images = [render, target].map(|map| self.input(map, &crop));
                let part = ComparedPart { crop, inner, image: [height, width] };
                let (part_distance, by_input) = compare(&self.layers, images, &part, wanted);
                distance += part_distance;
                if let (Some(grad), Some(by_input)) = (&mut grad, by_input) {
                    self.add_gradient(&by_input, &part.crop, grad);
                }
            }
        }
        Some((distance, grad))
    }

    /// The network's input: a crop of an image, in the range and with the mean and spread that the network was trained on.
    fn input(&self, image: &Map, [rows, columns]: &[Range<usize>; 2]) -> Map {
        let mut out = Map::zeros(3, rows.len(), columns.len());
        for c in 0..3 {
            let n = out.pixels();
            for (to, y) in out.data[c * n..(c + 1) * n].chunks_exact_mut(columns.len()).zip(rows.clone()) {
                let from = &image.plane(c)[y * image.width..][columns.clone()];
                to.iter_mut()
                    .zip(from)
                    .for_each(|(to, v)| *to = ((2.0 * v - 1.0) - self.shift[c]) / self.scale[c]);
            }
        }
        out
    }

    /// Adds a crop's gradient by the network's input to that by the image.
    fn add_gradient(&self, by_input: &Map, [rows, columns]: &[Range<usize>; 2], grad: &mut Map) {
        let (n, width) = (grad.pixels(), grad.width);
        grad.data.par_chunks_exact_mut(n).enumerate().for_each(|(c, plane)| {
            let factor = 2.0 / self.scale[c];
            for (from, y) in by_input.plane(c).chunks_exact(columns.len()).zip(rows.clone()) {
                for (to, g) in plane[y * width..][columns.clone()].iter_mut().zip(from) {
                    *to += if g.is_finite() { factor * g } else { 0.0 };
                }
            }
        });
    }
}

/// The parts of an edge: the pixels of each with those around it, and the part's own inside of these.
fn parts(length: usize, edge: usize) -> Vec<(Range<usize>, Range<usize>)> {
    let edge = edge.min(length.next_multiple_of(16));
    (0..length)
        .step_by(edge)
        .map(|from| {
            let to = length.min(from + edge);
            let crop = from.saturating_sub(AROUND)..length.min(to + AROUND);
            (crop.clone(), from - crop.start..to - crop.start)
        })
        .collect()
}
