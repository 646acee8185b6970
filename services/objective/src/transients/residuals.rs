//! The robust mask: leaves out pixels that contradict the scene: people, cars, umbrellas (method, section 3; it takes
//! the role of a visibility map for affine appearance models; after RobustNeRF and SpotLessSplats).

use rayon::prelude::*;
use segwild_scene::{TASK_PIXELS, box_mean, per_piece, per_pixel};
use wincode::{SchemaRead, SchemaWrite};

/// State of a photo's residuals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residuals<'a> {
    /// Decaying histogram of earlier visits, [`BINS`] shares; empty at the first.
    pub before: &'a [f32],
    /// Largest share of a photo left out.
    pub share: f32,
}

/// Residual histograms per photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct ResidualHistograms {
    /// Per photo, the largest share left out; 0 where it shows no transients.
    shares: Vec<f32>,
    /// Per photo, the share that contradicts trainings made without it; `None` where that was not searched for.
    evidence: Vec<Option<f32>>,
    /// Per photo, decaying counts of residuals; empty until the photo was seen.
    histograms: Vec<Vec<f32>>,
}

impl ResidualHistograms {
    /// Of photos with these largest shares, and with this evidence of transients.
    pub fn new(shares: Vec<f32>, evidence: Vec<Option<f32>>) -> ResidualHistograms {
        ResidualHistograms { histograms: vec![Vec::new(); shares.len()], shares, evidence }
    }

    /// Per photo, the share that contradicts trainings made without it.
    pub fn evidence(&self) -> &[Option<f32>] {
        &self.evidence
    }

    /// Per photo, the largest share that may be left out.
    pub fn shares(&self) -> &[f32] {
        &self.shares
    }

    /// Whether there is a histogram for every photo, each empty or with all its bins: what comes out of a file may be damaged.
    pub fn consistent(&self) -> bool {
        let whole = |histogram: &Vec<f32>| histogram.is_empty() || histogram.len() == BINS;
        self.histograms.len() == self.shares.len() && self.histograms.iter().all(whole)
    }

    /// What is known of a photo's residuals.
    pub fn known(&self, photo: usize) -> Residuals<'_> {
        Residuals { before: &self.histograms[photo], share: self.shares[photo] }
    }

    /// Stores the histogram after a visit of the photo.
    pub fn update(&mut self, photo: usize, residuals: Vec<f32>) {
        self.histograms[photo] = residuals;
    }
}

/// Bins over residuals in [0, 1).
pub const BINS: usize = 128;
/// What a visit keeps of the histogram before it.
pub const DECAY: f32 = 0.7;
/// Residuals under this are never transient: fine texture that is not learnt yet is in this range.
pub const FLOOR: f32 = 0.06;
/// Initial transients are left out from this share of the limit on.
pub const INITIAL_TRANSIENT: f32 = 0.5;
/// A transient stands out from its photo by this factor over the median.
pub const CONTRAST: f32 = 3.0;
/// How many times the share may be over the limit before a visit is trusted alone.
pub const SURPRISE: f32 = 1.5;

/// A weight per pixel, 0 for transients, or `None` where nothing stands out; and the histogram with this visit's
/// residuals, or `None` where no pixel counts. Not to be called in the warm-up, nor while opacities recover from a
/// reset: such residuals would spoil the histograms.
///
/// `residual` is one number per pixel, mean absolute colour difference; `counts` gives the pixels that take part at
/// all, `initial_transient_share` the initial transients.
pub fn leave_out(
    known: &Residuals,
    residual: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool + Sync,
    initial_transient_share: impl Fn(usize) -> bool + Sync,
) -> (Option<Vec<f32>>, Option<Vec<f32>>) {
    let height = residual.len() / width;
    let smooth = smoothed(residual, width);
    let bins: Vec<Option<u8>> = per_pixel(smooth.len(), |i| counts(i).then(|| bin(smooth[i]) as u8));
    let fresh = histogram(&bins);
    let Some((limits, held)) = residual_limits(known, fresh) else { return (None, None) };
    let over = limits.map(|limit| -> [u8; BINS] { std::array::from_fn(|b| u8::from(bin_top(b) > limit)) });
    let out = |i: usize| bins[i].map_or(0, |b| over[usize::from(initial_transient_share(i))][usize::from(b)]);
    let out: Vec<u8> = per_pixel(bins.len(), out);
    if out.iter().all(|&o| o == 0) {
        return (None, Some(held));
    }
    let most = majority(&out, width, height);
    let kept = per_pixel(most.len(), |i| f32::from(1 - most[i]));
    (Some(kept), Some(held))
}

