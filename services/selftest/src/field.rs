//! Checks the feature field's kernels against the host's losses and optimiser.

use crate::feature_case::FeatureCase;
use crate::frame::{SIZE, SPLATS};
use crate::kernel_check::KernelCheck;
use crate::mismatch::Mismatch;
use crate::tolerance::Tolerance;
use segwild_gpu::GpuEngine;
use segwild_gpu::probe::{FieldGradients, RowSteps};
use segwild_objective::FieldBackend;
use segwild_objective::field::{FieldWeights, Lifting, Queries, RowAdam, dot, score};
use segwild_raster::{Channels, Projected, RasterError, ResidentChannels};
use segwild_scene::{Image, Random};

const WEIGHTS: FieldWeights = FieldWeights { embedding: 0.7, compact: 0.3, rate: 0.01 };

/// Compares the optimiser of rows and sums over views, then the embedding and compactness losses: with few channels and
/// with more than are blended at once, on grids that are finer and coarser than the view, with and without a decoder.
pub fn field(engine: &GpuEngine, view: &dyn Projected) -> Result<Vec<KernelCheck>, RasterError> {
    let mut checked =
        vec![KernelCheck { kernels: &["row_state", "row_step", "row_add"], off: rows(engine, view)?.err() }];
    for case in [
        FeatureCase { size: SIZE, channels: 20, decoded: None, grid: [24, 17], pixels: 700, masks: 70 },
        FeatureCase { size: SIZE, channels: 3, decoded: None, grid: [130, 68], pixels: 1100, masks: 9 },
        FeatureCase { size: SIZE, channels: 20, decoded: Some(30), grid: [40, 31], pixels: 0, masks: 0 },
    ] {
        let off = compared(&case, engine, FieldWeights { compact: 0.0, ..WEIGHTS }, false)?.err();
        checked.push(KernelCheck { kernels: &["area_average", "embedding_loss", "area_spread"], off });
        let off = compared(&case, engine, FieldWeights { embedding: 0.0, ..WEIGHTS }, true)?.err();
        checked.push(KernelCheck {
            kernels: &[
                "sampled_features",
                "unit_features",
                "mask_pair_counts",
                "compactness_loss",
                "unit_features_backward",
                "sampled_features_backward",
            ],
            off,
        });
    }
    checked.push(KernelCheck { kernels: &["blend", "gather"], off: steps(engine, view)?.err() });
    for (channels, queries) in [(3, 1), (20, 5)] {
        let off = resemblance(engine, channels, queries)?.err();
        checked.push(KernelCheck { kernels: &["cosines", "fuse"], off });
    }
    Ok(checked)
}

/// Compares an optimiser step of rows and the sums of a view, of more numbers than are blended at once, with the host's
/// from the same gradients.
fn rows(engine: &GpuEngine, view: &dyn Projected) -> Result<Result<(), Mismatch>, RasterError> {
    const ROW: usize = 20;
    let random = &mut Random::new(6);
    let values: Vec<f32> = (0..ROW * SPLATS).map(|_| random.uniform() - 0.5).collect();
    let mut wanted = values.clone();
    let channels = Channels { count: ROW, values: &values };
    let mut on_device = RowSteps::upload(engine, &channels, WEIGHTS.rate)?;
    let mut adam = RowAdam::new(SPLATS, ROW, WEIGHTS.rate);
    for step in 0..4 {
        let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
        let mut grad = Image::zeros(width, height, ROW);
        // Not everywhere, and somewhere no number: there rows rest.
        for (i, v) in grad.data.iter_mut().enumerate() {
            *v = if (i % width + 20 * step) % width < width / 2 { random.uniform() - 0.5 } else { 0.0 };
        }
        if step == 2 {
            grad.data[width * height / 2] = f32::NAN;
        }
        let grads = view.gather(&grad)?;
        adam.step(&mut wanted, &grads);
        on_device.step(&grads)?;
    }
    let (mut sums, mut right) = (Lifting::new(SPLATS, ROW), Lifting::new(SPLATS, ROW));
    sums.allocate_on_device(engine)?;
    for step in 0..3 {
        let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
        let mut image = Image::zeros(width, height, ROW + 1);
        // Weights are such that some splats have none.
        for (i, v) in image.data.iter_mut().enumerate() {
            *v = if (i % width + 20 * step) % width < width / 2 { random.uniform() - 0.3 } else { 0.0 };
        }
        image.data[width * (height / 2) + step] = f32::NAN;
        right.add(view, &image)?;
        sums.add(view, &image)?;
    }
    let ((sums, weights), (right_sums, right_weights)) = (sums.finish()?, right.finish()?);
    Ok(Tolerance::PROJECTED
        .compare("rows", &on_device.download()?, &wanted)
        .and_then(|()| Tolerance::PROJECTED.compare("sums over views", &sums, &right_sums))
        .and_then(|()| Tolerance::PROJECTED.compare("weights", &weights, &right_weights)))
}

