//! The photo's half of a training step on the device: the twin of [`segwild_objective::compare`], kernel by kernel.

use crate::GpuError;
use crate::device::{DeviceWork, PooledBuffer, lock};
use crate::groups::{GROUP, TILE};
use crate::memory::photo_cache_bytes;
use crate::nets::Visible;
use crate::shaders::{
    BOX_MEAN, CHOOSE_WEIGHTS, COLOUR_SUMS, COMPOSE, COMPOSE_BACKWARD, L1_SSIM_BACKWARD, PART_RESIDUALS,
    PIXEL_WEIGHTS, RESIDUAL_HISTOGRAM, RESIDUAL_LIMITS, SKY_SUMS, SSIM, SUM_GROUPS, VISIBILITY_WEIGHTS,
};
use bytemuck::{Pod, Zeroable};
use segwild_objective::background::{BASES, BackgroundSums, ColourSums, HOLD, STRIDE, SkySums};
use segwild_objective::compare::{
    ERROR_WINDOW, LeaveOut, LossInputs, LossOutput, PhotoTarget, left_out_share, psnr_of,
};
use segwild_objective::transients::{BINS, window};
use segwild_objective::{EmbedAppearance, EmbedLight};
use std::collections::HashMap;
use std::sync::{Arc, Mutex};

/// Layout of a step's results: [`BINS`] shares of residuals first.
const COUNTED: usize = BINS;
/// Pixels that count, the weight left of them, their squared errors, unused.
const WEIGHED: usize = COUNTED + 1;
/// Scores of SSIM, and differences after them, as the kernels sum them.
const SCORES: usize = WEIGHED + 4;
const DIFFERENCES: usize = SCORES + 1;
const MATRIX: usize = DIFFERENCES + 1;
const BACKGROUND: usize = MATRIX + 12;
/// `SKY_SUMS` of `sky_sums.wgsl`.
const SKY: usize = BASES * (BASES + 1) / 2 + 3 * BASES + 1;
pub(crate) const LIGHT: usize = BACKGROUND + SKY;
/// Pairs of a splat and a tile, and whether their buffers sufficed; whole numbers.
const PAIRS: usize = LIGHT + size_of::<EmbedLight>() / 4;
pub(crate) const LENGTH: usize = PAIRS + 2;

/// Derivatives of SSIM at a pixel: of each channel by its mean, mean square and mean product with the photo.
pub(crate) type SsimDerivatives = [f32; 9];

/// `LossInputs` of `shaders/shared/loss_inputs.wgsl`.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct LossUniform {
    matrix: [[f32; 4]; 3],
    background: [[f32; 4]; BASES],
    numbers: [f32; 4],
    modes: [u32; 4],
}

impl LossUniform {
    fn of(loss_inputs: &LossInputs, pixels: usize) -> LossUniform {
        let mut loss_uniform = LossUniform::zeroed();
        let matrix = loss_inputs.matrix.unwrap_or_default();
        loss_uniform.matrix = std::array::from_fn(|c| std::array::from_fn(|k| matrix[4 * c + k]));
        for (to, &[r, g, b]) in loss_uniform.background.iter_mut().zip(loss_inputs.background) {
            *to = [r, g, b, 0.0];
        }
        let (kind, share) = match loss_inputs.leave_out {
            LeaveOut::None => (0, 0.0),
            LeaveOut::InitialTransients => (1, 0.0),
            LeaveOut::Residual(known) => (2, known.share),
        };
        loss_uniform.numbers = [loss_inputs.lambda_ssim, loss_inputs.sky_weight / pixels as f32, share, 0.0];
        loss_uniform.modes =
            [loss_inputs.background.len() as u32, u32::from(loss_inputs.matrix.is_some()), kind, 0];
        loss_uniform
    }
}

/// A photo on the device.
pub(crate) struct GpuPhoto {
    pixels: PooledBuffer,
    trust: PooledBuffer,
    trusted: bool,
    size: [usize; 2],
}

