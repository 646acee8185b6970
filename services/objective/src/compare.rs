//! The photo's half of a training step (method, sections 2 and 3): the losses of a rendered image against the photo,
//! and their gradients. The splats' half renders them and learns from the image's gradient.
//!
//! [`compare`] is stateless: sums for the photo's appearance, for the background and for the histogram of residuals are
//! returned ([`LossOutput`]). So it may run where the image is, on the host or on a device.

pub use crate::photo_target::{PhotoTarget, untrusted};

use crate::appearance::{apply_matrix, matrix_backward};
use crate::background::{BackgroundSums, ColourSums, SkySums, add_background, paint};
use crate::photometric;
use crate::transients::{self, Residuals, VisibilityMap, leave_out, relative};
use segwild_nn::{Lpips, Map};
use segwild_raster::Frame;
use segwild_scene::{Camera, Image, Pose, box_mean, in_pieces, per_piece, per_pixel};
use std::ops::Range;

/// Half width of the window over which errors are averaged for density control.
pub const ERROR_WINDOW: usize = 2;
/// Least transmittance by which an alpha's gradient is divided in the sky.
pub const LEAST_OPEN: f32 = 0.05;

/// Which pixels a comparison leaves out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LeaveOut<'a> {
    /// None of those that count.
    None,
    /// The initial transients.
    InitialTransients,
    /// Those whose residual stands out ([`leave_out`]).
    Residual(Residuals<'a>),
}

/// Settings and state for the losses of an image against its photo.
#[derive(Clone, Copy, Debug)]
pub struct LossInputs<'a> {
    /// The photo's camera, at the target's size.
    pub camera: &'a Camera,
    /// Its pose.
    pub pose: &'a Pose,
    /// The photo's colours from the scene's, row by row with an offset; `None`: they are the same.
    pub matrix: Option<[f32; 12]>,
    /// Coefficients of the background, in the scene's colours: one, or [`BASES`] of them.
    pub background: &'a [[f32; 3]],
    /// Whether the background is fitted as a sky, in the photo's colours, or as one colour.
    pub has_sky: bool,
    /// What is left out.
    pub leave_out: LeaveOut<'a>,
    /// Share of SSIM in the loss.
    pub lambda_ssim: f32,
    /// Weight of the sky's term: the mean over pixels of -ln(1 - alpha) in the sky.
    pub sky_weight: f32,
}

/// The perceptual term of the loss, which the host computes: no engine has it on its device.
#[derive(Clone, Copy, Debug)]
pub struct PerceptualLoss<'a> {
    /// The distance.
    pub lpips: &'a Lpips,
    /// Its weight in the loss.
    pub weight: f32,
}

/// Output of a comparison.
#[derive(Clone, Debug, PartialEq)]
pub struct LossOutput {
    /// [`photometric`], and the perceptual term where there is one.
    pub loss: f32,
    /// Of the pixels that count and are not left out, in dB; 0 where there are none.
    pub psnr: f32,
    /// Share of those that count that were left out.
    pub left_out: f32,
    /// Decaying histogram of residuals, with this visit's; `None` where it was not requested, or no pixel counts.
    pub residuals: Option<Vec<f32>>,
    /// Gradient of [`LossInputs::matrix`], where there is one.
    pub matrix: Option<[f32; 12]>,
    /// Sums for the background.
    pub background: BackgroundSums,
}

/// Losses of an image against a photo, with gradients.
#[derive(Clone, Debug, PartialEq)]
pub struct Compared {
    /// Losses and sums.
    pub output: LossOutput,
    /// Gradient of the image, three planes.
    pub image: Image,
    /// Gradient of its alpha.
    pub alpha: Image,
    /// Mean error around each pixel, one plane, for density control.
    pub error: Image,
    /// Weight of each pixel, one plane: 0 where it does not count or is left out.
    pub weights: Image,
    /// Per part of [`VisibilityMap::map`], the mean residual relative to the limit for transients, `None` where no pixel
    /// counts; empty where it was not requested.
    pub part_residuals: Vec<Option<f32>>,
}

