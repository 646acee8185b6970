//! The photo's half of a step of training where the image is: what [`segwild_raster::compare`] does, kernel by kernel.

use crate::GpuError;
use crate::device::{Lent, Work, lock};
use crate::engine::{GROUP, TILE};
use crate::memory::photos_kept;
use crate::nets::Visible;
use crate::shaders::{
    BLAME, BOX_MEAN, COLOUR_SUMS, COMPOSE, GRADE, LIMITS, PREFER, SEE, SKY_SUMS, SLOPE, STRUCTURE, TALLY,
    TOTAL, WEIGH,
};
use bytemuck::{Pod, Zeroable};
use segwild_raster::compare::{
    BASES, BINS, ColourSums, ERROR_WINDOW, HOLD, LeaveOut, LossInputs, LossOutput, STRIDE, Seen, SkySums,
    Target, left_out_share, psnr_of, window,
};
use segwild_raster::{EmbedAppearance, Light};
use std::collections::HashMap;
use std::sync::{Arc, Mutex};

/// Where a step's numbers lie in what comes back of it: [`BINS`] shares of residuals first.
const COUNTED: usize = BINS;
/// Pixels that count, what is left of them, squares of what they lack, unused.
const WEIGHED: usize = COUNTED + 1;
const SCORES: usize = WEIGHED + 4;
const DIFFERENCES: usize = SCORES + 1;
const MATRIX: usize = DIFFERENCES + 1;
const BACKGROUND: usize = MATRIX + 12;
/// `SKY_SUMS` of `sky_sums.wgsl`.
const SKY: usize = BASES * (BASES + 1) / 2 + 3 * BASES + 1;
pub(crate) const LIGHT: usize = BACKGROUND + SKY;
/// Pairs of a splat and a tile, and whether there was room for them; whole numbers.
const PAIRS: usize = LIGHT + size_of::<Light>() / 4;
pub(crate) const LENGTH: usize = PAIRS + 2;

/// `LossInputs` of `shaders/shared/loss_inputs.wgsl`.
#[derive(Clone, Copy, Pod, Zeroable)]
#[repr(C)]
struct Sheet {
    matrix: [[f32; 4]; 3],
    background: [[f32; 4]; BASES],
    numbers: [f32; 4],
    modes: [u32; 4],
}

impl Sheet {
    fn of(loss_inputs: &LossInputs, pixels: usize) -> Sheet {
        let mut sheet = Sheet::zeroed();
        let matrix = loss_inputs.matrix.unwrap_or_default();
        sheet.matrix = std::array::from_fn(|c| std::array::from_fn(|k| matrix[4 * c + k]));
        for (to, &[r, g, b]) in sheet.background.iter_mut().zip(loss_inputs.background) {
            *to = [r, g, b, 0.0];
        }
        let (kind, share) = match loss_inputs.leave_out {
            LeaveOut::None => (0, 0.0),
            LeaveOut::InitialTransients => (1, 0.0),
            LeaveOut::Residual(known) => (2, known.share),
        };
        sheet.numbers = [loss_inputs.lambda_ssim, loss_inputs.sky_weight / pixels as f32, share, 0.0];
        sheet.modes = [loss_inputs.background.len() as u32, u32::from(loss_inputs.matrix.is_some()), kind, 0];
        sheet
    }
}

/// A photo on the device.
pub(crate) struct Photo {
    pixels: Lent,
    trust: Lent,
    trusted: bool,
    size: [usize; 2],
}

