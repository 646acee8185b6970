//! The appearance model `embed`: an embedding per photo and per splat, so that light affects each splat differently.

use super::affine::{IDENTITY, NUMBERS};
use super::model::{Appearance, AppearanceEmbedding, Directions};
use crate::adam::Adam;
use rayon::prelude::*;
use segwild_scene::Random;
use std::ops::Range;
use wincode::{SchemaRead, SchemaWrite};

/// Numbers per colour channel in a photo's appearance embedding and in a splat's.
pub const RANK: usize = 8;
/// Length of a splat's appearance embedding.
pub(super) const EMBEDDING_SIZE: usize = 3 * RANK;
/// Parameters per photo: matrix and vector.
pub(super) const PHOTO: usize = NUMBERS + EMBEDDING_SIZE;
/// Parameters of a photo: its matrix with offset, row by row, and its vector, `[channel][rank]`.
pub type EmbedLight = [f32; PHOTO];
/// Splats that one task works on; sums over splats are taken in pieces of this size, whatever the number of threads.
const PIECE: usize = 4096;

/// Per photo a 3x4 colour matrix `M` and a vector `e`; per splat an embedding `v`. Channel `c` of splat `i` in photo
/// `p` is `(M_p (colour_i, 1))_c + sum over k of e_pck v_ick`.
///
/// The light that a surface reflects is linear in the light that falls on it, so the effect of many skies on one splat
/// is a sum of few terms. The method has a small network instead of the sum. The sum needs no network library and a
/// tenth of the time, and a held-out photo's vector can be fitted in closed form.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct EmbedAppearance {
    /// Learning rate of matrices.
    pub rate: f32,
    /// Learning rate of vectors.
    pub vector_rate: f32,
    /// Pull of matrices towards the identity, as in [`super::AffineAppearance`].
    pub pull: f32,
    photos: Vec<[f32; PHOTO]>,
    matrix_optimisers: Vec<Adam>,
    vector_optimisers: Vec<Adam>,
    /// Gradients since the last step, of the views that took part.
    grads: Vec<(usize, [f32; PHOTO])>,
}

/// Standard deviation of the initial vectors: splat embeddings start at 0, so the photos must differ.
const SPREAD: f32 = 0.3;
/// Learning rate of a photo's vector as a multiple of its matrix's. A photo is visited a few dozen times in a training,
/// and its vector must converge in that time: if vectors are slow, splat embeddings hide errors of shape instead.
const PACE: f32 = 80.0;

impl EmbedAppearance {
    /// Numbers that a splat keeps.
    pub const EMBEDDING_SIZE: usize = EMBEDDING_SIZE;

    /// Identities for `views` photos, with vectors sampled by `seed`.
    pub fn new(views: usize, seed: u64) -> EmbedAppearance {
        let photo = |view: usize| {
            let mut photo = [0.0; PHOTO];
            photo[..NUMBERS].copy_from_slice(&IDENTITY);
            let mut random = Random::stream(seed, view as u64);
            for k in 0..RANK {
                // Initially the same on all channels.
                let value = SPREAD * random.normal();
                (0..3).for_each(|c| photo[NUMBERS + c * RANK + k] = value);
            }
            photo
        };
        let rate = 2e-3;
        EmbedAppearance {
            rate,
            vector_rate: PACE * rate,
            pull: 1e-3,
            photos: (0..views).map(photo).collect(),
            matrix_optimisers: vec![Adam::new(1, NUMBERS); views],
            vector_optimisers: vec![Adam::new(1, EMBEDDING_SIZE); views],
            grads: Vec::new(),
        }
    }

    /// Sets the learning rate of matrices, and that of vectors with it.
    pub fn set_rate(&mut self, rate: f32) {
        (self.rate, self.vector_rate) = (rate, PACE * rate);
    }

