//! Appearance of the photos: how each photo's colours differ from the scene's, and fits of it (method, section 3).

use crate::photos::{PhotoLevel, Stored};
use crate::posed::{Posed, colour_pairs};
use crate::{AppearanceModel, TrainSettings};
use segwild_nn::solve;
use segwild_objective::background::Background;
use segwild_objective::{
    AffineAppearance, AnyAppearance, EmbedAppearance, GswAppearance, HIDDEN_LAYER, ImageConditioning,
    NoAppearance, RANK,
};
use segwild_scene::{Camera, Pose};
use std::sync::Arc;

/// A colour matrix with offset, row-major 3 x 4: `c' = M (c, 1)`.
pub(crate) type AffineColour = [f32; 12];

/// The appearance that changes nothing.
pub(crate) const IDENTITY: AffineColour = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// Initial appearances of `views` photos, and one more, at index `views`: the mean appearance, in which the scene is rendered
/// when no photo is named.
pub(crate) fn initial(settings: &TrainSettings, views: usize) -> AnyAppearance {
    match settings.appearance_model {
        // No training runs with `auto`: the settings are checked first.
        AppearanceModel::None | AppearanceModel::Auto => AnyAppearance::None(NoAppearance),
        AppearanceModel::Affine => {
            let mut appearance = AffineAppearance::new(views + 1);
            appearance.rate = settings.lr_appearance;
            AnyAppearance::Affine(appearance)
        }
        AppearanceModel::Embed => {
            let mut appearance = EmbedAppearance::new(views + 1, settings.seed);
            appearance.set_rate(settings.lr_appearance);
            AnyAppearance::Embed(appearance)
        }
        AppearanceModel::Gsw => {
            let mut appearance = GswAppearance::new(views + 1, settings.seed, settings.gsw_width);
            appearance.below.set_rate(settings.lr_appearance);
            appearance.net_rate = settings.lr_net;
            appearance.point_rate = settings.lr_net;
            AnyAppearance::Gsw(Box::new(appearance))
        }
    }
}

/// Initialises a photo's appearance from the colours of its points in the photo.
pub(crate) fn start(appearance: &mut AnyAppearance, view: usize, seen: &Posed, stored: &Stored) {
    let pairs = colour_pairs(seen, stored);
    let fitted = || fit(pairs.iter().map(|(a, b)| (*a, 1.0, *b, 1.0)));
    match appearance {
        AnyAppearance::None(_) => {}
        AnyAppearance::Affine(affine) => affine.set_matrix(view, fitted()),
        AnyAppearance::Embed(embed) => embed.set_matrix(view, fitted()),
        AnyAppearance::Gsw(gsw) => {
            gsw.below.set_matrix(view, fitted());
            let photo = &stored.levels[0];
            gsw.set_image_conditioning(
                view,
                image_conditioning(gsw, photo, &seen.camera, &seen.pose, |_| true),
            );
        }
    }
}

/// The conditioning of the network of `appearance` on a photo, over the pixels that are `open`.
pub(crate) fn image_conditioning(
    appearance: &GswAppearance,
    photo: &PhotoLevel,
    camera: &Camera,
    pose: &Pose,
    open: impl Fn(usize) -> bool,
) -> Arc<ImageConditioning> {
    let colour = |i: usize| (open(i) && photo.valid(i)).then(|| photo.colour(i));
    appearance.image_conditioning((photo.width, photo.height), camera, pose, colour)
}

/// Sets the appearance at index `past`, after the last photo's, to the mean over these photos.
pub(crate) fn set_mean(
    appearance: &mut AnyAppearance,
    past: usize,
    known: impl Iterator<Item = usize> + Clone,
) {
    match appearance {
        AnyAppearance::None(_) => {}
        AnyAppearance::Affine(affine) => {
            let matrices: Vec<_> = known.map(|v| affine.matrix(v)).collect();
            affine.set_matrix(past, mean(&matrices));
        }
        AnyAppearance::Embed(embed) => set_mean_vector(embed, past, known),
        AnyAppearance::Gsw(gsw) => set_mean_vector(&mut gsw.below, past, known),
    }
}

