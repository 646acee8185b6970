//! Photometric loss and image metrics (method, sections 2 and 10).
//!
//! `L = (1 - lambda) mean |W r - W t| + lambda (1 - mean SSIM(W r, W t))` with an optional weight W per pixel that
//! multiplies both images, as the paper's visibility map does: where W is 0 a pixel has no influence. SSIM has the
//! usual 11-tap Gaussian window of sigma 1.5, zero beyond the frame, constants 0.01² and 0.03².
//!
//! Loss and gradient come from one sweep of three phases, each parallel over rows: blur along rows; blur along
//! columns, SSIM and its derivatives, blur those along rows; blur them along columns and gather the gradient. The
//! two variances only enter as their sum, so four maps go forward and three come back.

use rayon::prelude::*;
use segwild_raster::simd::{self, Isa, LANES, Simd, SimdKernel};
use segwild_scene::Image;
use std::cell::RefCell;

/// Taps on either side of the middle.
const REACH: usize = 5;
/// The window from its middle outwards: exp(-k² / 4.5), normalised over eleven taps.
const WINDOW: [f32; REACH + 1] =
    [0.266_011_72, 0.213_005_53, 0.109_360_69, 0.036_000_77, 0.007_598_76, 0.001_028_38];
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Blurred maps: the two means, the sum of squares, the product.
const MAPS: usize = 4;
/// Derivatives of SSIM: by the render's mean, the sum of squares, the product.
const BACK: usize = 3;

/// Loss and its gradient with respect to the render.
///
/// `weight` is one plane that multiplies both images; `lambda_ssim` in 0..1 shares the loss between L1 and
/// SSIM (0.2 in the paper). The mean is over all pixels and channels, weighted or not.
///
/// # Panics
/// If the sizes differ.
pub fn photometric(render: &Image, target: &Image, weight: Option<&Image>, lambda_ssim: f32) -> (f32, Image) {
    let mut grad = Image::zeros(render.width, render.height, render.channels);
    let sums = sweep(Isa::detect_once(), render, target, weight, lambda_ssim, Some(&mut grad));
    let count = (render.data.len().max(1)) as f64;
    let lambda = f64::from(lambda_ssim);
    let loss = (1.0 - lambda) * sums.difference / count + lambda * (1.0 - sums.ssim / count);
    (loss as f32, grad)
}

/// Mean structural similarity; only pixels with `mask` above 1/2 count. 1 where no pixel counts.
///
/// The window sees the whole images, so what lies beyond the mask has an influence within five pixels of it.
///
/// # Panics
/// If the sizes differ.
pub fn ssim(render: &Image, target: &Image, mask: Option<&Image>) -> f32 {
    let Some(mask) = mask else {
        let sums = sweep(Isa::detect_once(), render, target, None, 1.0, None);
        return if render.data.is_empty() { 1.0 } else { (sums.ssim / render.data.len() as f64) as f32 };
    };
    same_size(render, target, Some(mask));
    let mut scores = Image::zeros(render.width, render.height, render.channels);
    score_map(render, target, &mut scores);
    let (mut sum, mut count) = (0.0, 0usize);
    for (k, score) in scores.data.iter().enumerate() {
        if mask.data[k % mask.data.len()] > 0.5 {
            sum += f64::from(*score);
            count += 1;
        }
    }
    if count == 0 { 1.0 } else { (sum / count as f64) as f32 }
}

/// Peak signal-to-noise ratio in dB for values in 0..1; only pixels with `mask` above 1/2 count. Infinite for
/// equal images and where no pixel counts, NaN where one that counts is NaN.
///
/// It is what reports show. A training follows [`crate::compare::weighted_psnr`], which is bounded and 0 where no pixel counts.
///
/// # Panics
/// If the sizes differ.
pub fn psnr(render: &Image, target: &Image, mask: Option<&Image>) -> f32 {
    same_size(render, target, mask);
    let (mut sum, mut count) = (0.0, 0usize);
    for (k, (r, t)) in render.data.iter().zip(&target.data).enumerate() {
        if mask.is_none_or(|mask| mask.data[k % mask.data.len()] > 0.5) {
            sum += f64::from(r - t).powi(2);
            count += 1;
        }
    }
    if sum == 0.0 { f32::INFINITY } else { (-10.0 * (sum / count as f64).log10()) as f32 }
}

