//! From prompts to the masks of a photo (method, section 5).

use crate::MaskSettings;
use segwild_scene::{Image, Mask, MaskSet, ScoredMask};
use segwild_vision::{MaskProposer, VisionError};

/// Why masks could not be made.
#[derive(Debug, thiserror::Error)]
pub enum MaskError {
    /// The mask provider could not answer.
    #[error("the mask provider `{provider}` failed: {source}")]
    Provider {
        /// Key of the provider.
        provider: String,
        /// Its error.
        source: VisionError,
    },
    /// Sizes do not fit each other.
    #[error("{0}")]
    Size(String),
}

/// The masks of a photo and what became of the proposals.
#[derive(Clone, Debug, PartialEq)]
pub struct Generated {
    /// What was kept: stable masks, best first, then those that fill up, then the sky, if it is there.
    pub set: MaskSet,
    /// Counts for reports.
    pub tally: MaskTally,
}

/// What became of a photo's proposals.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct MaskTally {
    /// Prompts given to the provider.
    pub prompts: usize,
    /// Masks that the provider proposed.
    pub proposed: usize,
    /// Dropped: predicted IoU too low, or not a number.
    pub doubtful: usize,
    /// Dropped: stability too low, or not a number.
    pub unstable: usize,
    /// Kept although they are not stable, because few are.
    pub filled: usize,
    /// Dropped: nearly the same as a better one.
    pub duplicates: usize,
    /// Dropped: too small.
    pub small: usize,
    /// Replaced by the one mask of the sky.
    pub sky: usize,
    /// Kept.
    pub kept: usize,
}

/// Asks `proposer` for masks at `points` (pixels of `image`) and keeps the good ones: filters by predicted IoU and
/// stability (filled up to `min_masks` by the most stable others), one of near-duplicates, small islands and
/// holes removed.
///
/// With a `sky` (and `sky_prompts` on), masks that are mostly sky give way to one mask, the sky itself: clouds
/// are no objects, and the other masks must still be distinguishable from the sky.
///
/// # Errors
/// When the provider fails, or when the image's or a mask's size does not fit.
pub fn generate(
    proposer: &dyn MaskProposer,
    image: &Image,
    points: &[[f32; 2]],
    sky: Option<&Mask>,
    settings: &MaskSettings,
) -> Result<Generated, MaskError> {
    let (width, height) = (image.width as u32, image.height as u32);
    if image.pixels() == 0 || image.data.len() != image.pixels() * image.channels {
        return Err(MaskError::Size(format!(
            "an image of {}x{} pixels and {} planes with {} values cannot be masked",
            image.width,
            image.height,
            image.channels,
            image.data.len()
        )));
    }
    let sky =
        sky.filter(|_| settings.sky_prompts).map(|s| match (s.width(), s.height()) == (width, height) {
            true => s.clone(),
            false => s.resized(width, height),
        });
    let least = (f64::from(settings.min_mask_area) * image.pixels() as f64).ceil().max(1.0) as usize;
    let mut tally = MaskTally { prompts: points.len(), ..MaskTally::default() };
    let (mut masks, mut unstable) = (Vec::new(), Vec::new());
    for batch in points.chunks(settings.prompt_batch.max(1) as usize) {
        let proposed = proposer
            .propose(image, batch)
            .map_err(|source| MaskError::Provider { provider: proposer.key(), source })?;
        for mask in proposed {
            if (mask.mask.width(), mask.mask.height()) != (width, height) {
                return Err(MaskError::Size(format!(
                    "the mask provider `{}` gave a mask of {}x{} pixels for an image of {width}x{height}",
                    proposer.key(),
                    mask.mask.width(),
                    mask.mask.height()
                )));
            }
            tally.proposed += 1;
            if below(mask.predicted_iou, settings.min_predicted_iou) {
                tally.doubtful += 1;
            } else if mask.mask.count() < least {
                tally.small += 1;
            } else if below(mask.stability, settings.min_stability) {
                tally.unstable += 1;
                unstable.push(mask);
            } else {
                masks.push(mask);
            }
        }
    }
    if let Some(sky) = &sky {
        let before = masks.len();
        let mostly = |m: &ScoredMask| 2 * m.mask.overlap(sky) >= m.mask.count();
        masks.retain(|m| !mostly(m));
        unstable.retain(|m| !mostly(m));
        tally.sky = before - masks.len();
    }
    // Duplicates go first, so that only what stays is cleaned; cleaning can make new ones.
    let clean = |mask: &mut ScoredMask| {
        mask.mask = mask.mask.without_specks(least);
        mask.mask.count() >= least
    };
    masks.sort_by(|a, b| {
        b.predicted_iou.total_cmp(&a.predicted_iou).then(b.stability.total_cmp(&a.stability))
    });
    let mut kept = Distinct::new(settings.mask_nms);
    for mask in masks {
        tally.duplicates += usize::from(!kept.add(mask));
    }
    let mut masks = Distinct::new(settings.mask_nms);
    for mut mask in kept.into_masks() {
        if !clean(&mut mask) {
            tally.small += 1;
        } else if !masks.add(mask) {
            tally.duplicates += 1;
        }
    }
    unstable.retain(|m| !m.stability.is_nan());
    unstable.sort_by(|a, b| {
        b.stability.total_cmp(&a.stability).then(b.predicted_iou.total_cmp(&a.predicted_iou))
    });
    for mut mask in unstable {
        if masks.len() >= settings.min_masks as usize {
            break;
        }
        if clean(&mut mask) && masks.add(mask) {
            tally.filled += 1;
            tally.unstable -= 1;
        }
    }
    let mut masks = masks.into_masks();
    if let Some(sky) = sky.map(|s| s.without_specks(least)).filter(|s| s.count() >= least) {
        masks.push(ScoredMask { mask: sky, predicted_iou: 1.0, stability: 1.0 });
    }
    tally.kept = masks.len();
    Ok(Generated { set: MaskSet { width, height, masks }, tally })
}

/// Whether a score is too low; one that is not a number is.
fn below(score: f32, least: f32) -> bool {
    score.is_nan() || score < least
}

/// Masks of which no two overlap by more than an IoU: greedy non-maximum suppression, the first stays.
struct Distinct {
    threshold: f64,
    kept: Vec<(ScoredMask, usize)>,
}

impl Distinct {
    fn new(threshold: f32) -> Distinct {
        Distinct { threshold: f64::from(threshold), kept: Vec::new() }
    }

    fn len(&self) -> usize {
        self.kept.len()
    }

    /// Adds a mask unless it is nearly the same as one that was kept before.
    fn add(&mut self, mask: ScoredMask) -> bool {
        let area = mask.mask.count();
        let double = self.kept.iter().any(|(other, other_area)| {
            let (small, large) = (area.min(*other_area), area.max(*other_area));
            // The IoU is at most small / large, so most pairs are decided without their pixels.
            if small as f64 <= self.threshold * large as f64 {
                return false;
            }
            let both = mask.mask.overlap(&other.mask);
            both as f64 > self.threshold * (area + other_area - both) as f64
        });
        if !double {
            self.kept.push((mask, area));
        }
        !double
    }

    fn into_masks(self) -> Vec<ScoredMask> {
        self.kept.into_iter().map(|(mask, _)| mask).collect()
    }
}