impl GpuPhoto {
    pub fn upload(work: &mut DeviceWork, target: &PhotoTarget) -> Result<GpuPhoto, GpuError> {
        Ok(GpuPhoto {
            pixels: work.upload("the photo", &target.pixels)?,
            trust: work.upload("where the photo is trusted", &target.trust)?,
            trusted: !target.trust.is_empty(),
            size: [target.width, target.height],
        })
    }

    fn bytes(&self) -> u64 {
        let [width, height] = self.size;
        (width * height) as u64 * if self.trusted { 8 } else { 4 }
    }
}

/// Photos that stay on the device, the least recently used dropped first, and how many pairs their views had.
#[derive(Default)]
pub(crate) struct GpuPhotoCache(Mutex<CachedPhotos>);

#[derive(Default)]
struct CachedPhotos {
    photos: HashMap<[u64; 3], CachedPhoto>,
    bytes: u64,
    clock: u64,
}

impl CachedPhotos {
    /// Drops the least recently used until the others have so many bytes at the most.
    fn keep_within(&mut self, bytes: u64) {
        while self.bytes > bytes
            && let Some(oldest) = self.photos.iter().min_by_key(|(_, kept)| kept.used).map(|(&key, _)| key)
            && let Some(dropped) = self.photos.remove(&oldest)
        {
            self.bytes -= dropped.photo.bytes();
        }
    }
}

struct CachedPhoto {
    photo: Arc<GpuPhoto>,
    used: u64,
    /// Pairs of a splat and a tile at the last visit, and the splats that there were.
    pairs: Option<(usize, usize)>,
}

impl GpuPhotoCache {
    /// A photo, uploaded unless it is on the device, and the capacity for the pairs of its view, if they are known.
    pub fn take(
        &self,
        work: &mut DeviceWork,
        key: [u64; 3],
        target: &dyn Fn() -> PhotoTarget,
        splats: usize,
    ) -> Result<(Arc<GpuPhoto>, Option<usize>), GpuError> {
        let mut cache = lock(&self.0);
        cache.clock += 1;
        let used = cache.clock;
        if let Some(kept) = cache.photos.get_mut(&key) {
            kept.used = used;
            // A view's pairs grow with the splats; a quarter and a few more, for what else changes.
            let capacity = kept.pairs.map(|(pairs, then)| {
                let now = pairs as u64 * splats as u64 / then.max(1) as u64;
                (now + now / 4) as usize + 4096
            });
            return Ok((Arc::clone(&kept.photo), capacity));
        }
        let photo = Arc::new(GpuPhoto::upload(work, &target())?);
        cache.bytes += photo.bytes();
        cache.keep_within(photo_cache_bytes(work.budget()));
        cache.photos.insert(key, CachedPhoto { photo: Arc::clone(&photo), used, pairs: None });
        Ok((photo, None))
    }

    /// Frees the memory of all photos.
    pub fn clear(&self) {
        lock(&self.0).keep_within(0);
    }

    /// Notes how many pairs a photo's view had.
    pub fn note(&self, key: [u64; 3], pairs: usize, splats: usize) {
        if let Some(kept) = lock(&self.0).photos.get_mut(&key) {
            kept.pairs = Some((pairs, splats));
        }
    }
}

/// Inputs of the losses beside image and photo, uploaded before the first kernel runs.
pub(crate) struct ComparisonInputs {
    loss_uniform: PooledBuffer,
    before: PooledBuffer,
    /// The results, [`LENGTH`] numbers.
    pub results: PooledBuffer,
}

impl ComparisonInputs {
    pub fn upload(work: &mut DeviceWork, loss_inputs: &LossInputs) -> Result<ComparisonInputs, GpuError> {
        let pixels = loss_inputs.camera.width as usize * loss_inputs.camera.height as usize;
        let before = match loss_inputs.leave_out {
            LeaveOut::Residual(known) => known.before,
            LeaveOut::None | LeaveOut::InitialTransients => &[],
        };
        Ok(ComparisonInputs {
            loss_uniform: work.upload("the inputs of the losses", &[LossUniform::of(loss_inputs, pixels)])?,
            before: work.upload("the photo's residuals", before)?,
            results: results_buffer(work)?,
        })
    }
}

