//! Checks the kernels of the photo's half of a step: losses on the device against those on the host.

use crate::frame::interleaved;
use crate::kernel_check::KernelCheck;
use crate::mismatch::Mismatch;
use crate::tolerance::Tolerance;
use glam::Vec3;
use segwild_gpu::GpuEngine;
use segwild_gpu::probe::{ComparedOnDevice, LossPasses};
use segwild_objective::background;
use segwild_objective::background::{BASES, BackgroundSums};
use segwild_objective::compare::{self as host, Compared, LeaveOut, LossInputs, LossOutput, PhotoTarget};
use segwild_objective::transients::{BINS, Residuals, VisibilityMap, smoothed};
use segwild_objective::{AffineAppearance, Appearance};
use segwild_raster::{Frame, RasterError};
use segwild_scene::{Camera, Image, Pose, Random};

/// A photo, an image of the scene, and the settings of the losses.
#[derive(Clone, Debug)]
pub struct TestCase {
    /// Name of the case.
    pub name: &'static str,
    frame: Frame,
    target: PhotoTarget,
    camera: Camera,
    pose: Pose,
    matrix: Option<[f32; 12]>,
    background: Vec<[f32; 3]>,
    leave: Leave,
    /// Visibility map of the photo; it decides what is left out.
    map: Option<Image>,
}

#[derive(Clone, Debug)]
enum Leave {
    None,
    InitialTransients,
    /// With the shares of earlier visits.
    Residual(Vec<f32>),
}

impl TestCase {
    fn loss_inputs(&self) -> LossInputs<'_> {
        LossInputs {
            camera: &self.camera,
            pose: &self.pose,
            matrix: self.matrix,
            background: &self.background,
            has_sky: self.background.len() > 1,
            leave_out: match &self.leave {
                Leave::None => LeaveOut::None,
                Leave::InitialTransients => LeaveOut::InitialTransients,
                Leave::Residual(before) => LeaveOut::Residual(Residuals { before, share: 0.3 }),
            },
            lambda_ssim: 0.2,
            sky_weight: 0.1,
        }
    }
}

