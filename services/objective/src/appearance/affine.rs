//! The appearance model `affine`: a colour matrix per photo.

use super::model::{Appearance, AppearanceEmbedding, Directions, through};
use crate::adam::Adam;
use rayon::prelude::*;
use segwild_scene::{Image, TASK_PIXELS, in_pieces};
use wincode::{SchemaRead, SchemaWrite};

/// Numbers in a 3x4 matrix: rows for r, g, b; columns for r, g, b and 1.
pub(super) const NUMBERS: usize = 12;
pub(super) const IDENTITY: [f32; NUMBERS] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// The appearance model `affine`: a 3x4 colour matrix per photo, initially the identity.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct AffineAppearance {
    /// Learning rate.
    pub rate: f32,
    /// Pull towards the identity: the loss gets `pull / 2 |M - I|²` for a photo in each step it takes part in. It also
    /// removes an ambiguity: a colour shift common to all photos goes to the splats.
    pub pull: f32,
    matrices: Vec<[f32; NUMBERS]>,
    optimisers: Vec<Adam>,
    /// Gradients since the last step, of the views that took part.
    grads: Vec<(usize, [f32; NUMBERS])>,
}

impl AffineAppearance {
    /// Identities for `views` photos.
    pub fn new(views: usize) -> AffineAppearance {
        AffineAppearance {
            rate: 2e-3,
            pull: 1e-3,
            matrices: vec![IDENTITY; views],
            optimisers: vec![Adam::new(1, NUMBERS); views],
            grads: Vec::new(),
        }
    }

    /// Whether it holds one matrix per view for `views` views: one read from a file may not.
    pub fn consistent(&self, views: usize) -> bool {
        self.matrices.len() == views && self.optimisers.len() == views
    }

    /// A photo's matrix, row by row; the identity for a photo that is not known.
    pub fn matrix(&self, view: usize) -> [f32; NUMBERS] {
        self.matrices.get(view).copied().unwrap_or(IDENTITY)
    }

    /// Sets a photo's matrix and forgets its optimiser's moments. Ignores photos that are not known.
    pub fn set_matrix(&mut self, view: usize, matrix: [f32; NUMBERS]) {
        if let Some(slot) = self.matrices.get_mut(view) {
            *slot = matrix;
            self.optimisers[view] = Adam::new(1, NUMBERS);
        }
    }

    /// Keeps a gradient of a photo's matrix for the next step. Ignores photos that are not known.
    pub fn add_gradient(&mut self, view: usize, grad: &[f32; NUMBERS]) {
        if view < self.matrices.len() {
            match self.grads.iter_mut().find(|(v, _)| *v == view) {
                Some((_, kept)) => kept.iter_mut().zip(grad).for_each(|(kept, v)| *kept += v),
                None => self.grads.push((view, *grad)),
            }
        }
    }

    /// Sets a photo's matrix to the least-squares fit of `image` to `target` where `weight` is not 0, with a ridge of
    /// `ridge` pixels' worth towards the identity; as the official protocol fits the appearance on half a photo.
    ///
    /// # Panics
    /// If the images differ in size or have not three planes.
    pub fn fit(&mut self, view: usize, image: &Image, target: &Image, weight: Option<&Image>, ridge: f32) {
        assert_eq!((image.channels, target.channels), (3, 3), "planes");
        assert_eq!(image.data.len(), target.data.len(), "sizes");
        let pixels = image.pixels();
        let (mut normal, mut right) = ([[0f64; 4]; 4], [[0f64; 4]; 3]);
        for p in 0..pixels {
            let w = f64::from(weight.map_or(1.0, |weight| weight.data[p]));
            let x: [f64; 4] =
                std::array::from_fn(|c| if c < 3 { f64::from(image.data[c * pixels + p]) } else { 1.0 });
            for a in 0..4 {
                for b in 0..4 {
                    normal[a][b] += w * x[a] * x[b];
                }
                for c in 0..3 {
                    right[c][a] += w * x[a] * f64::from(target.data[c * pixels + p]);
                }
            }
        }
        let ridge = f64::from(ridge).max(1e-6);
        for a in 0..4 {
            normal[a][a] += ridge;
            if a < 3 {
                right[a][a] += ridge;
            }
        }
        let inverse = glam::DMat4::from_cols_array_2d(&normal).inverse();
        let mut matrix = IDENTITY;
        for c in 0..3 {
            let row = inverse * glam::DVec4::from(right[c]);
            for k in 0..4 {
                matrix[c * 4 + k] = row[k] as f32;
            }
        }
        if matrix.iter().all(|v| v.is_finite()) {
            self.set_matrix(view, matrix);
        }
    }
}

/// Runs over the pixels of three planes in parallel pieces.
const PIECE: usize = 1 << 14;