/// Buffer for the results of a step.
pub(crate) fn results_buffer(work: &mut DeviceWork) -> Result<PooledBuffer, GpuError> {
    work.take::<f32>("the results of a step", LENGTH)
}

/// Output of the losses on the device, for the backward pass and for checks of the steps in between.
pub(crate) struct LossBuffers {
    /// In the photo's colours, and the residual.
    pub shown: PooledBuffer,
    pub smoothed: PooledBuffer,
    pub weights: PooledBuffer,
    /// Gradients of colour and alpha.
    pub grads: PooledBuffer,
    /// Mean error around each pixel.
    pub error: PooledBuffer,
    /// What the visibility map learns from, where it was requested.
    pub part_residuals: Option<PooledBuffer>,
}

/// Computes the losses of a rendered image, colour and alpha, against its photo.
pub(crate) fn compare(
    work: &mut DeviceWork,
    view: &PooledBuffer,
    image: &PooledBuffer,
    photo: &GpuPhoto,
    inputs: &ComparisonInputs,
    loss_inputs: &LossInputs,
    visible: Option<&Visible>,
) -> Result<LossBuffers, GpuError> {
    let [width, height] = photo.size;
    assert_eq!(
        [loss_inputs.camera.width as usize, loss_inputs.camera.height as usize],
        photo.size,
        "target: size"
    );
    let n = width * height;
    let groups = n.div_ceil(GROUP);
    let ComparisonInputs { loss_uniform, before, results } = inputs;
    let pixels = &photo.pixels;
    let shown = work.take::<[f32; 4]>("the shown colours", n)?;
    let uncertain = work.take::<f32>("the residuals", n)?;
    let job = [n as u32, u32::from(photo.trusted), 0, 0];
    let buffers = [view, loss_uniform, image, pixels, &photo.trust, &shown, &uncertain];
    work.run(&COMPOSE, 1, job, &buffers, groups);
    let limits = work.take::<[f32; 4]>("the limits of residuals", 1)?;
    let mut smoothed = uncertain;
    if let LeaveOut::Residual(known) = loss_inputs.leave_out {
        smoothed = box_mean(work, &smoothed, photo.size, window(width, height))?;
        let counts = work.take::<u32>("counts of residuals", BINS)?;
        work.clear(&counts);
        work.run(&RESIDUAL_HISTOGRAM, 1, [n as u32, 0, 0, 0], &[pixels, &smoothed, &counts], groups);
        let job = [u32::from(!known.before.is_empty()), 0, 0, 0];
        work.run(&RESIDUAL_LIMITS, 1, job, &[loss_uniform, &counts, before, &limits, results], 1);
    }
    let weights = work.take::<f32>("the pixels' weights", n)?;
    let counted = work.take::<f32>("the residuals that count", n)?;
    let parts = work.take::<[f32; 4]>("sums of the residuals", groups)?;
    let job = [width as u32, height as u32, 0, 0];
    let buffers = [loss_uniform, pixels, &smoothed, &limits, &shown, &weights, &counted, &parts];
    work.run(&PIXEL_WEIGHTS, 1, job, &buffers, groups);
    let mut part_residuals = None;
    if let (Some(visible), LeaveOut::Residual(_)) = (visible, loss_inputs.leave_out) {
        part_residuals = Some(self::part_residuals(work, photo, &smoothed, &limits, visible)?);
        if visible.decides {
            let seen = work.take::<f32>("the visibility weights", n)?;
            let left_out = work.take::<f32>("the share left out", 4)?;
            let packed = |[width, height]: [usize; 2]| (width | height << 16) as u32;
            let job = [packed(photo.size), packed(visible.size), visible.position as u32, 0];
            work.run(&VISIBILITY_WEIGHTS, 1, job, &[pixels, visible.maps, &weights, &seen, &parts], groups);
            sum_groups(work, &parts, groups, 4, &left_out, 0);
            let buffers = [loss_uniform, pixels, &seen, &left_out, &shown, &weights, &counted, &parts];
            work.run(&CHOOSE_WEIGHTS, 1, [n as u32, 0, 0, 0], &buffers, groups);
        }
    }
    sum_groups(work, &parts, groups, 4, results, WEIGHED);
    let error = box_mean(work, &counted, photo.size, ERROR_WINDOW)?;
    drop(counted);

    let by_shown = work.take::<f32>("the gradients of the shown colours", 3 * n)?;
    let ssim_derivatives = work.take::<SsimDerivatives>("derivatives of SSIM", n)?;
    let tiles = width.div_ceil(TILE as usize) * height.div_ceil(TILE as usize);
    let losses = work.take::<[f32; 2]>("scores of SSIM, and differences", 3 * tiles)?;
    let job = [tiles as u32, n as u32, 0, 0];
    work.run(&SSIM, 1, job, &[view, &shown, pixels, &weights, &ssim_derivatives, &losses], 3 * tiles);
    let buffers = [view, loss_uniform, &shown, pixels, &weights, &ssim_derivatives, &by_shown, &losses];
    work.run(&L1_SSIM_BACKWARD, 1, job, &buffers, 3 * tiles);
    sum_groups(work, &losses, 3 * tiles, 2, results, SCORES);

    let grads = work.take::<[f32; 4]>("the image's gradients", n)?;
    let parts = work.take::<[f32; 12]>("sums for the matrix", groups)?;
    let buffers = [view, loss_uniform, image, pixels, &by_shown, &grads, &parts];
    work.run(&COMPOSE_BACKWARD, 1, [n as u32, 0, 0, 0], &buffers, groups);
    if loss_inputs.matrix.is_some() {
        sum_groups(work, &parts, groups, 12, results, MATRIX);
    }
    if loss_inputs.has_sky {
        let (across, down) = (width.div_ceil(STRIDE), height.div_ceil(STRIDE));
        let groups = (across * down).div_ceil(GROUP);
        let parts = work.take::<[f32; SKY]>("sums for the sky", groups)?;
        let job = [(across * down) as u32, across as u32, 0, 0];
        work.run(&SKY_SUMS, 1, job, &[view, image, pixels, &weights, &parts], groups);
        sum_groups(work, &parts, groups, SKY, results, BACKGROUND);
    } else {
        let parts = work.take::<[f32; 4]>("sums for the background", groups)?;
        let buffers = [image, pixels, &shown, &weights, &parts];
        work.run(&COLOUR_SUMS, 1, [n as u32, 0, 0, 0], &buffers, groups);
        sum_groups(work, &parts, groups, 4, results, BACKGROUND);
    }
    Ok(LossBuffers { shown, smoothed, weights, grads, error, part_residuals })
}

