//! From maps to colours per splat, forward and backward.
//!
//! Splats are taken in pieces, each by one task; sums over splats are taken piece by piece, in order. The backward pass
//! recomputes the forward pass of a piece, which costs less than storing the activations of all splats.

use super::appearance::{AppearanceMaps, COORDINATE, EMBEDDING_SIZE, GswAppearance, VisibleSplats};
use super::nets::{DYNAMIC, HIDDEN_LAYER, INTRINSIC, LAYER, MAPS, Networks, SAMPLE, VECTOR};
use crate::appearance::model::Directions;
use rayon::prelude::*;
use segwild_nn::{Activations, BilinearSample, Strided, product};

/// Splats that one task works on.
const PIECE: usize = 512;
/// Dropout rate of the dynamic feature in training.
pub const DROPPED: f32 = 0.1;
/// Weight of the penalty on coordinates outside the map, per coordinate.
pub const OFF_MAP: f32 = 1e-3;

/// Activations of a piece of splats up to their vectors.
struct PieceRun {
    light: Activations,
    fuse: Activations,
    /// Where each splat samples the maps, if there are any.
    spots: Vec<[Option<BilinearSample>; MAPS + 1]>,
    /// Dropout factor of each number of the dynamic feature, in training.
    kept: Vec<f32>,
}

fn spots(light: &AppearanceMaps, mean: [f32; 3], embedding: &[f32]) -> [Option<BilinearSample>; MAPS + 1] {
    let (w, h) = (light.width, light.height);
    std::array::from_fn(|k| {
        if k < MAPS {
            let at = [embedding[INTRINSIC + 2 * k], embedding[INTRINSIC + 2 * k + 1]];
            return Some(BilinearSample::new(w, h, at.map(|v| v * COORDINATE)));
        }
        // From shares of the sides to the coordinates of pixels' centres.
        let centre = |share: f32, n: usize| match n {
            1 => 0.0,
            _ => 2.0 * (share * n as f32 - 0.5) / (n - 1) as f32 - 1.0,
        };
        light
            .image_conditioning
            .pixel_of(mean)
            .map(|[u, v]| BilinearSample::new(w, h, [centre(u, w), centre(v, h)]))
    })
}

/// Samples the dynamic feature of a splat.
fn read(light: &AppearanceMaps, spots: &[Option<BilinearSample>; MAPS + 1], out: &mut [f32]) {
    for ((spot, map), out) in spots.iter().zip(&light.maps).zip(out.chunks_exact_mut(SAMPLE)) {
        if let Some(spot) = spot {
            spot.read(map, out);
        }
    }
}

/// Whether dropout removes a number of a splat's dynamic feature in a step with the random number `draw`. 32-bit words
/// only, which every device has.
fn is_dropped(draw: u64, splat: usize, number: usize) -> bool {
    let mix = |x: u32| {
        let x = (x ^ (x >> 16)).wrapping_mul(0x7feb_352d);
        let x = (x ^ (x >> 15)).wrapping_mul(0x846c_a68b);
        x ^ (x >> 16)
    };
    let word = mix(mix(mix(draw as u32) ^ splat as u32) ^ number as u32);
    ((word >> 8) as f32) * (1.0 / (1 << 24) as f32) < DROPPED
}

/// Sines and cosines of the position at rising frequencies, each from the one below by the double angle.
fn encode(mean: [f32; 3], octaves: usize, out: &mut [f32]) {
    out[..3].copy_from_slice(&mean);
    for k in 0..3 {
        let (mut s, mut c) = mean[k].sin_cos();
        for o in 0..octaves {
            out[3 + 6 * o + 2 * k] = s;
            out[4 + 6 * o + 2 * k] = c;
            (s, c) = (2.0 * s * c, 1.0 - 2.0 * s * s);
        }
    }
}