fn set_mean_vector(embed: &mut EmbedAppearance, past: usize, known: impl Iterator<Item = usize> + Clone) {
    let matrices: Vec<_> = known.clone().map(|v| embed.matrix(v)).collect();
    embed.set_matrix(past, mean(&matrices));
    let n = known.clone().count().max(1) as f32;
    let mut vector = embed.vector(past).map(|_| 0.0);
    for view in known {
        vector.iter_mut().zip(embed.vector(view)).for_each(|(sum, v)| *sum += v / n);
    }
    embed.set_vector(past, vector);
}

/// The colour matrix of a view that acts on the blended image, and so on the background as well.
pub(crate) fn matrix(appearance: &AnyAppearance, view: usize) -> AffineColour {
    match appearance {
        // Acts on the splats alone: the background has the photo's colours already.
        AnyAppearance::None(_) | AnyAppearance::Embed(_) | AnyAppearance::Gsw(_) => IDENTITY,
        AnyAppearance::Affine(affine) => affine.matrix(view),
    }
}

/// The colour matrix that maps scene colours (premultiplied, with their alpha) to photo colours, by least squares
/// with a ridge towards the identity; entries are (scene colour, alpha, photo colour, weight). Twice refitted with
/// less weight on what does not fit, so that a transient in the photo does not tint it.
pub(crate) fn fit(pairs: impl Iterator<Item = ([f32; 3], f32, [f32; 3], f32)> + Clone) -> AffineColour {
    let mut appearance = IDENTITY;
    for round in 0..3 {
        let mut ata = [[0.0f64; 4]; 4];
        let mut atb = [[0.0f64; 3]; 4];
        let mut total = 0.0;
        for (colour, alpha, photo, weight) in pairs.clone() {
            let x = [colour[0], colour[1], colour[2], alpha];
            let off = (0..3).map(|r| (dot(&appearance, r, &x) - photo[r]).abs()).sum::<f32>() / 3.0;
            // Cauchy weights once there is something to compare with.
            let w = f64::from(if round == 0 { weight } else { weight / (1.0 + (off / 0.08).powi(2)) });
            if !w.is_finite() || w == 0.0 {
                continue;
            }
            total += w;
            for i in 0..4 {
                for j in 0..4 {
                    ata[i][j] += w * f64::from(x[i]) * f64::from(x[j]);
                }
                for r in 0..3 {
                    atb[i][r] += w * f64::from(x[i]) * f64::from(photo[r]);
                }
            }
        }
        // Without data the identity; the offset is freer than the matrix.
        let ridge = 2e-3 * total + 0.05;
        for i in 0..4 {
            ata[i][i] += ridge;
            for r in 0..3 {
                atb[i][r] += ridge * f64::from(IDENTITY[4 * r + i]);
            }
        }
        let solution = solve(ata, atb);
        for r in 0..3 {
            for i in 0..4 {
                appearance[4 * r + i] = solution[i][r] as f32;
            }
        }
    }
    appearance
}

/// A pixel in the fit of an appearance.
#[derive(Clone, Copy)]
pub(crate) struct LitPixel {
    /// The scene's colour, premultiplied, and its alpha.
    pub scene: [f32; 3],
    pub alpha: f32,
    /// The blended per-splat appearance embeddings, `[channel][rank]`.
    pub light: [f32; 3 * RANK],
    /// The photo's colour without the background's share.
    pub seen: [f32; 3],
}

/// Residual at which a pixel's weight is halved, and the standard deviation assumed for a pixel.
const RESIDUAL_SCALE: f32 = 0.08;
/// Errors of neighbouring pixels are correlated: so many of them count as one.
const TOGETHER: f64 = 30.0;