    /// Whether its parts fit each other and `views` photos.
    pub fn consistent(&self, views: usize) -> bool {
        let fit = |moments: &[Adam], size: usize| {
            moments.len() == views && moments.iter().all(|moments| moments.len() == size)
        };
        self.photos.len() == views
            && fit(&self.matrix_optimisers, NUMBERS)
            && fit(&self.vector_optimisers, EMBEDDING_SIZE)
            && self.grads.iter().all(|(view, _)| *view < views)
    }

    /// All parameters of a photo; matrix identity and vector 0 for one that is not known.
    pub fn photo(&self, view: usize) -> EmbedLight {
        self.photos.get(view).copied().unwrap_or_else(|| {
            let mut neutral = [0.0; PHOTO];
            neutral[..NUMBERS].copy_from_slice(&IDENTITY);
            neutral
        })
    }

    /// A photo's matrix, row by row; the identity for a photo that is not known.
    pub fn matrix(&self, view: usize) -> [f32; NUMBERS] {
        let photo = self.photo(view);
        std::array::from_fn(|i| photo[i])
    }

    /// A photo's vector, `[channel][rank]`; 0 for a photo that is not known.
    pub fn vector(&self, view: usize) -> [f32; EMBEDDING_SIZE] {
        let photo = self.photo(view);
        std::array::from_fn(|i| photo[NUMBERS + i])
    }

    /// Keeps a gradient of [`EmbedAppearance::photo`] for the next step. Ignores photos that are not known.
    pub fn add_gradient(&mut self, view: usize, grad: &EmbedLight) {
        if view < self.photos.len() {
            match self.grads.iter_mut().find(|(v, _)| *v == view) {
                Some((_, kept)) => kept.iter_mut().zip(grad).for_each(|(kept, v)| *kept += v),
                None => self.grads.push((view, *grad)),
            }
        }
    }

    /// The gradient of [`EmbedAppearance::photo`] kept for the next step, if the photo took part since the last.
    pub fn gradient(&self, view: usize) -> Option<EmbedLight> {
        self.grads.iter().find(|(v, _)| *v == view).map(|(_, grad)| *grad)
    }

    /// Sets a photo's matrix and forgets its optimiser's moments. Ignores photos that are not known.
    pub fn set_matrix(&mut self, view: usize, matrix: [f32; NUMBERS]) {
        if let Some(photo) = self.photos.get_mut(view) {
            photo[..NUMBERS].copy_from_slice(&matrix);
            self.matrix_optimisers[view] = Adam::new(1, NUMBERS);
        }
    }

    /// Sets a photo's vector and forgets its optimiser's moments. Ignores photos that are not known.
    pub fn set_vector(&mut self, view: usize, vector: [f32; EMBEDDING_SIZE]) {
        if let Some(photo) = self.photos.get_mut(view) {
            photo[NUMBERS..].copy_from_slice(&vector);
            self.vector_optimisers[view] = Adam::new(1, EMBEDDING_SIZE);
        }
    }
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl Appearance for EmbedAppearance {
    fn name(&self) -> &'static str {
        "embed"
    }

    fn parameters(&self) -> usize {
        self.photos.len() * PHOTO
    }

    fn embedding_size(&self) -> usize {
        EMBEDDING_SIZE
    }

    fn fading(&self) -> Range<usize> {
        0..EMBEDDING_SIZE
    }

    fn tint(&self, view: usize, splat_embeddings: &[f32], colours: Vec<f32>) -> Vec<f32> {
        self.shade(
            &AppearanceEmbedding(self.photo(view).to_vec()),
            splat_embeddings,
            &|_| Some([0.0; 3]),
            colours,
        )
    }

    fn appearance_embedding(&self, view: usize, _: &[[f32; 3]], _: &[f32]) -> AppearanceEmbedding {
        AppearanceEmbedding(self.photo(view).to_vec())
    }