/// Mean residual of each part of a photo, relative to the limit for transients.
fn part_residuals(
    work: &mut DeviceWork,
    photo: &GpuPhoto,
    smoothed: &PooledBuffer,
    limits: &PooledBuffer,
    visible: &Visible,
) -> Result<PooledBuffer, GpuError> {
    let ([width, height], [across, down]) = (photo.size, visible.size);
    let part_residuals = work.take::<f32>("the residuals of parts of the photo", across * down)?;
    let job = [width, height, across, down].map(|n| n as u32);
    work.run(
        &PART_RESIDUALS,
        1,
        job,
        &[&photo.pixels, smoothed, limits, &part_residuals],
        (across * down).div_ceil(GROUP),
    );
    Ok(part_residuals)
}

/// Mean of each pixel over a square window of half width `r`.
pub(crate) fn box_mean(
    work: &mut DeviceWork,
    values: &PooledBuffer,
    [width, height]: [usize; 2],
    r: usize,
) -> Result<PooledBuffer, GpuError> {
    let rows = work.take::<f32>("means along rows", width * height)?;
    let means = work.take::<f32>("means over windows", width * height)?;
    let job = |axis: u32| [width as u32, height as u32, r as u32, axis];
    work.run(&BOX_MEAN, 1, job(0), &[values, &rows], (width * height).div_ceil(GROUP));
    work.run(&BOX_MEAN, 1, job(1), &[&rows, &means], (width * height).div_ceil(GROUP));
    Ok(means)
}

