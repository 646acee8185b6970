//! Channels and images as the device lays them out: in blocks of whole vec4, a few of them at once.

use rayon::prelude::*;
use segwild_scene::Image;

/// Items that one task packs.
const CHUNK: usize = 1 << 14;

/// Number of vec4 of so many channels that a view blends at once.
pub(crate) fn at_once(count: usize) -> usize {
    if count <= 4 { 1 } else { 4 }
}

/// Number of vec4 that it gathers at once.
pub(crate) fn gathered_at_once(count: usize) -> usize {
    if count <= 4 { 1 } else { 2 }
}

/// The first channels of the parts that are blended at once.
pub(crate) fn parts_of(count: usize) -> impl Iterator<Item = usize> {
    (0..count).step_by(at_once(count) * 4)
}

/// Channels `first..first + 4 blocks` of every splat; with `one`, a channel of value 1 follows the last.
pub(crate) fn pack_splats(
    values: &[f32],
    n: usize,
    count: usize,
    first: usize,
    blocks: usize,
    one: bool,
) -> Vec<f32> {
    let wide = blocks * 4;
    let mut out = vec![0.0; n * wide];
    let many = count.saturating_sub(first).min(wide);
    out.par_chunks_mut(wide).with_min_len(CHUNK / wide).enumerate().for_each(|(i, out)| {
        out[..many].copy_from_slice(&values[i * count + first..i * count + first + many]);
        if one {
            out[many] = 1.0;
        }
    });
    out
}

/// Planes `first..first + 4 blocks` of an image, pixel by pixel; `alpha` is the plane after the last.
pub(crate) fn pack_image(image: &Image, first: usize, blocks: usize, alpha: Option<&Image>) -> Vec<f32> {
    let (pixels, wide) = (image.width * image.height, blocks * 4);
    let mut planes: Vec<&[f32]> =
        image.data.chunks_exact(pixels).skip(first).take((image.channels - first).min(wide)).collect();
    planes.extend(alpha.map(|alpha| alpha.data.as_slice()));
    let mut out = vec![0.0; pixels * wide];
    out.par_chunks_mut(CHUNK * wide).enumerate().for_each(|(chunk, out)| {
        for (c, plane) in planes.iter().enumerate() {
            for (out, &x) in out[c..].iter_mut().step_by(wide).zip(&plane[chunk * CHUNK..]) {
                *out = x;
            }
        }
    });
    out
}

/// Puts `wide` numbers per pixel into the planes from `first` on, as many as there are.
pub(crate) fn unpack_image(packed: &[f32], wide: usize, first: usize, image: &mut Image) {
    let pixels = image.width * image.height;
    image.data.par_chunks_mut(pixels).skip(first).take(wide).enumerate().for_each(|(c, plane)| {
        for (x, &from) in plane.iter_mut().zip(packed[c..].iter().step_by(wide)) {
            *x = from;
        }
    });
}
