//! How good a render or a selection is (method, section 10).
//!
//! Boundary IoU is [`segwild_scene::Mask::boundary_iou`] at [`BOUNDARY`].

pub use segwild_pipeline::BOUNDARY;
use segwild_scene::{Image, Mask};
use serde::{Deserialize, Serialize};

/// Why two things cannot be compared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MetricError {
    /// Their sizes differ.
    #[error("an image or mask of {0}x{1} cannot be compared with one of {2}x{3}")]
    Size(usize, usize, usize, usize),
    /// There is no pixel to compare.
    #[error("there is no pixel to compare")]
    Empty,
}

/// Peak signal-to-noise ratio in dB of values in [0, 1], over the pixels of `within` (all when `None`) and all
/// planes; infinite for equal images, NaN when an image has a NaN there.
///
/// It is computed in f64 and shares no code with the PSNR of `segwild_objective`, which trainings and their reports have.
///
/// # Errors
/// When the sizes differ, or no pixel counts.
pub fn psnr(image: &Image, truth: &Image, within: Option<&Mask>) -> Result<f64, MetricError> {
    same_image(image, truth)?;
    if let Some(mask) = within {
        same(image.width, image.height, mask.width() as usize, mask.height() as usize)?;
    }
    let n = image.pixels();
    let (mut sum, mut count) = (0.0f64, 0usize);
    for i in 0..n {
        if within.is_some_and(|mask| !mask.index(i)) {
            continue;
        }
        for c in 0..image.channels {
            let d = f64::from(image.data[c * n + i]) - f64::from(truth.data[c * n + i]);
            sum += d * d;
            count += 1;
        }
    }
    if count == 0 {
        return Err(MetricError::Empty);
    }
    Ok(-10.0 * (sum / count as f64).log10())
}

/// Structural similarity (Wang et al. 2004): 11-tap Gaussian window of sigma 1.5, values in [0, 1], mean over
/// planes and over the pixels of `within` (all when `None`). Outside the image is zero, as in the training loss
/// of Gaussian splatting.
pub fn ssim(image: &Image, truth: &Image, within: Option<&Mask>) -> Result<f64, MetricError> {
    same_image(image, truth)?;
    if let Some(mask) = within {
        same(image.width, image.height, mask.width() as usize, mask.height() as usize)?;
    }
    const C1: f64 = 0.01 * 0.01;
    const C2: f64 = 0.03 * 0.03;
    let n = image.pixels();
    let (mut sum, mut count) = (0.0f64, 0usize);
    for c in 0..image.channels {
        let a: Vec<f64> = image.plane(c).iter().map(|&v| f64::from(v)).collect();
        let b: Vec<f64> = truth.plane(c).iter().map(|&v| f64::from(v)).collect();
        let blur = |f: &dyn Fn(usize) -> f64| {
            gaussian(&(0..n).map(f).collect::<Vec<f64>>(), image.width, image.height)
        };
        let (ma, mb) = (blur(&|i| a[i]), blur(&|i| b[i]));
        let (aa, bb, ab) = (blur(&|i| a[i] * a[i]), blur(&|i| b[i] * b[i]), blur(&|i| a[i] * b[i]));
        for i in 0..n {
            if within.is_some_and(|mask| !mask.index(i)) {
                continue;
            }
            let (va, vb, cov) = (aa[i] - ma[i] * ma[i], bb[i] - mb[i] * mb[i], ab[i] - ma[i] * mb[i]);
            sum += (2.0 * ma[i] * mb[i] + C1) * (2.0 * cov + C2)
                / ((ma[i] * ma[i] + mb[i] * mb[i] + C1) * (va + vb + C2));
            count += 1;
        }
    }
    if count == 0 { Err(MetricError::Empty) } else { Ok(sum / count as f64) }
}

fn gaussian(values: &[f64], width: usize, height: usize) -> Vec<f64> {
    let weight = |k: i64| (-((k * k) as f64) / (2.0 * 1.5 * 1.5)).exp();
    let total: f64 = (-5..=5).map(weight).sum();
    let taps: Vec<f64> = (-5..=5).map(|k| weight(k) / total).collect();
    let pass = |from: &[f64], step_x: i64, step_y: i64| {
        let mut out = vec![0.0; from.len()];
        for y in 0..height as i64 {
            for x in 0..width as i64 {
                out[(y * width as i64 + x) as usize] = (0..11)
                    .map(|k| {
                        let (u, v) = (x + (k - 5) * step_x, y + (k - 5) * step_y);
                        let inside = u >= 0 && v >= 0 && u < width as i64 && v < height as i64;
                        if inside { taps[k as usize] * from[(v * width as i64 + u) as usize] } else { 0.0 }
                    })
                    .sum();
            }
        }
        out
    };
    pass(&pass(values, 1, 0), 0, 1)
}