fn same_size(render: &Image, target: &Image, weight: Option<&Image>) {
    let size = |image: &Image| (image.width, image.height);
    assert_eq!((size(render), render.channels), (size(target), target.channels), "render and target: size");
    assert_eq!(render.data.len(), target.data.len(), "render and target: numbers");
    if let Some(weight) = weight {
        assert_eq!((size(weight), weight.data.len()), (size(render), render.pixels()), "weight: size");
    }
}

#[derive(Clone, Copy, Default)]
struct LossSums {
    difference: f64,
    ssim: f64,
}

thread_local! {
    /// Maps of the last call, to be used again.
    static MEMORY: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// One plane's geometry: rows are padded to whole vectors.
#[derive(Clone, Copy)]
struct PaddedLayout {
    width: usize,
    height: usize,
    stride: usize,
}

/// Working rows of one task, padded for the window on both sides.
#[derive(Default)]
struct RowMemory {
    x: Vec<f32>,
    y: Vec<f32>,
    work: Vec<f32>,
}

/// Zeros before the first pixel of a working row.
const PAD: usize = LANES;

impl PaddedLayout {
    fn of(image: &Image) -> PaddedLayout {
        PaddedLayout { width: image.width, height: image.height, stride: image.width.next_multiple_of(LANES) }
    }

    fn padded(&self) -> usize {
        self.stride + 2 * PAD
    }
}

/// Copies a row, times the weight, between zeros.
fn load_row(into: &mut Vec<f32>, layout: &PaddedLayout, row: &[f32], weight: Option<&[f32]>) {
    into.clear();
    into.resize(PAD, 0.0);
    match weight {
        Some(weight) => into.extend(row.iter().zip(weight).map(|(v, w)| v * w)),
        None => into.extend_from_slice(row),
    }
    into.resize(layout.padded(), 0.0);
}

#[inline(always)]
fn at<S: Simd>(s: S, data: &[f32], k: usize) -> S::F {
    let part: &[f32; LANES] = data[k..k + LANES].first_chunk().expect("eight numbers");
    // SAFETY: the array has eight numbers.
    unsafe { s.load(part.as_ptr()) }
}

#[inline(always)]
fn put<S: Simd>(s: S, data: &mut [f32], k: usize, x: S::F) {
    let part: &mut [f32; LANES] = data[k..k + LANES].first_chunk_mut().expect("eight numbers");
    // SAFETY: the array has eight numbers.
    unsafe { s.store(part.as_mut_ptr(), x) }
}

/// The window over eight numbers around `k` of a padded row.
#[inline(always)]
fn blur_row<S: Simd>(s: S, row: &[f32], k: usize) -> S::F {
    let around: &[f32; LANES + 2 * REACH] =
        row[k - REACH..k + LANES + REACH].first_chunk().expect("the window");
    let p = around.as_ptr();
    // SAFETY: the offsets 0..=2 REACH leave eight numbers inside `around`.
    unsafe {
        let mut sum = s.mul(s.splat(WINDOW[0]), s.load(p.add(REACH)));
        for tap in 1..=REACH {
            let pair = s.add(s.load(p.add(REACH - tap)), s.load(p.add(REACH + tap)));
            sum = s.add(sum, s.mul(s.splat(WINDOW[tap]), pair));
        }
        sum
    }
}

/// The eleven rows around one row of a map of `count` rows per image row; rows beyond the frame are `zeros`.
fn window_rows<'a>(
    map: &'a [f32],
    zeros: &'a [f32],
    layout: &PaddedLayout,
    row: usize,
    count: usize,
    index: usize,
) -> [&'a [f32]; 2 * REACH + 1] {
    std::array::from_fn(|tap| match (row + tap).checked_sub(REACH) {
        Some(y) if y < layout.height => {
            let from = (y * count + index) * layout.stride;
            &map[from..from + layout.stride]
        }
        _ => zeros,
    })
}