/// Computes the losses of a frame against a photo, and their gradients. A visibility map takes part where
/// [`LeaveOut::Residual`] is set. The perceptual term adds its weight times LPIPS, where the image is large enough for it.
///
/// # Panics
/// If frame and target differ in size.
pub fn compare(
    frame: &Frame,
    target: &PhotoTarget,
    loss_inputs: &LossInputs,
    seeing: Option<&VisibilityMap>,
    perceptual: Option<&PerceptualLoss>,
) -> Compared {
    let photo = target.image();
    let Composed { background, scene, shown, residual } = compose(frame, &photo, loss_inputs);
    let (mut residuals, mut part_residuals) = (None, Vec::new());
    let kept = match loss_inputs.leave_out {
        LeaveOut::None => None,
        LeaveOut::InitialTransients => {
            let keep = |i: usize| f32::from(u8::from(!target.is(i, PhotoTarget::INITIAL_TRANSIENT)));
            Some(per_pixel(target.pixels.len(), keep))
        }
        LeaveOut::Residual(before) => {
            let uncertain = target.uncertain(&residual);
            let counts = |i: usize| target.is(i, PhotoTarget::COUNTS);
            let (kept, held) = leave_out(&before, &uncertain, target.width, counts, |i| {
                target.is(i, PhotoTarget::INITIAL_TRANSIENT)
            });
            residuals = held;
            let seen = seeing.and_then(|&VisibilityMap { map, decides }| {
                let ratio = relative(&uncertain, target.width, counts, before.share);
                part_residuals = transients::part_residuals(map, &ratio, target);
                decides.then(|| transients::visibility_weights(map, target, kept.as_deref(), before.share))?
            });
            seen.or(kept)
        }
    };
    let (weights, left_out) = pixel_weights(target, kept.as_deref());
    let psnr = weighted_psnr(&shown, &photo, &weights.data);
    let (mut loss, mut grad) = photometric(&shown, &photo, Some(&weights), loss_inputs.lambda_ssim);
    if let Some(perceptual) = perceptual {
        loss += add_perceptual(perceptual, &shown, &photo, &weights.data, &mut grad);
    }
    let (image, matrix) = match &loss_inputs.matrix {
        Some(matrix) => {
            let (image, sums) = matrix_backward(matrix, &scene, &grad);
            (image, Some(sums))
        }
        None => (grad, None),
    };
    let alpha = alpha_gradient(&image, &background, &frame.alpha, target, loss_inputs.sky_weight);
    let background = if loss_inputs.has_sky {
        let sums =
            SkySums::of_photo(loss_inputs.camera, loss_inputs.pose, target, &frame.alpha, &weights.data);
        BackgroundSums::Sky(Box::new(sums))
    } else {
        BackgroundSums::Colour(ColourSums::of(&shown, &photo, &frame.alpha, &weights.data))
    };
    let error = error_around(&residual, &weights);
    Compared {
        output: LossOutput { loss, psnr, left_out, residuals, matrix, background },
        image,
        alpha,
        error,
        weights,
        part_residuals,
    }
}

/// Adds the gradient of the perceptual term and returns the term.
///
/// Where a pixel does not count the photo shows something else than the scene: there it is taken for the render, and teaches
/// nothing. The paper compares whole images; its transients would come back by this term.
fn add_perceptual(
    PerceptualLoss { lpips, weight }: &PerceptualLoss,
    shown: &Image,
    photo: &Image,
    weights: &[f32],
    grad: &mut Image,
) -> f32 {
    let (height, width) = (shown.height, shown.width);
    let map = |data: Vec<f32>| Map { channels: 3, height, width, data };
    let of_pixels = weights.iter().cycle();
    // One number that is none would be in the features of all pixels around it.
    let finite = |(r, p): (&f32, &f32)| if r.is_finite() { *r } else { *p };
    let shown: Image = Image { data: shown.data.iter().zip(&photo.data).map(finite).collect(), ..*shown };
    let known = photo.data.iter().zip(&shown.data).zip(of_pixels.clone());
    let known = known.map(|((p, r), w)| if *w == 1.0 { *p } else { w * p + (1.0 - w) * r }).collect();
    let Some((distance, by_render)) = lpips.gradient(&map(shown.data), &map(known)) else { return 0.0 };
    for ((sum, g), w) in grad.data.iter_mut().zip(&by_render.data).zip(of_pixels) {
        *sum += weight * w * g;
    }
    weight * distance as f32
}