/// How well a mask fits the truth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MaskMetrics {
    /// Intersection over union; 1 when both are empty.
    pub iou: f64,
    /// Share of the pixels that agree.
    pub accuracy: f64,
    /// IoU of the bands along the outlines.
    pub boundary_iou: f64,
}

/// Scores a mask, leaving out the pixels of `ignore` (transients, for instance).
pub fn score(mask: &Mask, truth: &Mask, ignore: Option<&Mask>) -> Result<MaskMetrics, MetricError> {
    let size = |m: &Mask| (m.width() as usize, m.height() as usize);
    let ((w, h), (tw, th)) = (size(mask), size(truth));
    same(w, h, tw, th)?;
    let all = w * h;
    let (mask, truth, all) = match ignore {
        None => (mask.clone(), truth.clone(), all),
        Some(ignore) => {
            same(w, h, size(ignore).0, size(ignore).1)?;
            (mask.minus(ignore), truth.minus(ignore), all - ignore.count())
        }
    };
    if all == 0 {
        return Err(MetricError::Empty);
    }
    let both = mask.overlap(&truth);
    let wrong = mask.count() + truth.count() - 2 * both;
    Ok(MaskMetrics {
        iou: mask.iou(&truth),
        accuracy: 1.0 - wrong as f64 / all as f64,
        boundary_iou: mask.boundary_iou(&truth, BOUNDARY),
    })
}

/// IoU of a 3D selection with an instance: over splats, each with the id of its nearest surface
/// ([`segwild_synthetic::SyntheticScene::label`]) and a weight (its volume or contribution; 1 counts splats).
pub fn label_iou(selected: &[bool], labels: &[u16], instance: u16, weight: impl Fn(usize) -> f64) -> f64 {
    let (mut both, mut either) = (0.0, 0.0);
    for (i, (&chosen, &label)) in selected.iter().zip(labels).enumerate() {
        let meant = label == instance;
        both += if chosen && meant { weight(i) } else { 0.0 };
        either += if chosen || meant { weight(i) } else { 0.0 };
    }
    if either == 0.0 { 1.0 } else { both / either }
}

/// Share of an instance's splats that a selection took in: what leaks to an occluded wall. 0 when the
/// instance has no splat.
pub fn leakage(selected: &[bool], labels: &[u16], instance: u16) -> f64 {
    let of = labels.iter().filter(|l| **l == instance).count();
    let taken = selected.iter().zip(labels).filter(|(s, l)| **s && **l == instance).count();
    if of == 0 { 0.0 } else { taken as f64 / of as f64 }
}

/// Mean and spread of a set of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// How many.
    pub count: usize,
    /// Their mean.
    pub mean: f64,
    /// Standard deviation of the sample (divisor n - 1); 0 for one number.
    pub deviation: f64,
    /// The smallest.
    pub least: f64,
    /// The largest.
    pub most: f64,
}

impl Spread {
    /// Of some numbers; `None` of none.
    pub fn of(values: &[f64]) -> Option<Spread> {
        let count = values.len();
        if count == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / count as f64;
        let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
        Some(Spread {
            count,
            mean,
            deviation: if count > 1 { (squares / (count - 1) as f64).sqrt() } else { 0.0 },
            least: values.iter().copied().fold(f64::INFINITY, f64::min),
            most: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        })
    }
}

impl std::fmt::Display for Spread {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:.3} ± {:.3} [{:.3}, {:.3}]", self.mean, self.deviation, self.least, self.most)
    }
}

/// A half of a photo. The official protocol fits the appearance on the left and scores the right (method, section 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Half {
    /// Columns below `width / 2`.
    Left,
    /// The other columns.
    Right,
}

impl Half {
    /// Its columns in a photo of that width.
    pub fn columns(self, width: usize) -> std::ops::Range<usize> {
        match self {
            Half::Left => 0..width / 2,
            Half::Right => width / 2..width,
        }
    }

    /// Its pixels.
    pub fn mask(self, width: u32, height: u32) -> Mask {
        let columns = self.columns(width as usize);
        Mask::from_fn(width, height, |x, _| columns.contains(&(x as usize)))
    }

    /// That half of an image, cut out: SSIM and PSNR of the official protocol are of the cut image.
    pub fn of(self, image: &Image) -> Image {
        let columns = self.columns(image.width);
        let rows = image.data.chunks(image.width.max(1));
        let data = rows.flat_map(|row| row[columns.clone()].iter().copied()).collect();
        Image { width: columns.len(), height: image.height, channels: image.channels, data }
    }
}

fn same_image(a: &Image, b: &Image) -> Result<(), MetricError> {
    if a.channels != b.channels {
        return Err(MetricError::Size(a.width, a.height, b.width, b.height));
    }
    same(a.width, a.height, b.width, b.height)
}

fn same(w: usize, h: usize, tw: usize, th: usize) -> Result<(), MetricError> {
    if (w, h) == (tw, th) { Ok(()) } else { Err(MetricError::Size(w, h, tw, th)) }
}