/// Rows of an appearance per channel, by least squares with a Gaussian prior of mean `usual` and variance `variance`:
/// `seen` is to be the product of row and `x(pixel, channel)`. Refitted with less weight on what does not fit, so that
/// a transient in the photo does not tint it.
fn fit_rows<const N: usize, P>(
    usual: &[[f64; N]; 3],
    variance: &[[f64; N]; 3],
    pixels: impl Iterator<Item = P> + Clone,
    x: impl Fn(&P, usize) -> [f32; N],
    seen: impl Fn(&P) -> [f32; 3],
) -> [[f32; N]; 3] {
    let mut rows = usual.map(|row| row.map(|v| v as f32));
    for round in 0..4 {
        let mut ata = [[[0.0f64; N]; N]; 3];
        let mut atb = [[[0.0f64; 1]; N]; 3];
        for pixel in pixels.clone() {
            let (x, seen) = ([x(&pixel, 0), x(&pixel, 1), x(&pixel, 2)], seen(&pixel));
            let shown = |c: usize| -> f32 { x[c].iter().zip(rows[c]).map(|(x, m)| x * m).sum() };
            let off = (0..3).map(|c| (shown(c) - seen[c]).abs()).sum::<f32>() / 3.0;
            let w = if round == 0 { 1.0 } else { 1.0 / (1.0 + (off / RESIDUAL_SCALE).powi(2)) };
            if !w.is_finite() {
                continue;
            }
            for c in 0..3 {
                for i in 0..N {
                    let wx = w * x[c][i];
                    for j in 0..=i {
                        ata[c][i][j] += f64::from(wx * x[c][j]);
                    }
                    atb[c][i][0] += f64::from(wx * seen[c]);
                }
            }
        }
        for c in 0..3 {
            for i in 0..N {
                let ridge = f64::from(RESIDUAL_SCALE).powi(2) * TOGETHER / variance[c][i].max(1e-8);
                ata[c][i][i] += ridge;
                atb[c][i][0] += ridge * usual[c][i];
                for j in 0..i {
                    ata[c][j][i] = ata[c][i][j];
                }
            }
            rows[c] = solve(ata[c], atb[c]).map(|v| v[0] as f32);
        }
    }
    rows
}

/// Mean and variance of `row` over the photos: the prior of an appearance.
fn usual<const N: usize>(
    photos: &[u32],
    row: impl Fn(usize, usize) -> [f64; N],
) -> ([[f64; N]; 3], [[f64; N]; 3]) {
    let n = photos.len().max(1) as f64;
    let (mut mean, mut variance) = ([[0.0; N]; 3], [[0.0; N]; 3]);
    for c in 0..3 {
        let rows: Vec<[f64; N]> = photos.iter().map(|&view| row(view as usize, c)).collect();
        for i in 0..N {
            mean[c][i] = rows.iter().map(|row| row[i]).sum::<f64>() / n;
            let of = rows.iter().map(|row| (row[i] - mean[c][i]).powi(2)).sum::<f64>() / n;
            variance[c][i] = of.max(1e-4);
        }
    }
    (mean, variance)
}

/// Unknowns per channel of the appearance model `embed`.
const EMBED: usize = 4 + RANK;

/// The factors of the unknowns in a channel of the appearance model `embed`.
fn embed_x(pixel: &LitPixel, c: usize) -> [f32; EMBED] {
    std::array::from_fn(|i| match i {
        0..3 => pixel.scene[i],
        3 => pixel.alpha,
        _ => pixel.light[c * RANK + i - 4],
    })
}

fn embed_row(appearance: &EmbedAppearance, view: usize, c: usize) -> [f64; EMBED] {
    let (matrix, vector) = (appearance.matrix(view), appearance.vector(view));
    std::array::from_fn(|i| f64::from(if i < 4 { matrix[4 * c + i] } else { vector[c * RANK + i - 4] }))
}

/// The `embed` appearance of one photo, at index 0, from rows that start with its unknowns.
fn embed_of<const N: usize>(rows: &[[f32; N]; 3]) -> EmbedAppearance {
    let mut fitted = EmbedAppearance::new(1, 0);
    fitted.set_matrix(0, std::array::from_fn(|i| rows[i / 4][i % 4]));
    fitted.set_vector(0, std::array::from_fn(|k| rows[k / RANK][4 + k % RANK]));
    fitted
}