/// A frame over its background, in the colours of its photo.
struct Composed {
    /// The background, in the scene's colours.
    background: Image,
    /// Splats before it, likewise.
    scene: Image,
    /// The same in the photo's colours.
    shown: Image,
    /// Mean absolute difference of the colours per pixel.
    residual: Vec<f32>,
}

fn compose(frame: &Frame, photo: &Image, loss_inputs: &LossInputs) -> Composed {
    let background = paint(loss_inputs.background, loss_inputs.camera, loss_inputs.pose);
    let mut scene = frame.image.clone();
    add_background(&mut scene, &frame.alpha, &background);
    let shown = match &loss_inputs.matrix {
        Some(matrix) => apply_matrix(matrix, &scene),
        None => scene.clone(),
    };
    let residual = mean_difference(&shown, photo);
    Composed { background, scene, shown, residual }
}

/// Mean absolute colour difference per pixel.
pub fn mean_difference(a: &Image, b: &Image) -> Vec<f32> {
    let mut out = vec![0.0f32; a.pixels()];
    in_pieces(&mut out, |first, piece| {
        for c in 0..3 {
            for ((o, x), y) in piece.iter_mut().zip(&a.plane(c)[first..]).zip(&b.plane(c)[first..]) {
                *o += (x - y).abs() * (1.0 / 3.0);
            }
        }
    });
    out
}

/// Weight per pixel (1 counts, 0 does not), and the share of the counted pixels that `kept` leaves out.
fn pixel_weights(target: &PhotoTarget, kept: Option<&[f32]>) -> (Image, f32) {
    let counts = |i: usize| f32::from(u8::from(target.is(i, PhotoTarget::COUNTS)));
    let data = match kept {
        None => per_pixel(target.pixels.len(), counts),
        Some(kept) => per_pixel(target.pixels.len(), |i| counts(i) * kept[i]),
    };
    let left_out = kept.map_or(0.0, |_| {
        let sums = per_piece(data.len(), |piece| {
            let before: f32 = piece.clone().map(counts).sum();
            [before, data[piece].iter().sum()].map(f64::from)
        });
        let [before, after] =
            sums.iter().fold([0.0; 2], |sums, piece| [sums[0] + piece[0], sums[1] + piece[1]]);
        left_out_share(before as f32, after as f32)
    });
    (Image { width: target.width, height: target.height, channels: 1, data }, left_out)
}

/// Share of the weight `before` that is gone `after`.
pub fn left_out_share(before: f32, after: f32) -> f32 {
    if before > 0.0 { 1.0 - after / before } else { 0.0 }
}

/// -10 log10 of the weighted mean squared error of the first three channels, by which a training is followed: at most 100 dB,
/// also where a pixel is NaN, and 0 dB where no pixel counts. [`crate::psnr`] is the unbounded one of reports.
pub fn weighted_psnr(a: &Image, b: &Image, weights: &[f32]) -> f32 {
    let of_piece = |piece: Range<usize>| {
        let weights = &weights[piece.clone()];
        let mut sum = 0.0f64;
        for c in 0..3 {
            let (a, b) = (&a.plane(c)[piece.clone()], &b.plane(c)[piece.clone()]);
            // Rows in f32, their sums in f64: exact enough and fast.
            for ((x, y), w) in a.chunks(256).zip(b.chunks(256)).zip(weights.chunks(256)) {
                let part: f32 = x.iter().zip(y).zip(w).map(|((x, y), w)| w * (x - y) * (x - y)).sum();
                sum += f64::from(part);
            }
        }
        [sum, weights.iter().map(|&w| f64::from(w)).sum()]
    };
    let sums = per_piece(weights.len(), of_piece);
    let [squares, weights] =
        sums.iter().fold([0.0; 2], |sums, piece| [sums[0] + piece[0], sums[1] + piece[1]]);
    psnr_of(squares, weights)
}

