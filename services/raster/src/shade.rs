//! Colours of splats towards an eye, from their spherical harmonics: per splat and cheap, so all engines share it.

use crate::{SplatGrads, sh};
use glam::Vec3;
use rayon::prelude::*;
use segwild_scene::Splats;

/// Splats that one task shades.
const CHUNK: usize = 512;

/// What [`crate::Projected::shade`] returns; splats of radius 0 are culled.
pub fn shade(splats: &Splats, eye: Vec3, radii: &[f32]) -> Vec<f32> {
    let mut colours = vec![0.0; splats.len() * 3];
    colours.par_chunks_mut(CHUNK * 3).enumerate().for_each(|(chunk, out)| {
        for (k, out) in out.chunks_exact_mut(3).enumerate() {
            let i = chunk * CHUNK + k;
            if radii[i] > 0.0 {
                let basis = sh::basis(splats.sh_degree, direction(splats, eye, i).0);
                let colour = raw_colour(splats, i, &basis);
                for c in 0..3 {
                    out[c] = if colour[c].is_finite() { colour[c].max(0.0) } else { 0.0 };
                }
            }
        }
    });
    colours
}

/// What [`crate::Projected::shade_backward`] returns, and adds to `grads.means`.
pub fn shade_backward(
    splats: &Splats,
    eye: Vec3,
    radii: &[f32],
    colours: &[f32],
    grads: &mut SplatGrads,
) -> Vec<f32> {
    let (n, stride) = (splats.len(), splats.sh_stride());
    assert_eq!(colours.len(), n * 3, "gradient of the colours");
    assert_eq!(grads.means.len(), n, "gradient of the means");
    let mut out = vec![0.0; n * stride];
    out.par_chunks_mut(CHUNK * stride).zip(grads.means.par_chunks_mut(CHUNK)).enumerate().for_each(
        |(chunk, (out, means))| {
            for (k, (out, mean)) in out.chunks_exact_mut(stride).zip(means).enumerate() {
                let i = chunk * CHUNK + k;
                if radii[i] > 0.0 {
                    one_backward(splats, eye, i, &colours[i * 3..i * 3 + 3], out, mean);
                }
            }
        },
    );
    out
}

/// Direction from the eye to a splat and one over its distance.
fn direction(splats: &Splats, eye: Vec3, i: usize) -> ([f32; 3], f32) {
    let d = splats.mean(i) - eye;
    let inverse = 1.0 / d.length();
    if inverse.is_finite() { ((d * inverse).to_array(), inverse) } else { ([0.0, 0.0, 1.0], 0.0) }
}

/// Colour before it is clamped.
fn raw_colour(splats: &Splats, i: usize, basis: &[f32; 16]) -> [f32; 3] {
    let stride = splats.sh_stride();
    let mut colour = [0.5; 3];
    for (b, sh) in basis.iter().zip(splats.sh[i * stride..(i + 1) * stride].chunks_exact(3)) {
        for c in 0..3 {
            colour[c] += b * sh[c];
        }
    }
    colour
}

#[inline]
fn one_backward(splats: &Splats, eye: Vec3, i: usize, grad: &[f32], out: &mut [f32], mean: &mut [f32; 3]) {
    let degree = splats.sh_degree;
    let (direction, inverse) = direction(splats, eye, i);
    let basis = sh::basis(degree, direction);
    let raw = raw_colour(splats, i, &basis);
    let mut g = [0.0; 3];
    for c in 0..3 {
        g[c] = if raw[c] > 0.0 && raw[c].is_finite() && grad[c].is_finite() { grad[c] } else { 0.0 };
    }
    for (b, out) in basis.iter().zip(out.chunks_exact_mut(3)) {
        for c in 0..3 {
            out[c] = b * g[c];
        }
    }
    if degree == 0 {
        return;
    }
    let stride = splats.sh_stride();
    let mut db = [0.0; 16];
    for (d, sh) in db.iter_mut().zip(splats.sh[i * stride..(i + 1) * stride].chunks_exact(3)) {
        *d = sh[0] * g[0] + sh[1] * g[1] + sh[2] * g[2];
    }
    let d = Vec3::from(sh::basis_backward(degree, direction, &db));
    let unit = Vec3::from(direction);
    let moved = (d - unit * d.dot(unit)) * inverse;
    if moved.is_finite() {
        for k in 0..3 {
            mean[k] += moved[k];
        }
    }
}