/// The appearance of one photo that was not trained on, at index 0: least squares with the trained photos' mean and
/// variance as prior.
pub(crate) fn fit_embed(
    trained: &EmbedAppearance,
    photos: &[u32],
    pixels: impl Iterator<Item = LitPixel> + Clone,
) -> EmbedAppearance {
    let (mean, variance) = usual(photos, |view, c| embed_row(trained, view, c));
    embed_of(&fit_rows(&mean, &variance, pixels, embed_x, |pixel| pixel.seen))
}

/// Standard deviation by which the last layer of the colour head may change for one photo.
const FREEDOM: f64 = 0.05;

/// The appearance of one photo that was not trained on: its `embed` part as in [`fit_embed`], and the last layer of the colour
/// head, with the trained layer as prior. `pixels` also hold the head's activations before that layer.
pub(crate) fn fit_gsw(
    trained: &GswAppearance,
    photos: &[u32],
    pixels: impl Iterator<Item = (LitPixel, [f32; HIDDEN_LAYER])> + Clone,
) -> (EmbedAppearance, Vec<f32>) {
    const UNKNOWN: usize = EMBED + HIDDEN_LAYER;
    let layer = trained.layer();
    let (below, below_variance) = usual(photos, |view, c| embed_row(&trained.below, view, c));
    let (mut mean, mut variance) = ([[0.0; UNKNOWN]; 3], [[FREEDOM * FREEDOM; UNKNOWN]; 3]);
    for c in 0..3 {
        mean[c][..EMBED].copy_from_slice(&below[c]);
        variance[c][..EMBED].copy_from_slice(&below_variance[c]);
        // Two offsets that add up.
        mean[c][3] += f64::from(layer[3 * HIDDEN_LAYER + c]);
        (0..HIDDEN_LAYER).for_each(|k| mean[c][EMBED + k] = f64::from(layer[3 * k + c]));
    }
    let x = |(pixel, activations): &(LitPixel, [f32; HIDDEN_LAYER]), c: usize| -> [f32; UNKNOWN] {
        let below = embed_x(pixel, c);
        std::array::from_fn(|i| if i < EMBED { below[i] } else { activations[i - EMBED] })
    };
    let rows = fit_rows(&mean, &variance, pixels, x, |(pixel, _)| pixel.seen);
    let mut layer = vec![0.0; layer.len()];
    for (k, to) in layer[..3 * HIDDEN_LAYER].iter_mut().enumerate() {
        *to = rows[k % 3][EMBED + k / 3];
    }
    (embed_of(&rows), layer)
}

fn dot(appearance: &AffineColour, row: usize, x: &[f32; 4]) -> f32 {
    (0..4).map(|k| appearance[4 * row + k] * x[k]).sum()
}

/// The mean of several colour matrices; the identity when there is none.
pub(crate) fn mean<'a>(of: impl IntoIterator<Item = &'a AffineColour>) -> AffineColour {
    let (mut sum, mut n) = ([0.0f32; 12], 0);
    for appearance in of {
        n += 1;
        for (s, v) in sum.iter_mut().zip(appearance) {
            *s += v;
        }
    }
    if n == 0 { IDENTITY } else { sum.map(|s| s / n as f32) }
}

/// The colours that a colour matrix turns into `colours`; where the matrix is singular, the least-squares ones nearest to
/// `colours`.
pub(crate) fn undo(appearance: &AffineColour, colours: &[[f32; 3]]) -> Vec<[f32; 3]> {
    const RIDGE: f64 = 1e-3;
    let m = |r: usize, c: usize| f64::from(appearance[4 * r + c]);
    let mut ata = [[0.0f64; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            ata[i][j] = (0..3).map(|r| m(r, i) * m(r, j)).sum::<f64>();
        }
        ata[i][i] += RIDGE;
    }
    colours
        .iter()
        .enumerate()
        .map(|(k, colour)| {
            // Only the constant part of a background carries the offset.
            let offset = |r: usize| if k == 0 { m(r, 3) } else { 0.0 };
            let seen: [f64; 3] = std::array::from_fn(|r| f64::from(colour[r]) - offset(r));
            let mut atb = [[0.0f64; 1]; 3];
            for i in 0..3 {
                atb[i][0] = (0..3).map(|r| m(r, i) * seen[r]).sum::<f64>() + RIDGE * f64::from(colour[i]);
            }
            solve(ata, atb).map(|row| row[0] as f32)
        })
        .collect()
}