/// The pixels of each bin; `None` counts nowhere.
fn histogram(bins: &[Option<u8>]) -> Vec<f32> {
    let of_pieces = per_piece(bins.len(), |piece| {
        let mut counts = [0u32; BINS];
        bins[piece].iter().flatten().for_each(|&b| counts[usize::from(b)] += 1);
        counts
    });
    (0..BINS).map(|b| of_pieces.iter().map(|counts| counts[b]).sum::<u32>() as f32).collect()
}

/// The residuals over which a pixel, and an initial transient, is left out, and the histogram with this visit's counts;
/// `None` if there are none.
pub fn residual_limits(known: &Residuals, mut fresh: Vec<f32>) -> Option<([f32; 2], Vec<f32>)> {
    let total: f32 = fresh.iter().sum();
    if total == 0.0 {
        return None;
    }
    for f in &mut fresh {
        *f /= total;
    }
    let mut held = known.before.to_vec();
    if held.is_empty() {
        held.clone_from(&fresh);
    } else {
        for (h, f) in held.iter_mut().zip(&fresh) {
            *h = DECAY * *h + (1.0 - DECAY) * f;
        }
    }
    let mut limit = threshold(&held, known.share);
    let over: f32 = fresh.iter().enumerate().filter(|&(b, _)| bin_top(b) > limit).map(|(_, f)| f).sum();
    // The photo changed faster than its history (a new level, a reset): trust this visit alone, so that
    // never more than the share goes.
    if over > SURPRISE * known.share {
        limit = limit.max(threshold(&fresh, known.share));
    }
    Some(([limit, INITIAL_TRANSIENT * limit], held))
}

/// Half width of the window in which residuals are averaged.
pub fn window(width: usize, height: usize) -> usize {
    (width.max(height) / 160).max(1)
}

/// A residual, blurred: edges that are off by a pixel give thin residuals, people give blobs.
pub fn smoothed(residual: &[f32], width: usize) -> Vec<f32> {
    let height = residual.len() / width;
    box_mean(residual, width, height, window(width, height))
}

/// The smoothed residual from which a pixel of this photo counts as transient; `None` where no pixel counts.
pub fn limit(smooth: &[f32], counts: impl Fn(usize) -> bool + Sync, share: f32) -> Option<f32> {
    let histogram = histogram(&per_pixel(smooth.len(), |i| counts(i).then(|| bin(smooth[i]) as u8)));
    (histogram.iter().sum::<f32>() > 0.0).then(|| threshold(&histogram, share))
}

/// The residual, smoothed, in units of the limit at which a pixel would be left out, by this residual alone.
pub fn relative(
    residual: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool + Sync,
    share: f32,
) -> Vec<f32> {
    let mut smooth = smoothed(residual, width);
    let threshold = limit(&smooth, counts, share).unwrap_or(FLOOR);
    smooth.par_iter_mut().with_min_len(TASK_PIXELS).for_each(|r| *r /= threshold);
    smooth
}

/// Per pixel, whether a photo contradicts the scene there, by this residual alone.
pub fn contradicted(
    residual: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool + Sync,
    share: f32,
) -> Vec<bool> {
    let (kept, _) = leave_out(&Residuals { before: &[], share }, residual, width, counts, |_| false);
    kept.map_or(vec![false; residual.len()], |kept| kept.iter().map(|&k| k == 0.0).collect())
}

/// The bin of a residual.
pub fn bin(r: f32) -> usize {
    // A residual that is not a number falls in the last bin.
    if r.is_nan() { BINS - 1 } else { ((r * BINS as f32) as usize).min(BINS - 1) }
}

fn bin_top(bin: usize) -> f32 {
    (bin + 1) as f32 / BINS as f32
}

/// The quantile at `q` in [0, 1] of the residuals in a histogram: the upper end of the bin in which it lies.
fn quantile(histogram: &[f32], q: f32) -> f32 {
    let total: f32 = histogram.iter().sum();
    let mut sum = 0.0;
    for (b, h) in histogram.iter().enumerate() {
        sum += h;
        if sum >= q * total {
            return bin_top(b);
        }
    }
    1.0
}

/// At most `share` is over it, and only outliers: a photo that fits loses nothing, and one that fits nowhere is not
/// emptied.
fn threshold(histogram: &[f32], share: f32) -> f32 {
    quantile(histogram, 1.0 - share).max(CONTRAST * quantile(histogram, 0.5)).max(FLOOR)
}