/// Test cases of this size that together cover all settings: one colour or a sky as background, a matrix or none, and
/// nothing left out, or the initial transients, or outliers at the first visit and later, in a photo that changed and
/// in one that did not.
pub fn test_cases((width, height): (u32, u32)) -> Vec<TestCase> {
    let random = &mut Random::new(41);
    let (w, h) = (width as usize, height as usize);
    let camera = Camera {
        width,
        height,
        fx: 1.1 * w as f32,
        fy: 1.05 * w as f32,
        cx: 0.47 * w as f32,
        cy: 0.52 * h as f32,
    };
    let pose = Pose::look_at(Vec3::new(0.3, -0.4, -1.6), Vec3::ZERO, Vec3::new(0.1, -1.0, 0.0));
    let matrix = [0.9, 0.1, -0.05, 0.02, 0.05, 1.1, 0.1, -0.03, -0.1, 0.05, 0.8, 0.04];
    // A photo of waves, an image of nearly the same, and a transient before a third of it.
    let wave = |x: usize, y: usize, c: usize| {
        0.5 + 0.3 * (0.31 * x as f32 + 0.17 * y as f32 + c as f32).sin() * (0.07 * (x * y) as f32).cos()
    };
    let transient = |x: usize, y: usize| 5 * x < 2 * w && 3 * x > w / 2 && 2 * y > h;
    let mut target = PhotoTarget { width: w, height: h, ..PhotoTarget::default() };
    let (mut image, mut alpha) = (Image::zeros(w, h, 3), Image::zeros(w, h, 1));
    for i in 0..w * h {
        let (x, y) = (i % w, i / w);
        let sky = 4 * y < h;
        let mut flags = if sky { PhotoTarget::SKY } else { PhotoTarget::COUNTS };
        if sky && 4 * (y + 1) < h {
            flags |= PhotoTarget::INNER;
        }
        if random.below(40) == 0 {
            flags = 0;
        }
        if transient(x + 3, y) {
            flags |= PhotoTarget::INITIAL_TRANSIENT;
        }
        alpha.data[i] = if sky { 0.3 * random.uniform() } else { 1.0 - 0.2 * random.uniform() };
        let mut pixel = [0, 0, 0, flags];
        for c in 0..3 {
            let seen = if transient(x, y) { 0.9 - 0.4 * wave(y, x, c) } else { wave(x, y, c) };
            pixel[c] = (255.0 * seen) as u8;
            image.data[c * w * h + i] = alpha.data[i] * (wave(x, y, c) + 0.1 * random.uniform() - 0.05);
        }
        target.pixels.push(pixel);
        target.trust.push(if x % 9 < 3 { 0.9 * random.uniform() } else { 0.0 });
    }
    let sky: Vec<[f32; 3]> = (0..BASES).map(|_| [0; 3].map(|_| 0.8 * random.uniform() - 0.2)).collect();
    // Histograms with large residuals, and with residuals near 0.
    let much: Vec<f32> = (0..BINS).map(|b| if b < 60 { 1.0 / 60.0 } else { 0.0 }).collect();
    let little: Vec<f32> = (0..BINS).map(|b| if b < 4 { 0.25 } else { 0.0 }).collect();
    let untrusted = PhotoTarget { trust: Vec::new(), ..target.clone() };
    let base = TestCase {
        name: "one colour as background, nothing left out",
        frame: Frame { image, alpha },
        target: untrusted,
        camera,
        pose,
        matrix: None,
        background: vec![[0.4, 0.5, 0.7]],
        leave: Leave::None,
        map: None,
    };
    let first = Leave::Residual(Vec::new());
    // Of a size that does not divide the photo's; a blur where the transient is.
    let (across, down) = ((w / 7).max(1), (h / 6).max(1));
    let seen = |transient_is: f32, others_are: f32| {
        let at = |i: usize| (i % across * w / across, i / across * h / down);
        let value = |i: usize| {
            let (x, y) = at(i);
            let sure = if transient(x, y) { transient_is } else { others_are };
            (sure + 0.05 * (i as f32).sin()).clamp(0.02, 0.98)
        };
        Image { data: (0..across * down).map(value).collect(), ..Image::zeros(across, down, 1) }
    };
    let mut darker = base.frame.clone();
    darker.image.data.iter_mut().for_each(|v| *v *= 0.5);
    vec![
        base.clone(),
        TestCase { name: "initial transients left out", leave: Leave::InitialTransients, ..base.clone() },
        TestCase { name: "outliers left out", leave: first, target: target.clone(), ..base.clone() },
        TestCase {
            name: "a photo seen before, a sky, a matrix",
            leave: Leave::Residual(much.clone()),
            target: target.clone(),
            matrix: Some(matrix),
            background: sky.clone(),
            ..base.clone()
        },
        TestCase {
            name: "a photo that changed",
            frame: darker,
            leave: Leave::Residual(little),
            target: target.clone(),
            background: sky,
            ..base.clone()
        },
        TestCase {
            name: "a visibility map that finds the transient",
            leave: Leave::Residual(much.clone()),
            target: target.clone(),
            map: Some(seen(0.3, 0.9)),
            ..base.clone()
        },
        TestCase {
            name: "a visibility map near 0 everywhere",
            leave: Leave::Residual(Vec::new()),
            target,
            map: Some(seen(0.05, 0.15)),
            ..base
        },
    ]
}

/// Numbers that are off by rounding alone, but for a few at a cut-off.
const SUMS: Tolerance = Tolerance { tight: 1e-3, flips: 0.0, loose: 1e-3 };
/// Shown colours and residuals.
const SHOWN: Tolerance = Tolerance { tight: 1e-5, flips: 0.0, loose: 1e-5 };
/// Weights: a pixel whose residual lies at the edge of a bin falls on either side.
const WEIGHTS: Tolerance = Tolerance { tight: 1e-6, flips: 0.002, loose: 2.0 };
/// The same with a visibility map: its weights come from an exponential and a division, which WGSL lets be off by
/// several units in the last place (1.5e-6 on an NVIDIA H200).
const WITH_MAP: Tolerance = Tolerance { tight: 1e-5, ..WEIGHTS };
/// Gradients, next to such a pixel as well.
const GRADS: Tolerance = Tolerance { tight: 1e-3, flips: 0.02, loose: 10.0 };

/// Shares of a histogram: a pixel at the edge of a bin falls on either side.
const SHARES: Tolerance = Tolerance { tight: 0.02, flips: 0.1, loose: 0.1 };
/// Errors around pixels, next to one that is decided otherwise as well.
const ERRORS: Tolerance = Tolerance { tight: 1e-3, flips: 0.02, loose: 2.0 };