/// The background that a colour matrix turns into this one.
pub(crate) fn background_before(background: &Background, appearance: &AffineColour) -> Background {
    Background { coefficients: undo(appearance, &background.coefficients) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use segwild_objective::background::{PRIOR, SkySums, direction};
    use segwild_scene::{Camera, Pose, Random};

    const MATRIX: AffineColour = [0.8, 0.1, 0.0, 0.05, 0.0, 1.1, -0.1, 0.0, 0.1, 0.0, 0.6, 0.2];

    fn camera() -> (Camera, Pose) {
        let camera = Camera { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        (camera, Pose::look_at(Vec3::new(1.0, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y))
    }

    /// The sky of a photo whose appearance makes the scene much darker.
    #[test]
    fn a_bright_sky_around_a_dark_statue_keeps_its_colour() {
        let (camera, pose) = camera();
        let sky = |d: Vec3| [0.95, 0.7 - 0.2 * d.y, 0.6 + 0.1 * d.x];
        let seen = |i: usize| Some((sky(direction(&camera, &pose, i % 40, i / 40)), 1.0));
        let background = Background::fit(SkySums::of(&camera, &pose, 1, seen), PRIOR).unwrap();
        for gain in [0.5, 0.25, 0.12] {
            let appearance = [gain, 0.0, 0.0, 0.0, 0.0, gain, 0.0, 0.02, 0.0, 0.0, 0.8 * gain, 0.0];
            let image = background_before(&background, &appearance).paint(&camera, &pose);
            for i in 0..1200 {
                let x = [image.data[i], image.data[1200 + i], image.data[2400 + i], 1.0];
                let wanted = seen(i).unwrap().0;
                for c in 0..3 {
                    let shown: f32 = (0..4).map(|k| appearance[4 * c + k] * x[k]).sum();
                    assert!((shown - wanted[c]).abs() < 0.08, "{gain} {i} {c}: {shown} for {}", wanted[c]);
                }
            }
        }
    }

    #[test]
    fn a_colour_matrix_is_found_despite_transients_and_can_be_undone() {
        let mut r = Random::new(3);
        let pairs: Vec<([f32; 3], f32, [f32; 3], f32)> = (0..600)
            .map(|i| {
                let c = [r.uniform(), r.uniform(), r.uniform()];
                let x = [c[0], c[1], c[2], 1.0];
                let seen = [0, 1, 2].map(|k| dot(&MATRIX, k, &x));
                (c, 1.0, if i % 7 == 0 { [0.9, 0.0, 0.0] } else { seen }, 1.0)
            })
            .collect();
        let found = fit(pairs.iter().copied());
        for k in 0..12 {
            assert!((found[k] - MATRIX[k]).abs() < 0.05, "{k}: {} {}", found[k], MATRIX[k]);
        }
        let shown = [[0.3, 0.4, 0.5], [0.1, 0.0, -0.2]];
        let back = undo(&MATRIX, &shown);
        for k in 0..2 {
            let x = [back[k][0], back[k][1], back[k][2], if k == 0 { 1.0 } else { 0.0 }];
            assert!((0..3).all(|c| (dot(&MATRIX, c, &x) - shown[k][c]).abs() < 0.01));
        }
        // Without data the identity. A matrix that makes everything black is undone to finite values.
        assert_eq!(fit(std::iter::empty()), IDENTITY);
        assert!(undo(&[0.0; 12], &shown).iter().flatten().all(|v| v.is_finite()));
    }
}