/// Runs the splats `which` up to their vectors, for a weighted sum of photos.
fn run(
    appearance: &GswAppearance,
    nets: &Networks,
    lights: &[(&AppearanceMaps, f32)],
    (means, splat_embeddings): (&[[f32; 3]], &[f32]),
    which: &[usize],
) -> PieceRun {
    let width = nets.light.ends().0;
    let mut x = vec![0.0; which.len() * width];
    let draw = lights.first().and_then(|(light, _)| light.training.as_ref()).map(|(draw, _)| *draw);
    let mut kept = Vec::new();
    let mut all_spots = Vec::new();
    let mut read_here = [0.0; DYNAMIC];
    for (x, &i) in x.chunks_exact_mut(width).zip(which) {
        let (mean, embedding) = (means[i], &splat_embeddings[i * EMBEDDING_SIZE..(i + 1) * EMBEDDING_SIZE]);
        for (light, weight) in lights {
            let spots = spots(light, mean, embedding);
            read_here.fill(0.0);
            read(light, &spots, &mut read_here);
            x[..DYNAMIC].iter_mut().zip(&read_here).for_each(|(x, v)| *x += weight * v);
            if draw.is_some() {
                all_spots.push(spots);
            }
        }
        if let Some(draw) = draw {
            for (number, x) in x[..DYNAMIC].iter_mut().enumerate() {
                let keep = if is_dropped(draw, i, number) { 0.0 } else { 1.0 / (1.0 - DROPPED) };
                *x *= keep;
                kept.push(keep);
            }
        }
        x[DYNAMIC..DYNAMIC + INTRINSIC].copy_from_slice(&embedding[..INTRINSIC]);
        encode(mean, nets.octaves, &mut x[DYNAMIC + INTRINSIC..]);
    }
    let light = nets.light.forward(&appearance.weights, x);
    let made = nets.light.ends().1;
    let mut x = Vec::with_capacity(which.len() * (made + INTRINSIC));
    for (made, &i) in light.result().chunks_exact(made).zip(which) {
        x.extend_from_slice(made);
        x.extend_from_slice(&splat_embeddings[i * EMBEDDING_SIZE..][..INTRINSIC]);
    }
    let fuse = nets.fuse.forward(&appearance.weights, x);
    PieceRun { light, fuse, spots: all_spots, kept }
}

/// The colour head: from vectors to colours; `direction` is that of the piece's splats.
fn head(
    appearance: &GswAppearance,
    nets: &Networks,
    vectors: &[f32],
    direction: impl Fn(usize) -> [f32; 3],
) -> Activations {
    let mut x = Vec::with_capacity(vectors.len() / VECTOR * (VECTOR + 3));
    for (k, vector) in vectors.chunks_exact(VECTOR).enumerate() {
        x.extend_from_slice(vector);
        x.extend_from_slice(&direction(k));
    }
    nets.colour.forward(&appearance.weights, x)
}

/// The unit vector from the camera to a splat.
fn direction(sight: &VisibleSplats, i: usize) -> [f32; 3] {
    let to: [f32; 3] = std::array::from_fn(|k| sight.means[i][k] - sight.eye[k]);
    let long = to.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    to.map(|v| v / long)
}

fn in_sight(sight: &VisibleSplats) -> Vec<usize> {
    (0..sight.means.len()).filter(|&i| sight.radii[i] > 0.0).collect()
}

pub(super) fn tint(
    appearance: &GswAppearance,
    light: Option<&AppearanceMaps>,
    sight: &VisibleSplats,
    mut colours: Vec<f32>,
) -> Vec<f32> {
    let nets = appearance.nets();
    let which = in_sight(sight);
    let lights: Vec<(&AppearanceMaps, f32)> = light.map(|l| (l, 1.0)).into_iter().collect();
    let made: Vec<Vec<f32>> = which
        .par_chunks(PIECE)
        .map(|which| {
            let run = run(appearance, nets, &lights, (sight.means, sight.splat_embeddings), which);
            let towards = |k: usize| direction(sight, which[k]);
            let made = head(appearance, nets, run.fuse.result(), towards).result().to_vec();
            nets.last.forward(&appearance.layer, made).result().to_vec()
        })
        .collect();
    for (&i, made) in which.iter().zip(made.iter().flat_map(|m| m.chunks_exact(3))) {
        colours[3 * i..3 * i + 3].iter_mut().zip(made).for_each(|(colour, more)| *colour += more);
    }
    colours
}