/// Compares the losses of a case on the device with those on the host, kernel by kernel.
pub fn compared(engine: &GpuEngine, test_case: &TestCase) -> Result<Vec<KernelCheck>, RasterError> {
    let loss_inputs = test_case.loss_inputs();
    let TestCase { frame, target, .. } = test_case;
    let seeing = test_case.map.as_ref().map(|map| VisibilityMap { map, decides: true });
    let wanted = host::compare(frame, target, &loss_inputs, seeing.as_ref(), None);
    let got: ComparedOnDevice =
        LossPasses::upload(engine, frame, target, &loss_inputs, test_case.map.as_ref())?
            .results(&loss_inputs)?;
    let shown = shown(test_case);
    let residual = host::mean_difference(&shown, &target.image());
    let mut checked = Vec::new();
    let mut add = |kernels, off: Result<(), Mismatch>| {
        checked.push(KernelCheck { kernels, off: off.err().map(|off| off.of_case(test_case.name)) });
    };
    let planes = [shown.plane(0), shown.plane(1), shown.plane(2), &residual];
    let packed: Vec<f32> = (0..residual.len()).flat_map(|i| planes.map(|plane| plane[i])).collect();
    add(&["compose"], SHOWN.compare("shown colours and residuals", &got.shown, &packed));
    if let LeaveOut::Residual(_) = loss_inputs.leave_out {
        let smooth = smoothed(&target.uncertain(&residual), target.width);
        add(&["compose", "box_mean"], SHOWN.compare("smoothed residuals", &got.smoothed, &smooth));
        let (got, wanted) = (&got.output.residuals, &wanted.output.residuals);
        add(&["residual_histogram", "residual_limits"], SHARES.compare("shares", some(got), some(wanted)));
    }
    if let Some(part_residuals) = &got.part_residuals {
        let wanted: Vec<f32> =
            wanted.part_residuals.iter().map(|residual| residual.unwrap_or(-1.0)).collect();
        add(
            &["part_residuals", "residual_limits"],
            SUMS.compare("residuals of parts", part_residuals, &wanted),
        );
    }
    let (kernels, tolerance): (&[&str], _) = if test_case.map.is_some() {
        (&["visibility_weights", "choose_weights"], WITH_MAP)
    } else {
        (&["pixel_weights", "residual_limits"], WEIGHTS)
    };
    add(kernels, tolerance.compare("weights", &got.weights, &wanted.weights.data));
    let quality = |results: &LossOutput| [results.psnr, results.left_out];
    add(
        &["pixel_weights", "sum_groups", "choose_weights"],
        SUMS.compare("quality", &quality(&got.output), &quality(&wanted.output)),
    );
    add(
        &["box_mean", "pixel_weights", "choose_weights"],
        ERRORS.compare("errors", &got.error, &wanted.error.data),
    );
    let Compared { output, image, alpha, .. } = wanted;
    add(&["ssim", "l1_ssim_backward"], SUMS.compare("loss", &[got.output.loss], &[output.loss]));
    let wide = interleaved(&Frame { image, alpha });
    let kernels: &[&str] = if loss_inputs.matrix.is_some() {
        &["compose_backward"]
    } else {
        &["ssim", "l1_ssim_backward", "compose_backward"]
    };
    add(kernels, GRADS.compare("gradients", &got.grads, &wide));
    if let (Some(got), Some(wanted)) = (&got.output.matrix, &output.matrix) {
        add(&["compose_backward"], SUMS.compare("gradient of the matrix", got, wanted));
    }
    let sums = |results: &LossOutput| match &results.background {
        BackgroundSums::Sky(sums) => {
            let numbers = sums.products.as_flattened().iter().chain(sums.colours.as_flattened());
            numbers.chain(&[sums.total, sums.looked]).map(|&v| v as f32).collect::<Vec<_>>()
        }
        BackgroundSums::Colour(sums) => [sums.pull.as_slice(), &[sums.total]].concat(),
    };
    let kernels: &[&str] = if loss_inputs.has_sky { &["sky_sums"] } else { &["colour_sums"] };
    add(kernels, SUMS.compare("sums for the background", &sums(&got.output), &sums(&output)));
    Ok(checked)
}

fn some(shares: &Option<Vec<f32>>) -> &[f32] {
    shares.as_deref().unwrap_or_default()
}

/// Colours shown by the host.
fn shown(test_case: &TestCase) -> Image {
    let mut scene = test_case.frame.image.clone();
    let background = background::paint(&test_case.background, &test_case.camera, &test_case.pose);
    background::add_background(&mut scene, &test_case.frame.alpha, &background);
    let Some(matrix) = test_case.matrix else { return scene };
    let mut appearance = AffineAppearance::new(1);
    appearance.set_matrix(0, matrix);
    appearance.apply(0, &scene)
}