impl Appearance for AffineAppearance {
    fn name(&self) -> &'static str {
        "affine"
    }

    fn parameters(&self) -> usize {
        self.matrices.len() * NUMBERS
    }

    fn apply(&self, view: usize, image: &Image) -> Image {
        apply_matrix(&self.matrix(view), image)
    }

    fn backward(&mut self, view: usize, image: &Image, grad: &Image) -> Image {
        let (out, sums) = matrix_backward(&self.matrix(view), image, grad);
        self.add_gradient(view, &sums);
        out
    }

    fn step(&mut self, scale: f32) {
        for (view, mut grad) in std::mem::take(&mut self.grads) {
            for k in 0..NUMBERS {
                grad[k] += self.pull * (self.matrices[view][k] - IDENTITY[k]);
            }
            self.optimisers[view].step(&mut self.matrices[view], &grad, self.rate * scale);
        }
    }

    fn appearance_embedding(&self, view: usize, _: &[[f32; 3]], _: &[f32]) -> AppearanceEmbedding {
        AppearanceEmbedding(self.matrix(view).to_vec())
    }

    fn shade(
        &self,
        appearance_embedding: &AppearanceEmbedding,
        _: &[f32],
        _: &Directions,
        mut colours: Vec<f32>,
    ) -> Vec<f32> {
        through(&appearance_embedding.0, &mut colours);
        colours
    }
}

/// Colours through a matrix with offset, row by row; three planes.
///
/// # Panics
/// If the image has not three planes.
pub(crate) fn apply_matrix(m: &[f32; NUMBERS], image: &Image) -> Image {
    assert_eq!(image.channels, 3, "planes");
    let pixels = image.pixels();
    let mut out = Image::zeros(image.width, image.height, 3);
    for c in 0..3 {
        let [a, b, d, e] = [m[c * 4], m[c * 4 + 1], m[c * 4 + 2], m[c * 4 + 3]];
        let [r, g, bl] = [image.plane(0), image.plane(1), image.plane(2)];
        in_pieces(&mut out.data[c * pixels..(c + 1) * pixels], |first, piece| {
            for (out, p) in piece.iter_mut().zip(first..) {
                *out = a * r[p] + b * g[p] + d * bl[p] + e;
            }
        });
    }
    out
}

/// From the gradient of [`apply_matrix`]'s result to those of the image and of the matrix.
///
/// # Panics
/// If the images have not three planes, or differ in size.
pub(crate) fn matrix_backward(m: &[f32; NUMBERS], image: &Image, grad: &Image) -> (Image, [f32; NUMBERS]) {
    assert_eq!((image.channels, grad.channels), (3, 3), "planes");
    assert_eq!(image.data.len(), grad.data.len(), "sizes");
    let pixels = image.pixels();
    let mut out = Image::zeros(image.width, image.height, 3);
    let mut sums = [0.0; NUMBERS];
    for k in 0..3 {
        let [a, b, d] = [m[k], m[4 + k], m[8 + k]];
        let [r, g, bl] = [grad.plane(0), grad.plane(1), grad.plane(2)];
        in_pieces(&mut out.data[k * pixels..(k + 1) * pixels], |first, piece| {
            for (out, p) in piece.iter_mut().zip(first..) {
                *out = a * r[p] + b * g[p] + d * bl[p];
            }
        });
        let g = grad.plane(k);
        for c in 0..3 {
            sums[k * 4 + c] = dot(g, image.plane(c));
        }
        let of_pieces = g.par_chunks(PIECE).with_min_len(TASK_PIXELS / PIECE);
        sums[k * 4 + 3] = in_order(of_pieces.map(|g| f64::from(lanes(g, |v| v))));
    }
    (out, sums)
}

/// Sum of `f` in eight strands, which the compiler makes vectors of.
fn lanes(values: &[f32], f: impl Fn(f32) -> f32) -> f32 {
    let (chunks, rest) = values.as_chunks::<8>();
    let mut sums = [0.0; 8];
    for chunk in chunks {
        for k in 0..8 {
            sums[k] += f(chunk[k]);
        }
    }
    sums.iter().sum::<f32>() + rest.iter().map(|&v| f(v)).sum::<f32>()
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let piece = |a: &[f32], b: &[f32]| {
        let ((a8, a_rest), (b8, b_rest)) = (a.as_chunks::<8>(), b.as_chunks::<8>());
        let mut sums = [0.0; 8];
        for (a, b) in a8.iter().zip(b8) {
            for k in 0..8 {
                sums[k] += a[k] * b[k];
            }
        }
        let rest: f32 = a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum();
        f64::from(sums.iter().sum::<f32>() + rest)
    };
    let pieces = a.par_chunks(PIECE).zip(b.par_chunks(PIECE)).with_min_len(TASK_PIXELS / PIECE);
    in_order(pieces.map(|(a, b)| piece(a, b)))
}

/// The sum of the pieces in their order: the same on any number of cores.
fn in_order(pieces: impl IndexedParallelIterator<Item = f64>) -> f32 {
    let pieces: Vec<f64> = pieces.collect();
    pieces.into_iter().sum::<f64>() as f32
}