/// 3 x 3 majority; at the border of the pixels there are.
fn majority(out: &[u8], width: usize, height: usize) -> Vec<u8> {
    let mut result = vec![0; out.len()];
    let rows = result.par_chunks_exact_mut(width).with_min_len(TASK_PIXELS.div_ceil(width)).enumerate();
    rows.for_each_init(
        || vec![0u8; width],
        |columns, (y, result)| {
            let (y0, y1) = (y.saturating_sub(1), (y + 2).min(height));
            columns.fill(0);
            for row in out[y0 * width..y1 * width].chunks_exact(width) {
                columns.iter_mut().zip(row).for_each(|(c, o)| *c += o);
            }
            let rows = (y1 - y0) as u8;
            let (first, last) = (&columns[..width.min(2)], &columns[width.saturating_sub(2)..]);
            let voted = |votes: u8, pixels: u8| u8::from(2 * votes > pixels * rows);
            result[0] = voted(first.iter().sum(), first.len() as u8);
            result[width - 1] = voted(last.iter().sum(), last.len() as u8);
            for (r, c) in result.iter_mut().skip(1).zip(columns.windows(3)) {
                *r = voted(c[0] + c[1] + c[2], 3);
            }
        },
    );
    result
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::Random;

    /// One photo, visited again and again.
    struct Visited {
        before: Vec<f32>,
        share: f32,
    }

    impl Visited {
        fn new(share: f32) -> Visited {
            Visited { before: Vec::new(), share }
        }

        fn weights(&mut self, residual: &[f32], counts: bool) -> Option<Vec<f32>> {
            let known = Residuals { before: &self.before, share: self.share };
            let (kept, held) = leave_out(&known, residual, W, |_| counts, |_| false);
            self.before = held.unwrap_or_default();
            kept
        }
    }

    const W: usize = 80;
    const H: usize = 60;

    fn kept(weights: &Option<Vec<f32>>) -> f32 {
        weights.as_ref().map_or(1.0, |w| w.iter().sum::<f32>() / w.len() as f32)
    }

    #[test]
    fn histograms_that_are_fewer_than_the_photos_or_lack_bins_are_damaged() {
        let mut known = ResidualHistograms::new(vec![0.2; 2], vec![None; 2]);
        known.update(0, vec![0.0; BINS]);
        assert!(known.consistent());
        let mut lacks = known.clone();
        lacks.update(1, vec![0.0; BINS - 1]);
        known.histograms.pop();
        assert!(!known.consistent() && !lacks.consistent());
    }

    #[test]
    fn a_transient_is_left_out_and_texture_is_not() {
        let mut r = Random::new(5);
        let mut photo = Visited::new(0.2);
        let transient = |i: usize| (20..32).contains(&(i % W)) && (25..55).contains(&(i / W));
        let mut last = None;
        for _ in 0..6 {
            let residual: Vec<f32> =
                (0..W * H).map(|i| if transient(i) { 0.3 } else { 0.03 * r.uniform() } + 0.01).collect();
            last = photo.weights(&residual, true);
        }
        let w = last.unwrap();
        let wrong = (0..W * H).filter(|&i| transient(i) == (w[i] > 0.5)).count();
        assert!(wrong < 90, "{wrong} pixels on the wrong side"); // the outline is 84 pixels long
        // A one-pixel line of large residual, an edge off by one, stays.
        let line: Vec<f32> = (0..W * H).map(|i| if i % W == 40 { 0.15 } else { 0.02 }).collect();
        assert_eq!(kept(&Visited::new(0.2).weights(&line, true)), 1.0);
    }

    #[test]
    fn neither_all_nor_a_bad_photo_is_left_out() {
        let mut r = Random::new(9);
        let mut photos = [0.2; 3].map(Visited::new);
        // Wrong everywhere, wildly wrong, not a number anywhere: at most about the share goes.
        for _ in 0..5 {
            let bad: Vec<f32> = (0..W * H).map(|_| 0.4 + 0.4 * r.uniform()).collect();
            assert!(kept(&photos[0].weights(&bad, true)) >= 0.7);
            let half: Vec<f32> = (0..W * H).map(|i| if i % W < 40 { 0.9 } else { 0.0 }).collect();
            assert!(kept(&photos[1].weights(&half, true)) >= 0.4);
            let nan = vec![f32::NAN; W * H];
            assert!(kept(&photos[2].weights(&nan, true)) >= 0.7);
        }
        // A perfect photo loses nothing.
        assert!(photos[0].weights(&[0.001; W * H], true).is_none());
        assert!(photos[0].weights(&[0.9; W * H], false).is_none());
    }

    #[test]
    fn a_sudden_change_does_not_empty_a_photo() {
        let mut photo = Visited::new(0.2);
        for _ in 0..10 {
            photo.weights(&[0.01; W * H], true);
        }
        let mut r = Random::new(4);
        let worse: Vec<f32> = (0..W * H).map(|_| 0.3 + 0.1 * r.uniform()).collect();
        assert!(kept(&photo.weights(&worse, true)) >= 0.7);
    }
}