impl Photo {
    pub fn upload(work: &mut Work, target: &Target) -> Result<Photo, GpuError> {
        Ok(Photo {
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
pub(crate) struct PhotoCache(Mutex<Held>);

#[derive(Default)]
struct Held {
    photos: HashMap<[u64; 3], Kept>,
    bytes: u64,
    clock: u64,
}

impl Held {
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

struct Kept {
    photo: Arc<Photo>,
    used: u64,
    /// Pairs of a splat and a tile at the last visit, and the splats that there were.
    pairs: Option<(usize, usize)>,
}

impl PhotoCache {
    /// A photo, brought to the device unless it is there, and room for the pairs of its view, if they are known about.
    pub fn take(
        &self,
        work: &mut Work,
        key: [u64; 3],
        target: &dyn Fn() -> Target,
        splats: usize,
    ) -> Result<(Arc<Photo>, Option<usize>), GpuError> {
        let mut held = lock(&self.0);
        held.clock += 1;
        let used = held.clock;
        if let Some(kept) = held.photos.get_mut(&key) {
            kept.used = used;
            // A view's pairs grow with the splats; a quarter and a few more, for what else changes.
            let capacity = kept.pairs.map(|(pairs, then)| {
                let now = pairs as u64 * splats as u64 / then.max(1) as u64;
                (now + now / 4) as usize + 4096
            });
            return Ok((Arc::clone(&kept.photo), capacity));
        }
        let photo = Arc::new(Photo::upload(work, &target())?);
        held.bytes += photo.bytes();
        held.keep_within(photos_kept(work.budget()));
        held.photos.insert(key, Kept { photo: Arc::clone(&photo), used, pairs: None });
        Ok((photo, None))
    }

    /// Gives all room back.
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

/// What a comparison needs beside image and photo, brought to the device before anything is inputs of it.
pub(crate) struct ComparisonInputs {
    sheet: Lent,
    before: Lent,
    /// What comes back, [`LENGTH`] numbers.
    pub results: Lent,
}

impl ComparisonInputs {
    pub fn upload(work: &mut Work, loss_inputs: &LossInputs) -> Result<ComparisonInputs, GpuError> {
        let pixels = loss_inputs.camera.width as usize * loss_inputs.camera.height as usize;
        let before = match loss_inputs.leave_out {
            LeaveOut::Residual(known) => known.before,
            LeaveOut::None | LeaveOut::InitialTransients => &[],
        };
        Ok(ComparisonInputs {
            sheet: work.upload("what a photo is compared under", &[Sheet::of(loss_inputs, pixels)])?,
            before: work.upload("the photo's residuals", before)?,
            results: results_buffer(work)?,
        })
    }
}

/// Room for what comes back of a step.
pub(crate) fn results_buffer(work: &mut Work) -> Result<Lent, GpuError> {
    work.take::<f32>("what the photo said", LENGTH)
}

/// A photo compared on the device; for the gradient's way back, and for whoever looks at the steps in between.
pub(crate) struct Graded {
    /// In the photo's colours, and the residual.
    pub shown: Lent,
    pub smoothed: Lent,
    pub weights: Lent,
    /// Gradients of colour and alpha.
    pub grads: Lent,
    /// Mean error around each pixel.
    pub error: Lent,
    /// What the visibility map is to learn from, where that was inputs.
    pub blames: Option<Lent>,
}

/// Compares a photo with an image, colour and alpha, that was drawn of the view.
pub(crate) fn compare(
    work: &mut Work,
    view: &Lent,
    image: &Lent,
    photo: &Photo,
    inputs: &ComparisonInputs,
    loss_inputs: &LossInputs,
    visible: Option<&Visible>,
) -> Result<Graded, GpuError> {
    let [width, height] = photo.size;
    assert_eq!(
        [loss_inputs.camera.width as usize, loss_inputs.camera.height as usize],
        photo.size,
        "target: size"
    );
    let n = width * height;
    let groups = n.div_ceil(GROUP);
    let ComparisonInputs { sheet, before, results } = inputs;
    let pixels = &photo.pixels;
    let shown = work.take::<[f32; 4]>("what is shown", n)?;
    let uncertain = work.take::<f32>("the residuals", n)?;
    let job = [n as u32, u32::from(photo.trusted), 0, 0];
    let buffers = [view, sheet, image, pixels, &photo.trust, &shown, &uncertain];
    work.run(&COMPOSE, 1, job, &buffers, groups);
    let limits = work.take::<[f32; 4]>("the limits of residuals", 1)?;
    let mut smoothed = uncertain;
    if let LeaveOut::Residual(known) = loss_inputs.leave_out {
        smoothed = box_mean(work, &smoothed, photo.size, window(width, height))?;
        let counts = work.take::<u32>("counts of residuals", BINS)?;
        work.clear(&counts);
        work.run(&TALLY, 1, [n as u32, 0, 0, 0], &[pixels, &smoothed, &counts], groups);
        let job = [u32::from(!known.before.is_empty()), 0, 0, 0];
        work.run(&LIMITS, 1, job, &[sheet, &counts, before, &limits, results], 1);
    }
    let weights = work.take::<f32>("the pixels' weights", n)?;
    let counted = work.take::<f32>("the residuals that count", n)?;
    let parts = work.take::<[f32; 4]>("sums of the residuals", groups)?;
    let job = [width as u32, height as u32, 0, 0];
    let buffers = [sheet, pixels, &smoothed, &limits, &shown, &weights, &counted, &parts];
    work.run(&WEIGH, 1, job, &buffers, groups);
    let mut blames = None;
    if let (Some(visible), LeaveOut::Residual(_)) = (visible, loss_inputs.leave_out) {
        blames = Some(blame(work, photo, &smoothed, &limits, visible)?);
        if visible.decides {
            let seen = work.take::<f32>("what the network sees", n)?;
            let left_out = work.take::<f32>("what it leaves out", 4)?;
            let packed = |[width, height]: [usize; 2]| (width | height << 16) as u32;
            let job = [packed(photo.size), packed(visible.size), visible.position as u32, 0];
            work.run(&SEE, 1, job, &[pixels, visible.maps, &weights, &seen, &parts], groups);
            total(work, &parts, groups, 4, &left_out, 0);
            let buffers = [sheet, pixels, &seen, &left_out, &shown, &weights, &counted, &parts];
            work.run(&PREFER, 1, [n as u32, 0, 0, 0], &buffers, groups);
        }
    }
    total(work, &parts, groups, 4, results, WEIGHED);
    let error = box_mean(work, &counted, photo.size, ERROR_WINDOW)?;
    drop(counted);

    let by_shown = work.take::<f32>("the gradients of what is shown", 3 * n)?;
    let slopes = work.take::<[f32; 4]>("slopes of the likeness", n)?;
    let tiles = width.div_ceil(TILE as usize) * height.div_ceil(TILE as usize);
    let scores = work.take::<f32>("scores of likeness", 3 * tiles)?;
    let differences = work.take::<f32>("sums of differences", 3 * tiles)?;
    for channel in 0..3 {
        let job = [tiles as u32, channel, n as u32, 0];
        work.run(&STRUCTURE, 1, job, &[view, &shown, pixels, &weights, &slopes, &scores], tiles);
        let buffers = [view, sheet, &shown, pixels, &weights, &slopes, &by_shown, &differences];
        work.run(&SLOPE, 1, job, &buffers, tiles);
    }
    total(work, &scores, 3 * tiles, 1, results, SCORES);
    total(work, &differences, 3 * tiles, 1, results, DIFFERENCES);

    let grads = work.take::<[f32; 4]>("the image's gradients", n)?;
    let parts = work.take::<[f32; 12]>("sums for the matrix", groups)?;
    let buffers = [view, sheet, image, pixels, &by_shown, &grads, &parts];
    work.run(&GRADE, 1, [n as u32, 0, 0, 0], &buffers, groups);
    if loss_inputs.matrix.is_some() {
        total(work, &parts, groups, 12, results, MATRIX);
    }
    if loss_inputs.has_sky {
        let (across, down) = (width.div_ceil(STRIDE), height.div_ceil(STRIDE));
        let groups = (across * down).div_ceil(GROUP);
        let parts = work.take::<[f32; SKY]>("sums for the sky", groups)?;
        let job = [(across * down) as u32, across as u32, 0, 0];
        work.run(&SKY_SUMS, 1, job, &[view, image, pixels, &weights, &parts], groups);
        total(work, &parts, groups, SKY, results, BACKGROUND);
    } else {
        let parts = work.take::<[f32; 4]>("sums for what is behind", groups)?;
        let buffers = [image, pixels, &shown, &weights, &parts];
        work.run(&COLOUR_SUMS, 1, [n as u32, 0, 0, 0], &buffers, groups);
        total(work, &parts, groups, 4, results, BACKGROUND);
    }
    Ok(Graded { shown, smoothed, weights, grads, error, blames })
}

/// What each part of a photo is blamed for.
fn blame(
    work: &mut Work,
    photo: &Photo,
    smoothed: &Lent,
    limits: &Lent,
    visible: &Visible,
) -> Result<Lent, GpuError> {
    let ([width, height], [across, down]) = (photo.size, visible.size);
    let blames = work.take::<f32>("what parts of the photo are blamed for", across * down)?;
    let job = [width, height, across, down].map(|n| n as u32);
    work.run(&BLAME, 1, job, &[&photo.pixels, smoothed, limits, &blames], (across * down).div_ceil(GROUP));
    Ok(blames)
}

/// Mean of each pixel over a square window of half width `r`.
pub(crate) fn box_mean(
    work: &mut Work,
    values: &Lent,
    [width, height]: [usize; 2],
    r: usize,
) -> Result<Lent, GpuError> {
    let rows = work.take::<f32>("means along rows", width * height)?;
    let means = work.take::<f32>("means over windows", width * height)?;
    let job = |axis: u32| [width as u32, height as u32, r as u32, axis];
    work.run(&BOX_MEAN, 1, job(0), &[values, &rows], (width * height).div_ceil(GROUP));
    work.run(&BOX_MEAN, 1, job(1), &[&rows, &means], (width * height).div_ceil(GROUP));
    Ok(means)
}

/// Adds up what groups left, `columns` numbers each, into what comes back.
pub(crate) fn total(work: &mut Work, parts: &Lent, groups: usize, columns: usize, results: &Lent, at: usize) {
    work.run(&TOTAL, 1, [groups as u32, columns as u32, at as u32, 0], &[parts, results], columns);
}

/// What came back of a step.
pub(crate) struct StepReadback(Vec<f32>);

impl StepReadback {
    /// Reads it; `found` are the pairs of [`crate::engine::Binned`].
    pub fn read(work: &mut Work, results: &Lent, found: &Lent) -> Result<StepReadback, GpuError> {
        work.copy_to(found, results, PAIRS * 4, 8);
        Ok(StepReadback(work.read(results, LENGTH)?))
    }

    /// Pairs of a splat and a tile, and whether there was room for them.
    pub fn pairs(&self) -> (usize, bool) {
        (self.0[PAIRS].to_bits() as usize, self.0[PAIRS + 1].to_bits() == 1)
    }

    /// Gradient of a photo's light.
    pub fn light(&self) -> Light {
        const _: () = assert!(size_of::<Light>() == 4 * (12 + EmbedAppearance::EMBEDDING_SIZE));
        std::array::from_fn(|k| self.0[LIGHT + k])
    }

    /// What the photo said.
    pub fn results(&self, loss_inputs: &LossInputs) -> LossOutput {
        let at = |k: usize| f64::from(self.0[k]);
        let (width, height) = (loss_inputs.camera.width as usize, loss_inputs.camera.height as usize);
        let count = (3 * width * height) as f64;
        let lambda = f64::from(loss_inputs.lambda_ssim);
        let loss = (1.0 - lambda) * at(DIFFERENCES) / count + lambda * (1.0 - at(SCORES) / count);
        let inputs = matches!(loss_inputs.leave_out, LeaveOut::Residual(_)) && self.0[COUNTED] > 0.0;
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
            Seen::Sky(Box::new(sums))
        } else {
            let pull = [0, 1, 2].map(|c| self.0[BACKGROUND + c]);
            let total = self.0[BACKGROUND + 3] + HOLD * (width * height) as f32;
            Seen::Colour(ColourSums { pull, total })
        };
        LossOutput {
            loss: loss as f32,
            psnr: psnr_of(at(WEIGHED + 2), at(WEIGHED + 1)),
            left_out: left_out_share(self.0[WEIGHED], self.0[WEIGHED + 1]),
            residuals: inputs.then(|| self.0[..BINS].to_vec()),
            matrix: loss_inputs.matrix.map(|_| std::array::from_fn(|k| self.0[MATRIX + k])),
            background,
        }
    }
}
