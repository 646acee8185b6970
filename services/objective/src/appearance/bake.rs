//! Bakes an appearance into spherical harmonics: any viewer then renders the splats under that appearance.

use super::{Appearance, AppearanceEmbedding};
use rayon::prelude::*;
use segwild_raster::sh;
use segwild_scene::Splats;

/// Directions in which a splat's colour is evaluated. More than there are coefficients, and evenly spread, so that a
/// colour that is no sum of harmonics is fitted without a preferred side.
const DIRECTIONS: usize = 48;
/// Coefficients per channel at the highest degree.
const MOST: usize = 16;

/// The splats with the colours that they have under `appearance_embedding`; rendered without an appearance model, they
/// show the scene under it.
///
/// The appearance model is evaluated in some directions, and spherical harmonics are fitted to the colours by least
/// squares. For a model that is linear in the colours (`none`, `affine`, `embed`) the fit is exact for every degree: a
/// matrix acts on the harmonics as it acts on the colours. The clamp at black differs, though: training clamps before
/// the appearance, a viewer of the file after it.
///
/// # Panics
/// If `splat_embeddings` does not have `embedding_size` numbers per splat.
pub fn bake(
    appearance: &dyn Appearance,
    appearance_embedding: &AppearanceEmbedding,
    splats: &Splats,
    splat_embeddings: &[f32],
) -> Splats {
    let bases = (splats.sh_degree as usize + 1).pow(2);
    let directions = even_directions();
    let harmonics: Vec<[f32; MOST]> = directions.iter().map(|&d| sh::basis(splats.sh_degree, d)).collect();
    let inverse = pseudo_inverse(&harmonics, bases);
    let mut sums = vec![0.0f64; splats.sh.len()];
    for ((direction, harmonics), weights) in directions.iter().zip(&harmonics).zip(&inverse) {
        let own: Vec<f32> = splats
            .sh
            .par_chunks_exact(3 * bases)
            .flat_map_iter(|sh| {
                let sum = move |c: usize| (0..bases).map(|k| harmonics[k] * sh[3 * k + c]).sum::<f32>();
                (0..3).map(move |c| 0.5 + sum(c))
            })
            .collect();
        let shown = appearance.shade(appearance_embedding, splat_embeddings, &|_| Some(*direction), own);
        sums.par_chunks_exact_mut(3 * bases).zip(shown.par_chunks_exact(3)).for_each(|(sums, shown)| {
            for (k, weight) in weights[..bases].iter().enumerate() {
                for c in 0..3 {
                    sums[3 * k + c] += weight * (f64::from(shown[c]) - 0.5);
                }
            }
        });
    }
    Splats { sh: sums.into_iter().map(|v| v as f32).collect(), ..splats.clone() }
}

/// A Fibonacci lattice on the sphere.
fn even_directions() -> Vec<[f32; 3]> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..DIRECTIONS)
        .map(|i| {
            let z = 1.0 - (2.0 * i as f64 + 1.0) / DIRECTIONS as f64;
            let (sin, cos) = (golden * i as f64).sin_cos();
            let r = (1.0 - z * z).sqrt();
            [(r * cos) as f32, (r * sin) as f32, z as f32]
        })
        .collect()
}

/// Per direction, the weights with which a colour there enters each coefficient: `(HᵀH)⁻¹Hᵀ` by Gauss-Jordan.
fn pseudo_inverse(harmonics: &[[f32; MOST]], bases: usize) -> Vec<[f64; MOST]> {
    let mut normal = vec![vec![0.0f64; 2 * bases]; bases];
    for (i, row) in normal.iter_mut().enumerate() {
        for (j, value) in row[..bases].iter_mut().enumerate() {
            *value = harmonics.iter().map(|h| f64::from(h[i]) * f64::from(h[j])).sum();
        }
        row[bases + i] = 1.0;
    }
    for i in 0..bases {
        let pivot = normal[i][i]; // positive: the lattice tells the harmonics apart
        normal[i].iter_mut().for_each(|v| *v /= pivot);
        let row = normal[i].clone();
        for (j, other) in normal.iter_mut().enumerate().filter(|(j, _)| *j != i) {
            let factor = other[i];
            debug_assert!(factor.is_finite(), "row {j}");
            other.iter_mut().zip(&row).for_each(|(v, r)| *v -= factor * r);
        }
    }
    let weight = |h: &[f32; MOST], k: usize| -> f64 {
        (0..bases).map(|j| normal[k][bases + j] * f64::from(h[j])).sum()
    };
    harmonics.iter().map(|h| std::array::from_fn(|k| if k < bases { weight(h, k) } else { 0.0 })).collect()
}