/// The part of an appearance embedding that is stored per splat, `[splat][HIDDEN_LAYER]`: the contribution of its
/// vector to the colour head's hidden layer, which does not depend on the direction.
pub(super) fn kept(
    appearance: &GswAppearance,
    lights: &[(&AppearanceMaps, f32)],
    means: &[[f32; 3]],
    splat_embeddings: &[f32],
) -> Vec<f32> {
    let nets = appearance.nets();
    let (matrix, offsets) = head_weights(appearance, nets);
    let all: Vec<usize> = (0..means.len()).collect();
    let piece = |which: &[usize]| {
        let run = run(appearance, nets, lights, (means, splat_embeddings), which);
        let mut out = vec![0.0; which.len() * HIDDEN_LAYER];
        out.chunks_exact_mut(HIDDEN_LAYER).for_each(|splat| splat.copy_from_slice(offsets));
        let vectors = Strided::of(run.fuse.result(), VECTOR);
        let sizes = [which.len(), VECTOR, HIDDEN_LAYER];
        product(
            vectors,
            (&matrix[..VECTOR * HIDDEN_LAYER], HIDDEN_LAYER),
            sizes,
            (&mut out, HIDDEN_LAYER),
            true,
        );
        out
    };
    all.par_chunks(PIECE).map(piece).collect::<Vec<_>>().concat()
}

/// Matrix, `[VECTOR + 3][HIDDEN_LAYER]`, and offsets of the colour head.
fn head_weights<'a>(appearance: &'a GswAppearance, nets: &Networks) -> (&'a [f32], &'a [f32]) {
    appearance.weights[nets.colour.range()].split_at((VECTOR + 3) * HIDDEN_LAYER)
}

/// The colour head's hidden layer of a splat, from its stored part and the direction.
#[inline(always)]
fn hidden_layer_of(kept: &[f32], [x, y, z]: [f32; 3], of_direction: &[f32]) -> [f32; HIDDEN_LAYER] {
    let (kept, of_direction) = (&kept[..HIDDEN_LAYER], &of_direction[..3 * HIDDEN_LAYER]);
    let (a, rest) = of_direction.split_at(HIDDEN_LAYER);
    let (b, c) = rest.split_at(HIDDEN_LAYER);
    // A loop and no closure: closures are not compiled with their caller's wider instructions.
    let mut hidden_layer = [0.0; HIDDEN_LAYER];
    for k in 0..HIDDEN_LAYER {
        hidden_layer[k] = (kept[k] + a[k] * x + b[k] * y + c[k] * z).max(0.0);
    }
    hidden_layer
}

/// The colour head's hidden layer, `[splat][HIDDEN_LAYER]`, from the stored part; 0 for splats out of sight.
pub(super) fn hidden_layer(appearance: &GswAppearance, kept: &[f32], direction: &Directions) -> Vec<f32> {
    let of_direction = &head_weights(appearance, appearance.nets()).0[VECTOR * HIDDEN_LAYER..];
    let mut out = vec![0.0; kept.len()];
    out.par_chunks_exact_mut(HIDDEN_LAYER).zip(kept.par_chunks_exact(HIDDEN_LAYER)).enumerate().for_each(
        |(i, (out, kept))| {
            if let Some(direction) = direction(i) {
                out.copy_from_slice(&hidden_layer_of(kept, direction, of_direction));
            }
        },
    );
    out
}

/// Applies the matrix to the colours, then adds the base model's offsets and the output of the colour head with a last
/// `layer`.
pub(super) fn add_light(
    appearance: &GswAppearance,
    kept: &[f32],
    (matrix, own): (&[f32], &[f32]),
    layer: &[f32],
    direction: &Directions,
    colours: &mut [f32],
) {
    let of_direction = &head_weights(appearance, appearance.nets()).0[VECTOR * HIDDEN_LAYER..];
    // Channel by channel, so that the sums run over neighbours.
    let rows: [[f32; HIDDEN_LAYER]; 3] = std::array::from_fn(|c| std::array::from_fn(|k| layer[3 * k + c]));
    let head = ColourHead { of_direction, rows, offsets: &layer[3 * HIDDEN_LAYER..], matrix };
    let pieces = colours.par_chunks_mut(3 * PIECE).zip(own.par_chunks(3 * PIECE));
    pieces.zip(kept.par_chunks(HIDDEN_LAYER * PIECE)).enumerate().for_each(|(p, ((colours, own), kept))| {
        let splats =
            colours.chunks_exact_mut(3).zip(own.chunks_exact(3)).zip(kept.chunks_exact(HIDDEN_LAYER));
        for (k, ((colour, own), kept)) in splats.enumerate() {
            if let Some(direction) = direction(p * PIECE + k) {
                head.add(kept, direction, own, colour);
            }
        }
    });
}

/// The colour head after the stored part, and the base model's effect on colours.
struct ColourHead<'a> {
    of_direction: &'a [f32],
    /// Of the last layer, `[channel][hidden_layer]`, and its offsets.
    rows: [[f32; HIDDEN_LAYER]; 3],
    offsets: &'a [f32],
    matrix: &'a [f32],
}