    fn shade(
        &self,
        AppearanceEmbedding(photo): &AppearanceEmbedding,
        splat_embeddings: &[f32],
        _: &Directions,
        mut colours: Vec<f32>,
    ) -> Vec<f32> {
        assert_eq!(
            (splat_embeddings.len(), photo.len()),
            (colours.len() * RANK, PHOTO),
            "splat embeddings, appearance embedding: length"
        );
        let (m, e) = photo.split_at(NUMBERS);
        colours.par_chunks_mut(3 * PIECE).zip(splat_embeddings.par_chunks(EMBEDDING_SIZE * PIECE)).for_each(
            |(colours, splat_embeddings)| {
                for (colour, embedding) in
                    colours.chunks_exact_mut(3).zip(splat_embeddings.chunks_exact(EMBEDDING_SIZE))
                {
                    let [r, g, b] = [colour[0], colour[1], colour[2]];
                    for c in 0..3 {
                        let light = dot(&e[c * RANK..][..RANK], &embedding[c * RANK..][..RANK]);
                        colour[c] = m[4 * c] * r + m[4 * c + 1] * g + m[4 * c + 2] * b + m[4 * c + 3] + light;
                    }
                }
            },
        );
        colours
    }

    fn tint_backward(
        &mut self,
        view: usize,
        splat_embeddings: &[f32],
        colours: &[f32],
        mut grad: Vec<f32>,
    ) -> (Vec<f32>, Vec<f32>) {
        assert_eq!(
            (splat_embeddings.len(), colours.len()),
            (grad.len() * RANK, grad.len()),
            "splat embeddings, colours: length"
        );
        let photo = self.photo(view);
        let (m, e) = photo.split_at(NUMBERS);
        let mut embedding_grads = vec![0.0; splat_embeddings.len()];
        let pieces: Vec<[f32; PHOTO]> = grad
            .par_chunks_mut(3 * PIECE)
            .zip(embedding_grads.par_chunks_mut(EMBEDDING_SIZE * PIECE))
            .zip(splat_embeddings.par_chunks(EMBEDDING_SIZE * PIECE))
            .zip(colours.par_chunks(3 * PIECE))
            .map(|(((grad, embedding_grads), splat_embeddings), colours)| {
                let mut sums = [0.0; PHOTO];
                let splats = grad.chunks_exact_mut(3).zip(embedding_grads.chunks_exact_mut(EMBEDDING_SIZE));
                for (((grad, embedding_grad), embedding), colour) in
                    splats.zip(splat_embeddings.chunks_exact(EMBEDDING_SIZE)).zip(colours.chunks_exact(3))
                {
                    let g = [grad[0], grad[1], grad[2]];
                    if g == [0.0; 3] {
                        continue; // out of sight
                    }
                    for c in 0..3 {
                        for k in 0..3 {
                            sums[4 * c + k] += g[c] * colour[k];
                        }
                        sums[4 * c + 3] += g[c];
                        grad[c] = (0..3).map(|k| m[4 * k + c] * g[k]).sum();
                        for k in c * RANK..(c + 1) * RANK {
                            sums[NUMBERS + k] += g[c] * embedding[k];
                            embedding_grad[k] = g[c] * e[k];
                        }
                    }
                }
                sums
            })
            .collect();
        let mut sum = [0.0; PHOTO];
        pieces.iter().for_each(|piece| sum.iter_mut().zip(piece).for_each(|(sum, v)| *sum += v));
        self.add_gradient(view, &sum);
        (grad, embedding_grads)
    }

    fn step(&mut self, scale: f32) {
        for (view, mut grad) in std::mem::take(&mut self.grads) {
            let photo = &mut self.photos[view];
            for k in 0..NUMBERS {
                grad[k] += self.pull * (photo[k] - IDENTITY[k]);
            }
            let (matrix, vector) = photo.split_at_mut(NUMBERS);
            self.matrix_optimisers[view].step(matrix, &grad[..NUMBERS], self.rate * scale);
            self.vector_optimisers[view].step(vector, &grad[NUMBERS..], self.vector_rate * scale);
        }
    }
}