/// The same from the sum of the three channels' weighted squared errors, and that of the weights.
pub fn psnr_of(squares: f64, weights: f64) -> f32 {
    let total = 3.0 * weights;
    if total == 0.0 { 0.0 } else { (-10.0 * (squares / total).max(1e-10).log10()) as f32 }
}

/// Gradient with respect to the accumulated alpha: the background shines through where it is low, and the sky is to be
/// empty.
///
/// The sky's term is `weight * mean over pixels of -ln(1 - A)` on [`PhotoTarget::INNER`] pixels.
fn alpha_gradient(
    grad: &Image,
    background: &Image,
    alpha: &Image,
    target: &PhotoTarget,
    weight: f32,
) -> Image {
    let n = alpha.pixels();
    let mut out = Image::zeros(alpha.width, alpha.height, 1);
    let of_one = weight / n as f32;
    in_pieces(&mut out.data, |first, piece| {
        for c in 0..3 {
            for ((o, g), b) in
                piece.iter_mut().zip(&grad.plane(c)[first..]).zip(&background.plane(c)[first..])
            {
                *o -= g * b;
            }
        }
        if weight > 0.0 {
            for (o, i) in piece.iter_mut().zip(first..) {
                if target.is(i, PhotoTarget::INNER) {
                    *o += of_one / (1.0 - alpha.data[i]).max(LEAST_OPEN);
                }
            }
        }
    });
    out
}