impl ColourHead<'_> {
    /// A splat's colour. Compiled for wider instructions as well, of which none fuses or reorders anything: the same bytes.
    fn add(&self, kept: &[f32], direction: [f32; 3], own: &[f32], colour: &mut [f32]) {
        #[cfg(target_arch = "x86_64")]
        {
            #[target_feature(enable = "avx512f")]
            fn avx512(head: &ColourHead, kept: &[f32], direction: [f32; 3], own: &[f32], colour: &mut [f32]) {
                head.add_plain(kept, direction, own, colour);
            }
            #[target_feature(enable = "avx2")]
            fn avx2(head: &ColourHead, kept: &[f32], direction: [f32; 3], own: &[f32], colour: &mut [f32]) {
                head.add_plain(kept, direction, own, colour);
            }
            if is_x86_feature_detected!("avx512f") {
                // SAFETY: the instruction set was just found on this machine.
                return unsafe { avx512(self, kept, direction, own, colour) };
            }
            if is_x86_feature_detected!("avx2") {
                // SAFETY: the instruction set was just found on this machine.
                return unsafe { avx2(self, kept, direction, own, colour) };
            }
        }
        self.add_plain(kept, direction, own, colour);
    }

    #[inline(always)]
    fn add_plain(&self, kept: &[f32], direction: [f32; 3], own: &[f32], colour: &mut [f32]) {
        let hidden_layer = hidden_layer_of(kept, direction, self.of_direction);
        let [r, g, b] = [colour[0], colour[1], colour[2]];
        for c in 0..3 {
            // Sixteen strands, which the compiler makes vectors of.
            let mut strands = [0.0f32; 16];
            for (row, hidden_layer) in self.rows[c].chunks_exact(16).zip(hidden_layer.chunks_exact(16)) {
                for l in 0..16 {
                    strands[l] += row[l] * hidden_layer[l];
                }
            }
            let m = &self.matrix[4 * c..4 * c + 3];
            let below = m[0] * r + m[1] * g + m[2] * b + own[c];
            colour[c] = below + strands.iter().sum::<f32>() + self.offsets[c];
        }
    }
}

/// Gradients that [`backward`] returns.
pub(super) struct PointGrads {
    /// Of the splats' embeddings.
    pub splat_embeddings: Vec<f32>,
    /// Of the small networks' weights.
    pub weights: Vec<f32>,
    /// Of the colour head's last layer.
    pub layer: Vec<f32>,
    /// Of the maps, `[pixel][SAMPLE]`.
    pub maps: [Vec<f32>; MAPS + 1],
}

/// Gradients of one piece.
struct Piece {
    splat_embeddings: Vec<f32>,
    weights: Vec<f32>,
    layer: Vec<f32>,
    spots: Vec<[Option<BilinearSample>; MAPS + 1]>,
    light: Vec<f32>,
}

pub(super) fn backward(
    appearance: &GswAppearance,
    light: Option<&AppearanceMaps>,
    sight: &VisibleSplats,
    grad: &[f32],
) -> PointGrads {
    let nets = appearance.nets();
    // Splats without a gradient do not enter the sums.
    let which: Vec<usize> =
        in_sight(sight).into_iter().filter(|&i| grad[3 * i..3 * i + 3] != [0.0; 3]).collect();
    let lights: Vec<(&AppearanceMaps, f32)> = light.map(|l| (l, 1.0)).into_iter().collect();
    let [a, b, c] = [&nets.light, &nets.fuse, &nets.colour].map(|net| net.turned(&appearance.weights));
    let turned = [a, b, c, nets.last.turned(&appearance.layer)];
    let pieces: Vec<Piece> = which
        .par_chunks(PIECE)
        .map(|which| {
            let run = run(appearance, nets, &lights, (sight.means, sight.splat_embeddings), which);
            let colour = head(appearance, nets, run.fuse.result(), |k| direction(sight, which[k]));
            let last = nets.last.forward(&appearance.layer, colour.result().to_vec());
            piece_backward(nets, &turned, (run, colour, last), (light, sight, which), grad)
        })
        .collect();
    let mut back = PointGrads {
        splat_embeddings: vec![0.0; sight.splat_embeddings.len()],
        weights: vec![0.0; appearance.weights.len() - nets.border],
        layer: vec![0.0; LAYER],
        maps: std::array::from_fn(|k| vec![0.0; light.map_or(0, |l| l.maps[k].len())]),
    };
    for (piece, which) in pieces.iter().zip(which.chunks(PIECE)) {
        back.weights.iter_mut().zip(&piece.weights).for_each(|(sum, v)| *sum += v);
        back.layer.iter_mut().zip(&piece.layer).for_each(|(sum, v)| *sum += v);
        for (k, &i) in which.iter().enumerate() {
            back.splat_embeddings[i * EMBEDDING_SIZE..(i + 1) * EMBEDDING_SIZE]
                .copy_from_slice(&piece.splat_embeddings[k * EMBEDDING_SIZE..(k + 1) * EMBEDDING_SIZE]);
        }
    }
    back.maps.par_iter_mut().enumerate().for_each(|(m, map)| {
        for piece in &pieces {
            for (spots, light) in piece.spots.iter().zip(piece.light.chunks_exact(DYNAMIC)) {
                if let Some(spot) = &spots[m] {
                    spot.add(&light[m * SAMPLE..(m + 1) * SAMPLE], map);
                }
            }
        }
    });
    back
}