#[inline(always)]
fn blur_column<S: Simd>(s: S, rows: &[&[f32]; 2 * REACH + 1], k: usize) -> S::F {
    let mut sum = s.mul(s.splat(WINDOW[0]), at(s, rows[REACH], k));
    for tap in 1..=REACH {
        let pair = s.add(at(s, rows[REACH - tap], k), at(s, rows[REACH + tap], k));
        sum = s.add(sum, s.mul(s.splat(WINDOW[tap]), pair));
    }
    sum
}

/// Phase 1: the four maps of one row, blurred along it.
struct Along<'a> {
    layout: PaddedLayout,
    x: &'a [f32],
    y: &'a [f32],
    work: &'a mut [f32],
    /// The row's maps, one after another.
    out: &'a mut [f32],
}

impl SimdKernel for Along<'_> {
    type Out = ();

    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let (stride, padded) = (self.layout.stride, self.layout.padded());
        let (squares, products) = self.work.split_at_mut(padded);
        for k in (0..padded).step_by(LANES) {
            let (x, y) = (at(s, self.x, k), at(s, self.y, k));
            put(s, squares, k, s.add(s.mul(x, x), s.mul(y, y)));
            put(s, products, k, s.mul(x, y));
        }
        for k in (0..stride).step_by(LANES) {
            put(s, self.out, k, blur_row(s, self.x, k + PAD));
            put(s, self.out, stride + k, blur_row(s, self.y, k + PAD));
            put(s, self.out, 2 * stride + k, blur_row(s, squares, k + PAD));
            put(s, self.out, 3 * stride + k, blur_row(s, products, k + PAD));
        }
    }
}

/// Phase 2: SSIM of one row, and its derivatives blurred along the row.
struct Across<'a> {
    layout: PaddedLayout,
    maps: [[&'a [f32]; 2 * REACH + 1]; MAPS],
    /// Padded rows of the derivatives.
    work: &'a mut [f32],
    /// The row's blurred derivatives; nothing if only the scores are wanted.
    out: Option<&'a mut [f32]>,
    /// Scores per pixel, if wanted.
    scores: Option<&'a mut [f32]>,
}

impl SimdKernel for Across<'_> {
    /// Sum of the scores.
    type Out = f64;

    #[inline(always)]
    fn run<S: Simd>(mut self, s: S) -> f64 {
        let PaddedLayout { width, stride, .. } = self.layout;
        let padded = self.layout.padded();
        let two = s.splat(2.0);
        let mut total = s.splat(0.0);
        for k in (0..stride).step_by(LANES) {
            let mx = blur_column(s, &self.maps[0], k);
            let my = blur_column(s, &self.maps[1], k);
            let squares = blur_column(s, &self.maps[2], k);
            let product = blur_column(s, &self.maps[3], k);
            let (mxy, mm) = (s.mul(mx, my), s.add(s.mul(mx, mx), s.mul(my, my)));
            let a1 = s.add(s.mul(two, mxy), s.splat(C1));
            let a2 = s.add(s.mul(two, s.sub(product, mxy)), s.splat(C2));
            let b1 = s.add(mm, s.splat(C1));
            // Rounding may leave a tiny negative variance in flat parts.
            let b2 = s.add(s.max(s.sub(squares, mm), s.splat(0.0)), s.splat(C2));
            let inverse = s.div(s.splat(1.0), s.mul(b1, b2));
            let score = s.mul(s.mul(a1, a2), inverse);
            let inside = s.lt(s.iota(), s.splat(width as f32 - k as f32));
            total = s.add(total, s.keep(score, inside));
            if let Some(scores) = &mut self.scores {
                put(s, scores, k, score);
            }
            if self.out.is_some() {
                // 1/b1 = b2 inverse and 1/b2 = b1 inverse.
                let by_mean = s.sub(
                    s.mul(s.mul(two, my), s.mul(s.sub(a2, a1), inverse)),
                    s.mul(s.mul(s.mul(two, mx), score), s.mul(s.sub(b2, b1), inverse)),
                );
                let by_squares = s.sub(s.splat(0.0), s.mul(score, s.mul(b1, inverse)));
                let by_product = s.mul(two, s.mul(a1, inverse));
                put(s, self.work, PAD + k, s.keep(by_mean, inside));
                put(s, self.work, padded + PAD + k, s.keep(by_squares, inside));
                put(s, self.work, 2 * padded + PAD + k, s.keep(by_product, inside));
            }
        }
        if let Some(out) = self.out {
            for map in 0..BACK {
                let row = &self.work[map * padded..(map + 1) * padded];
                for k in (0..stride).step_by(LANES) {
                    put(s, out, map * stride + k, blur_row(s, row, k + PAD));
                }
            }
        }
        f64::from(s.sum(total))
    }
}

