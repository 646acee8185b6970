//! Per-pixel pieces of a training step.

use crate::background::Background;
use crate::photos::{Level, Stored};
use segwild_raster::Projected;
use segwild_scene::{Camera, Image, Pose};

/// Mean absolute colour difference per pixel.
pub(crate) fn mean_difference(a: &Image, b: &Image) -> Vec<f32> {
    let n = a.pixels();
    let mut out = vec![0.0f32; n];
    for c in 0..3 {
        for ((o, x), y) in out.iter_mut().zip(a.plane(c)).zip(b.plane(c)) {
            *o += (x - y).abs() * (1.0 / 3.0);
        }
    }
    out
}

/// Weight per pixel (1 counts, 0 does not), and the share of the counted pixels that `kept` leaves out.
pub(crate) fn pixel_weights(photo: &Level, kept: Option<&[f32]>) -> (Image, f32) {
    let data = (0..photo.pixels()).map(|i| f32::from(u8::from(photo.counts(i)))).collect();
    let mut weights = Image { width: photo.width, height: photo.height, channels: 1, data };
    let Some(kept) = kept else { return (weights, 0.0) };
    let before: f32 = weights.data.iter().sum();
    for (w, k) in weights.data.iter_mut().zip(kept) {
        *w *= k;
    }
    let after: f32 = weights.data.iter().sum();
    (weights, if before > 0.0 { 1.0 - after / before } else { 0.0 })
}

/// -10 log10 of the weighted mean squared error; 0 dB where no pixel counts.
pub(crate) fn weighted_psnr(a: &Image, b: &Image, weights: &[f32]) -> f32 {
    let mut sum = 0.0f64;
    for c in 0..3 {
        // Rows in f32, their sums in f64: exact enough and fast.
        for ((x, y), w) in a.plane(c).chunks(256).zip(b.plane(c).chunks(256)).zip(weights.chunks(256)) {
            let part: f32 = x.iter().zip(y).zip(w).map(|((x, y), w)| w * (x - y) * (x - y)).sum();
            sum += f64::from(part);
        }
    }
    let total = 3.0 * weights.iter().map(|&w| f64::from(w)).sum::<f64>();
    if total == 0.0 { 0.0 } else { (-10.0 * (sum / total).max(1e-10).log10()) as f32 }
}

/// Adds `(1 - alpha) * behind`.
pub(crate) fn add_behind(image: &mut Image, alpha: &Image, behind: &Image) {
    for c in 0..3 {
        let plane = image.plane_mut(c);
        for ((v, a), b) in plane.iter_mut().zip(&alpha.data).zip(behind.plane(c)) {
            *v += (1.0 - a) * b;
        }
    }
}

/// Gradient with respect to the accumulated alpha: what is behind shines through where it is low, and the
/// sky is to be empty.
///
/// The sky's term is `weight * mean over pixels of -ln(1 - A)` on sky pixels whose neighbours are sky as
/// well: the border of a sky mask is the part that is wrong.
pub(crate) fn alpha_gradient(
    grad: &Image,
    behind: &Image,
    alpha: &Image,
    photo: &Level,
    weight: f32,
) -> Image {
    let n = alpha.pixels();
    let mut out = Image::zeros(alpha.width, alpha.height, 1);
    for c in 0..3 {
        for ((o, g), b) in out.data.iter_mut().zip(grad.plane(c)).zip(behind.plane(c)) {
            *o -= g * b;
        }
    }
    if weight > 0.0 {
        let (w, h) = (photo.width, photo.height);
        let per_pixel = weight / n as f32;
        for y in 0..h {
            for x in 0..w {
                let i = y * w + x;
                let inner = photo.sky(i)
                    && (x == 0 || photo.sky(i - 1))
                    && (x + 1 == w || photo.sky(i + 1))
                    && (y == 0 || photo.sky(i - w))
                    && (y + 1 == h || photo.sky(i + w));
                if inner {
                    out.data[i] += per_pixel / (1.0 - alpha.data[i]).max(0.05);
                }
            }
        }
    }
    out
}