/// Mean error around every pixel of those that count, one plane.
fn error_around(residual: &[f32], weights: &Image) -> Image {
    let counted: Vec<f32> = per_pixel(residual.len(), |i| residual[i] * weights.data[i]);
    let data = box_mean(&counted, weights.width, weights.height, ERROR_WINDOW);
    Image { data, ..*weights }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::background::BASES;
    use glam::Vec3;
    use segwild_nn::LpipsNet;
    use segwild_scene::Random;

    const W: usize = 13;
    const H: usize = 9;

    /// A photo with some sky, an image that differs from it, and a sky as background.
    fn example() -> (Frame, PhotoTarget, Camera, Pose, Vec<[f32; 3]>) {
        let random = &mut Random::new(6);
        let camera = Camera { width: W as u32, height: H as u32, fx: 14.0, fy: 13.0, cx: 6.0, cy: 5.0 };
        let pose = Pose::look_at(Vec3::new(0.2, -0.3, -1.0), Vec3::ZERO, Vec3::NEG_Y);
        let mut target = PhotoTarget { width: W, height: H, ..PhotoTarget::default() };
        for i in 0..W * H {
            let flags = if i < 4 * W { PhotoTarget::SKY | PhotoTarget::INNER } else { PhotoTarget::COUNTS };
            target.pixels.push([0, 1, 2, 3].map(|c| if c < 3 { random.below(256) as u8 } else { flags }));
        }
        let mut image = |channels| Image {
            data: (0..W * H * channels).map(|_| 0.1 + 0.7 * random.uniform()).collect(),
            ..Image::zeros(W, H, channels)
        };
        let frame = Frame { image: image(3), alpha: image(1) };
        let background = (0..BASES).map(|k| [0.3 / (k + 1) as f32, 0.2, 0.4 - 0.05 * k as f32]).collect();
        (frame, target, camera, pose, background)
    }

    const MATRIX: [f32; 12] = [0.9, 0.1, -0.05, 0.02, 0.05, 1.1, 0.1, -0.03, -0.1, 0.05, 0.8, 0.04];

    fn loss_inputs<'a>(camera: &'a Camera, pose: &'a Pose, background: &'a [[f32; 3]]) -> LossInputs<'a> {
        LossInputs {
            camera,
            pose,
            matrix: Some(MATRIX),
            background,
            has_sky: true,
            leave_out: LeaveOut::None,
            lambda_ssim: 0.2,
            sky_weight: 0.1,
        }
    }

    /// The loss with the sky's term.
    fn loss(frame: &Frame, target: &PhotoTarget, loss_inputs: &LossInputs) -> f64 {
        let output = compare(frame, target, loss_inputs, None, None).output;
        let sky =
            |i: usize| if target.is(i, PhotoTarget::INNER) { -(1.0 - frame.alpha.data[i]).ln() } else { 0.0 };
        let sky: f64 = (0..W * H).map(|i| f64::from(sky(i))).sum();
        f64::from(output.loss) + f64::from(loss_inputs.sky_weight) * sky / (W * H) as f64
    }

    #[test]
    fn gradients_are_finite_differences_of_the_loss() {
        let (frame, target, camera, pose, background) = example();
        let loss_inputs = loss_inputs(&camera, &pose, &background);
        let Compared { output, image, alpha, .. } = compare(&frame, &target, &loss_inputs, None, None);
        let step = 4e-3f32;
        let close = |what: &str, got: f32, up: f64, down: f64| {
            let wanted = (up - down) / f64::from(2.0 * step);
            assert!(
                (f64::from(got) - wanted).abs() < 2e-4 + 0.05 * wanted.abs(),
                "{what}: {got}, not {wanted}"
            );
        };
        for k in (0..3 * W * H).step_by(5) {
            let moved = |by: f32| {
                let mut frame = frame.clone();
                frame.image.data[k] += by;
                loss(&frame, &target, &loss_inputs)
            };
            close(&format!("colour {k}"), image.data[k], moved(step), moved(-step));
        }
        for k in (0..W * H).step_by(3) {
            let moved = |by: f32| {
                let mut frame = frame.clone();
                frame.alpha.data[k] += by;
                loss(&frame, &target, &loss_inputs)
            };
            close(&format!("alpha {k}"), alpha.data[k], moved(step), moved(-step));
        }
        let sums = output.matrix.expect("there is a matrix");
        for (k, &got) in sums.iter().enumerate() {
            let moved = |by: f32| {
                let mut matrix = MATRIX;
                matrix[k] += by;
                loss(&frame, &target, &LossInputs { matrix: Some(matrix), ..loss_inputs })
            };
            close(&format!("number {k} of the matrix"), got, moved(step), moved(-step));
        }
    }

    /// A larger example, for AlexNet needs 31 pixels either way: its last row does not count, its first is left out.
    fn larger_example() -> (Frame, PhotoTarget, Camera, Pose) {
        let random = &mut Random::new(9);
        let (w, h) = (37, 33);
        let camera = Camera { width: w as u32, height: h as u32, fx: 40.0, fy: 40.0, cx: 18.0, cy: 16.0 };
        let pose = Pose::look_at(Vec3::NEG_Z, Vec3::ZERO, Vec3::NEG_Y);
        let flags = |i: usize| match i / w {
            0 => PhotoTarget::COUNTS | PhotoTarget::INITIAL_TRANSIENT,
            y if y + 1 == h => 0,
            _ => PhotoTarget::COUNTS,
        };
        let pixel = |i: usize| [0, 1, 2, 3].map(|c| if c < 3 { random.below(256) as u8 } else { flags(i) });
        let pixels = (0..w * h).map(pixel).collect();
        let target = PhotoTarget { width: w, height: h, pixels, ..PhotoTarget::default() };
        let random = &mut Random::new(10);
        let data = (0..3 * w * h).map(|_| 0.1 + 0.8 * random.uniform()).collect();
        let frame = Frame {
            image: Image { width: w, height: h, channels: 3, data },
            alpha: Image::filled(w, h, 1, 1.0),
        };
        (frame, target, camera, pose)
    }

    #[test]
    fn the_perceptual_term_adds_its_slope_and_pixels_that_do_not_count_stay_without_gradient() {
        let (frame, target, camera, pose) = larger_example();
        let background = [[0.2; 3]];
        let loss_inputs = LossInputs {
            matrix: None,
            has_sky: false,
            leave_out: LeaveOut::InitialTransients,
            ..loss_inputs(&camera, &pose, &background)
        };
        let lpips = Lpips::parse(&LpipsNet::Alex.untrained()).unwrap();
        let perceptual = PerceptualLoss { lpips: &lpips, weight: 50.0 };
        let of = |frame: &Frame, perceptual| compare(frame, &target, &loss_inputs, None, perceptual);
        let (without, with) = (of(&frame, None), of(&frame, Some(&perceptual)));
        let n = frame.image.pixels();
        let moves = |i: usize| i % n / frame.image.width > 0 && i % n / frame.image.width + 1 < 33;
        let added: Vec<f32> = with.image.data.iter().zip(&without.image.data).map(|(a, b)| a - b).collect();
        assert!((0..3 * n).all(|i| moves(i) || with.image.data[i] == 0.0), "a pixel left out has a gradient");
        assert!(with.output.loss > without.output.loss + 1.0);
        // Along a direction in the pixels that count; those left out are taken as they are rendered.
        let direction = |i: usize| if moves(i) { ((i * 7919) % 101) as f32 / 50.0 - 1.0 } else { 0.0 };
        let moved = |by: f32| {
            let mut frame = frame.clone();
            frame.image.data.iter_mut().enumerate().for_each(|(i, v)| *v += by * direction(i));
            let loss = |perceptual| f64::from(of(&frame, perceptual).output.loss);
            loss(Some(&perceptual)) - loss(None)
        };
        let step = 1e-3;
        let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        let along: f64 = added.iter().enumerate().map(|(i, g)| f64::from(g * direction(i))).sum();
        let size: f64 = added.iter().map(|g| f64::from(g * g)).sum::<f64>().sqrt();
        assert!((slope - along).abs() < 0.03 * size, "{slope}, not {along}; of {size}");
        // A number that is none spoils nothing beyond the window of SSIM.
        let mut poisoned = frame.clone();
        poisoned.image.data[5 * 37 + 9] = f32::NAN;
        let added = of(&poisoned, Some(&perceptual)).image;
        let far = 25 * 37 + 9;
        assert!(added.data[n + far].is_finite() && added.data[2 * n - 40].is_finite());
    }

    #[test]
    fn an_image_that_is_too_small_has_no_perceptual_term() {
        let (frame, target, camera, pose, background) = example();
        let loss_inputs = loss_inputs(&camera, &pose, &background);
        let lpips = Lpips::parse(&LpipsNet::Alex.untrained()).unwrap();
        let perceptual = PerceptualLoss { lpips: &lpips, weight: 50.0 };
        let of = |perceptual| compare(&frame, &target, &loss_inputs, None, perceptual);
        assert_eq!(of(None), of(Some(&perceptual)));
    }

    #[test]
    fn a_pixel_that_does_not_count_teaches_nothing() {
        let (mut frame, mut target, camera, pose, background) = example();
        let loss_inputs = LossInputs { sky_weight: 0.0, ..loss_inputs(&camera, &pose, &background) };
        target.pixels.iter_mut().for_each(|p| p[3] = 0);
        frame.image.data[7] = 1e30;
        let Compared { output, image, alpha, error, .. } = compare(&frame, &target, &loss_inputs, None, None);
        assert_eq!((output.psnr, output.left_out), (0.0, 0.0));
        assert!(image.data.iter().chain(&alpha.data).chain(&error.data).all(|v| *v == 0.0));
    }
}