/// Phase 3: gradient of one row.
struct GradientPass<'a> {
    layout: PaddedLayout,
    x: &'a [f32],
    y: &'a [f32],
    maps: [[&'a [f32]; 2 * REACH + 1]; BACK],
    /// Factors of the L1 and SSIM parts.
    l1: f32,
    ssim: f32,
    out: &'a mut [f32],
}

impl SimdKernel for GradientPass<'_> {
    /// Sum of the absolute differences.
    type Out = f64;

    #[inline(always)]
    fn run<S: Simd>(self, s: S) -> f64 {
        let mut total = s.splat(0.0);
        let (zero, l1) = (s.splat(0.0), s.splat(self.l1));
        for k in (0..self.layout.stride).step_by(LANES) {
            let (x, y) = (at(s, self.x, k + PAD), at(s, self.y, k + PAD));
            let d = s.sub(x, y);
            total = s.add(total, s.abs(d));
            let sign = s.sub(s.keep(l1, s.lt(zero, d)), s.keep(l1, s.lt(d, zero)));
            let by_mean = blur_column(s, &self.maps[0], k);
            let by_squares = blur_column(s, &self.maps[1], k);
            let by_product = blur_column(s, &self.maps[2], k);
            let twice = s.mul(s.add(x, x), by_squares);
            let score = s.add(by_mean, s.add(twice, s.mul(y, by_product)));
            put(s, self.out, k, s.add(sign, s.mul(s.splat(self.ssim), score)));
        }
        f64::from(s.sum(total))
    }
}

fn blurred(isa: Isa, render: &Image, target: &Image, weight: Option<&Image>, maps: &mut [f32]) {
    let layout = PaddedLayout::of(render);
    maps.par_chunks_mut(MAPS * layout.stride).enumerate().for_each_init(
        RowMemory::default,
        |memory, (index, out)| {
            let (from, y) = (index * layout.width, index % layout.height);
            let weight = weight.map(|weight| &weight.data[y * layout.width..(y + 1) * layout.width]);
            load_row(&mut memory.x, &layout, &render.data[from..from + layout.width], weight);
            load_row(&mut memory.y, &layout, &target.data[from..from + layout.width], weight);
            memory.work.resize(2 * layout.padded(), 0.0);
            simd::run(isa, Along { layout, x: &memory.x, y: &memory.y, work: &mut memory.work, out });
        },
    );
}