/// Mean error around every pixel of those that count, one plane.
pub(crate) fn error_around(residual: &[f32], weights: &[f32], photo: &Level) -> Image {
    let (width, height) = (photo.width, photo.height);
    let counted: Vec<f32> = residual.iter().zip(weights).map(|(r, w)| r * w).collect();
    Image { width, height, channels: 1, data: segwild_scene::box_mean(&counted, width, height, 2) }
}

/// A plane at the centre of every splat that is seen, for density control; 0 outside the frame.
pub(crate) fn at_centres(plane: &Image, projected: &dyn Projected) -> Vec<f32> {
    let (w, h) = (plane.width as f32, plane.height as f32);
    projected
        .centres()
        .iter()
        .zip(projected.radii())
        .map(|(c, &r)| {
            let inside = r > 0.0 && c[0] >= 0.0 && c[1] >= 0.0 && c[0] < w && c[1] < h;
            if inside { plane.data[c[1] as usize * plane.width + c[0] as usize] } else { 0.0 }
        })
        .collect()
}

/// What a photo shows behind the splats at first: a sky fitted to its sky pixels, or else its mean colour.
pub(crate) fn first_background(stored: &Stored, camera: &Camera, pose: &Pose) -> Background {
    let photo = &stored.levels[0];
    let sky = stored
        .has_sky
        .then(|| Background::fit(camera, pose, 2, |i| photo.sky(i).then(|| (photo.colour(i), 1.0))))
        .flatten();
    sky.unwrap_or_else(|| {
        let (mut sum, mut n) = ([0.0f64; 3], 0.0f64);
        for i in (0..photo.pixels()).filter(|&i| photo.valid(i)) {
            let c = photo.colour(i);
            for k in 0..3 {
                sum[k] += f64::from(c[k]);
            }
            n += 1.0;
        }
        Background::constant(sum.map(|s| (s / n.max(1.0)) as f32))
    })
}

/// Refits a sky to what its photo shows: its sky pixels, and whatever else no splat covers (a sea, a haze),
/// so that no splat has to float there. A quarter of the way per visit.
pub(crate) fn learn_sky(
    background: &mut Background,
    photo: &Level,
    camera: &Camera,
    pose: &Pose,
    alpha: &Image,
    weights: &[f32],
) {
    let open = |i: usize| (1.0 - alpha.data[i]).max(0.0).powi(2) * weights[i];
    let seen = |i: usize| {
        let weight = if photo.sky(i) { 1.0 } else { open(i) };
        (weight > 0.01).then(|| (photo.colour(i), weight))
    };
    if let Some(fitted) = Background::fit(camera, pose, 3, seen) {
        *background = background.towards(&fitted, 0.25);
    }
}

/// Moves a photo's constant background towards the colour that fits best behind the splats: least squares
/// in closed form, held to where it was by a hundredth of the pixels, half of the way per visit.
pub(crate) fn learn_constant(
    background: &mut Background,
    shown: &Image,
    target: &Image,
    alpha: &Image,
    weights: &[f32],
) {
    let [colour] = background.coefficients.as_mut_slice() else { return };
    let n = alpha.pixels();
    let ridge = 0.01 * n as f32;
    let mut total = ridge;
    for (a, w) in alpha.data.iter().zip(weights) {
        total += w * (1.0 - a) * (1.0 - a);
    }
    for c in 0..3 {
        let mut pull = 0.0;
        for (((s, t), a), w) in shown.plane(c).iter().zip(target.plane(c)).zip(&alpha.data).zip(weights) {
            pull += w * (1.0 - a) * (t - s);
        }
        colour[c] = (colour[c] + 0.5 * pull / total).clamp(0.0, 1.0);
    }
}