/// Compares the similarity of rows to some queries; some rows are 0 or not finite.
fn resemblance(
    engine: &GpuEngine,
    channels: usize,
    queries: usize,
) -> Result<Result<(), Mismatch>, RasterError> {
    let random = &mut Random::new(10);
    let mut many = |n: usize| (0..n).map(|_| random.uniform() - 0.5).collect::<Vec<f32>>();
    let mut values = many(channels * SPLATS);
    values[channels..2 * channels].fill(0.0);
    for (row, odd) in [(2, f32::NAN), (3, f32::INFINITY), (4, 1e30)] {
        values[row * channels + 1] = odd;
    }
    let unit = |v: Vec<f32>| {
        let length = dot(&v, &v).sqrt();
        v.iter().map(|v| v / length).collect()
    };
    let units: Vec<Vec<f32>> = (0..queries).map(|_| unit(many(channels))).collect();
    let queries = Queries { channels, units: &units, sharpness: 3.0 };
    let norms: Vec<f32> = values.chunks_exact(channels).map(|row| 1.0 / dot(row, row).sqrt()).collect();
    let norms: Vec<f32> = norms.iter().map(|&n| if n.is_finite() { n } else { 0.0 }).collect();
    let mut wanted = vec![0.0; SPLATS];
    score(&queries, &values, &norms, &mut wanted);
    let mut resident = ResidentChannels::new(channels, values);
    resident.upload(engine)?;
    let got = match resident.on_device() {
        Some(features) => engine.similarity(features, &queries)?,
        None => None,
    };
    Ok(got
        .ok_or(Mismatch::NotResident)
        .and_then(|got| Tolerance::PROJECTED.compare("similarity of rows to the queries", &got, &wanted)))
}

/// Compares losses and gradients of some images with the host's; some numbers of the images are not finite.
fn compared(
    case: &FeatureCase,
    engine: &GpuEngine,
    weights: FieldWeights,
    pairs: bool,
) -> Result<Result<(), Mismatch>, RasterError> {
    let random = &mut Random::new(7);
    let mut right = case.refinement(vec![0.0; case.channels], weights);
    let mut on_device = FieldGradients::upload(engine, &right)?;
    let mut same = Ok(());
    for step in 0..3 {
        let mut made = case.make(random);
        let (width, height) = (SIZE.0 as usize, SIZE.1 as usize);
        let mut image = case.image(random);
        if step == 1 {
            made.validity[5] = f32::NAN;
            for (plane, k) in image.data.chunks_exact_mut(width * height).zip(0..) {
                let odd = if k == 0 { [f32::NAN, f32::INFINITY, 0.0] } else { [1.0, 1.0, 0.0] };
                made.pixels.iter().zip(odd).for_each(|(&pixel, odd)| plane[pixel as usize] = odd);
            }
        }
        if !pairs {
            made.pixels.clear();
        }
        let wanted = right.compute_losses(&image, &made.feature_target(), &made.sampled_pixels());
        let got = on_device.of(&image, &made.feature_target(), &made.sampled_pixels())?;
        let (losses, found) = (right.losses()?, on_device.losses()?);
        let losses = [losses.embedding, losses.compact];
        same = same
            .and_then(|()| alike(Tolerance::GRADIENTS, "the image's gradients", &got.data, &wanted.data))
            .and_then(|()| alike(Tolerance::PROJECTED, "losses", &[found.embedding, found.compact], &losses));
    }
    let (got, wanted) = (on_device.download()?.decoder, right.finish()?.decoder);
    let (got, wanted) = (got.unwrap_or_default(), wanted.unwrap_or_default());
    Ok(same.and_then(|()| alike(Tolerance::GRADIENTS, "the decoder", &got, &wanted)))
}

/// Compares numbers that may be NaN, in both.
fn alike(tolerance: Tolerance, what: &str, got: &[f32], wanted: &[f32]) -> Result<(), Mismatch> {
    let odd = got.iter().zip(wanted).position(|(g, w)| g.is_finite() != w.is_finite());
    if let Some(index) = odd {
        return Err(Mismatch::Number { what: what.into(), index, got: got[index], wanted: wanted[index] });
    }
    let some = |numbers: &[f32]| numbers.iter().copied().filter(|v| v.is_finite()).collect::<Vec<_>>();
    tolerance.compare(what, &some(got), &some(wanted))
}

/// Compares features after some steps of refinement with the host's from the same views.
fn steps(engine: &GpuEngine, view: &dyn Projected) -> Result<Result<(), Mismatch>, RasterError> {
    let case =
        FeatureCase { size: SIZE, channels: 20, decoded: Some(30), grid: [24, 17], pixels: 200, masks: 12 };
    let random = &mut Random::new(9);
    let values: Vec<f32> = (0..case.channels * SPLATS).map(|_| random.uniform() - 0.5).collect();
    let (mut here, mut there) = (case.refinement(values.clone(), WEIGHTS), case.refinement(values, WEIGHTS));
    there.upload(engine)?;
    for _ in 0..3 {
        let made = case.make(random);
        here.step(view, &made.feature_target(), &made.sampled_pixels())?;
        there.step(view, &made.feature_target(), &made.sampled_pixels())?;
    }
    let (here, there) = (here.finish()?, there.finish()?);
    Ok(alike(Tolerance::GRADIENTS, "features", &there.values, &here.values))
}