fn piece_backward(
    nets: &Networks,
    turned: &[Vec<Vec<f32>>; 4],
    (run, head, last): (PieceRun, Activations, Activations),
    (light, sight, which): (Option<&AppearanceMaps>, &VisibleSplats, &[usize]),
    grad: &[f32],
) -> Piece {
    let mut weights = vec![0.0; nets.layout.len() - nets.border];
    let part = |range: std::ops::Range<usize>| range.start - nets.border..range.end - nets.border;
    let out = which.iter().flat_map(|&i| &grad[3 * i..3 * i + 3]).copied().collect();
    let mut layer = vec![0.0; LAYER];
    let out = nets.last.backward(&turned[3], &last, out, &mut layer, HIDDEN_LAYER);
    let own = part(nets.colour.range());
    let out = nets.colour.backward(&turned[2], &head, out, &mut weights[own], VECTOR);
    let made = nets.light.ends().1;
    let own = part(nets.fuse.range());
    let out = nets.fuse.backward(&turned[1], &run.fuse, out, &mut weights[own], made + INTRINSIC);
    let mut splat_embeddings = vec![0.0; which.len() * EMBEDDING_SIZE];
    let mut to_light = Vec::with_capacity(which.len() * made);
    for (out, embedding) in
        out.chunks_exact(made + INTRINSIC).zip(splat_embeddings.chunks_exact_mut(EMBEDDING_SIZE))
    {
        to_light.extend_from_slice(&out[..made]);
        embedding[..INTRINSIC].copy_from_slice(&out[made..]);
    }
    let own = part(nets.light.range());
    let wanted = DYNAMIC + INTRINSIC;
    let out = nets.light.backward(&turned[0], &run.light, to_light, &mut weights[own], wanted);
    let mut to_maps = Vec::with_capacity(if light.is_some() { which.len() * DYNAMIC } else { 0 });
    for (k, (out, embedding)) in
        out.chunks_exact(wanted).zip(splat_embeddings.chunks_exact_mut(EMBEDDING_SIZE)).enumerate()
    {
        embedding[..INTRINSIC].iter_mut().zip(&out[DYNAMIC..]).for_each(|(sum, v)| *sum += v);
        let Some(light) = light.filter(|_| !run.spots.is_empty()) else { continue };
        let from = to_maps.len();
        to_maps.extend(out[..DYNAMIC].iter().zip(&run.kept[k * DYNAMIC..]).map(|(g, keep)| g * keep));
        let coordinates = &sight.splat_embeddings[which[k] * EMBEDDING_SIZE + INTRINSIC..][..2 * MAPS];
        for m in 0..MAPS {
            let Some(spot) = &run.spots[k][m] else { continue };
            let slope = spot.slope(&to_maps[from + m * SAMPLE..][..SAMPLE], &light.maps[m]);
            for a in 0..2 {
                let at = coordinates[2 * m + a] * COORDINATE;
                let off = if at.abs() > 1.0 { OFF_MAP * at.signum() / sight.means.len() as f32 } else { 0.0 };
                embedding[INTRINSIC + 2 * m + a] = COORDINATE * (slope[a] + off);
            }
        }
    }
    Piece { splat_embeddings, weights, layer, spots: run.spots, light: to_maps }
}