/// Adds up the partial sums of groups, `columns` numbers each, into the results.
pub(crate) fn sum_groups(
    work: &mut DeviceWork,
    parts: &PooledBuffer,
    groups: usize,
    columns: usize,
    results: &PooledBuffer,
    at: usize,
) {
    work.run(&SUM_GROUPS, 1, [groups as u32, columns as u32, at as u32, 0], &[parts, results], columns);
}

/// Results of a step on the host.
pub(crate) struct StepReadback(Vec<f32>);

impl StepReadback {
    /// Downloads them; `found` are the pairs of [`crate::engine::Binned`].
    pub fn read(
        work: &mut DeviceWork,
        results: &PooledBuffer,
        found: &PooledBuffer,
    ) -> Result<StepReadback, GpuError> {
        work.copy_to(found, results, PAIRS * 4, 8);
        Ok(StepReadback(work.read(results, LENGTH)?))
    }

    /// Pairs of a splat and a tile, and whether their buffers sufficed.
    pub fn pairs(&self) -> (usize, bool) {
        (self.0[PAIRS].to_bits() as usize, self.0[PAIRS + 1].to_bits() == 1)
    }

    /// Gradient of a photo's parameters.
    pub fn light(&self) -> EmbedLight {
        const _: () = assert!(size_of::<EmbedLight>() == 4 * (12 + EmbedAppearance::EMBEDDING_SIZE));
        std::array::from_fn(|k| self.0[LIGHT + k])
    }

    /// The loss output.
    pub fn results(&self, loss_inputs: &LossInputs) -> LossOutput {
        let at = |k: usize| f64::from(self.0[k]);
        let (width, height) = (loss_inputs.camera.width as usize, loss_inputs.camera.height as usize);
        let count = (3 * width * height) as f64;
        let lambda = f64::from(loss_inputs.lambda_ssim);
        let loss = (1.0 - lambda) * at(DIFFERENCES) / count + lambda * (1.0 - at(SCORES) / count);
        let requested = matches!(loss_inputs.leave_out, LeaveOut::Residual(_)) && self.0[COUNTED] > 0.0;
        let background = if loss_inputs.has_sky {
            let mut sums = SkySums {
                total: at(BACKGROUND + SKY - 1),
                looked: (width.div_ceil(STRIDE) * height.div_ceil(STRIDE)) as f64,
                ..SkySums::default()
            };
            let mut k = BACKGROUND;
            for i in 0..BASES {
                for j in 0..=i {
                    sums.products[i][j] = at(k);
                    k += 1;
                }
            }
            for colours in sums.colours.iter_mut().flatten() {
                *colours = at(k);
                k += 1;
            }
            BackgroundSums::Sky(Box::new(sums))
        } else {
            let pull = [0, 1, 2].map(|c| self.0[BACKGROUND + c]);
            let total = self.0[BACKGROUND + 3] + HOLD * (width * height) as f32;
            BackgroundSums::Colour(ColourSums { pull, total })
        };
        LossOutput {
            loss: loss as f32,
            psnr: psnr_of(at(WEIGHED + 2), at(WEIGHED + 1)),
            left_out: left_out_share(self.0[WEIGHED], self.0[WEIGHED + 1]),
            residuals: requested.then(|| self.0[..BINS].to_vec()),
            matrix: loss_inputs.matrix.map(|_| std::array::from_fn(|k| self.0[MATRIX + k])),
            background,
        }
    }
}