fn sweep(
    isa: Isa,
    render: &Image,
    target: &Image,
    weight: Option<&Image>,
    lambda: f32,
    grad: Option<&mut Image>,
) -> LossSums {
    same_size(render, target, weight);
    if render.data.is_empty() {
        return LossSums::default();
    }
    let layout = PaddedLayout::of(render);
    let PaddedLayout { width, height, stride } = layout;
    let rows = height * render.channels;
    let mut memory = MEMORY.take();
    memory.resize((MAPS + BACK) * rows * stride, 0.0);
    let (maps, back) = memory.split_at_mut(MAPS * rows * stride);
    blurred(isa, render, target, weight, maps);

    let zeros = vec![0.0; stride];
    let maps = &*maps;
    let plane = |map: &'_ [f32], index: usize, count: usize| -> std::ops::Range<usize> {
        debug_assert!(map.len() == rows * count * stride);
        let first = index / height * height * count * stride;
        first..first + height * count * stride
    };
    let wanted = grad.is_some();
    let scores: Vec<f64> = back
        .par_chunks_mut(BACK * stride)
        .enumerate()
        .map_init(RowMemory::default, |memory, (index, out)| {
            let map = &maps[plane(maps, index, MAPS)];
            let maps = std::array::from_fn(|k| window_rows(map, &zeros, &layout, index % height, MAPS, k));
            memory.work.resize(BACK * layout.padded(), 0.0);
            let out = wanted.then_some(out);
            simd::run(isa, Across { layout, maps, work: &mut memory.work, out, scores: None })
        })
        .collect();
    let mut sums = LossSums { difference: 0.0, ssim: scores.iter().sum() };
    if let Some(grad) = grad {
        let back = &*back;
        let count = render.data.len() as f32;
        let (l1, ssim) = ((1.0 - lambda) / count, -lambda / count);
        let differences: Vec<f64> = grad
            .data
            .par_chunks_mut(width)
            .enumerate()
            .map_init(RowMemory::default, |memory, (index, out)| {
                let (from, y) = (index * width, index % height);
                let weight = weight.map(|weight| &weight.data[y * width..(y + 1) * width]);
                load_row(&mut memory.x, &layout, &render.data[from..from + width], weight);
                load_row(&mut memory.y, &layout, &target.data[from..from + width], weight);
                memory.work.resize(stride, 0.0);
                let map = &back[plane(back, index, BACK)];
                let maps = std::array::from_fn(|k| window_rows(map, &zeros, &layout, y, BACK, k));
                let (x, y) = (&memory.x, &memory.y);
                let sum = simd::run(
                    Isa::detect_once(),
                    GradientPass { layout, x, y, maps, l1, ssim, out: &mut memory.work },
                );
                match weight {
                    Some(weight) => {
                        for ((out, g), w) in out.iter_mut().zip(&memory.work).zip(weight) {
                            *out = g * w;
                        }
                    }
                    None => out.copy_from_slice(&memory.work[..width]),
                }
                sum
            })
            .collect();
        sums.difference = differences.iter().sum();
    }
    MEMORY.set(memory);
    sums
}

/// SSIM per pixel and channel.
fn score_map(render: &Image, target: &Image, into: &mut Image) {
    if render.data.is_empty() {
        return;
    }
    let layout = PaddedLayout::of(render);
    let PaddedLayout { width, height, stride } = layout;
    let mut maps = vec![0.0; MAPS * height * render.channels * stride];
    let isa = Isa::detect_once();
    blurred(isa, render, target, None, &mut maps);
    let zeros = vec![0.0; stride];
    into.data.par_chunks_mut(width).enumerate().for_each_init(
        || vec![0.0; stride],
        |scores, (index, out)| {
            let first = index / height * height * MAPS * stride;
            let map = &maps[first..first + height * MAPS * stride];
            let maps = std::array::from_fn(|k| window_rows(map, &zeros, &layout, index % height, MAPS, k));
            simd::run(isa, Across { layout, maps, work: &mut [], out: None, scores: Some(scores) });
            out.copy_from_slice(&scores[..width]);
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_gives_the_same_bytes() {
        let wave = |k: usize, f: f32| 0.5 + 0.5 * (k as f32 * f).sin();
        let image = |f: f32| Image {
            width: 37,
            height: 21,
            channels: 3,
            data: (0..37 * 21 * 3).map(|k| wave(k, f)).collect(),
        };
        let (render, target) = (image(0.37), image(0.21));
        let weight = Image { channels: 1, data: (0..37 * 21).map(|k| wave(k, 0.11)).collect(), ..image(1.0) };
        let run = |isa: Isa| {
            let mut grad = Image::zeros(37, 21, 3);
            let sums = sweep(isa, &render, &target, Some(&weight), 0.2, Some(&mut grad));
            let bits: Vec<u32> = grad.data.iter().map(|v| v.to_bits()).collect();
            (sums.difference.to_bits(), sums.ssim.to_bits(), bits)
        };
        let plain = run(Isa::Plain);
        for isa in [Isa::Avx2, Isa::Avx512] {
            if isa.available() {
                assert!(run(isa) == plain, "{isa:?} differs from plain");
            } else {
                eprintln!("skipped: loss on {isa:?}: this processor lacks it");
            }
        }
    }
}
