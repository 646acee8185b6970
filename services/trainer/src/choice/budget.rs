//! How many steps a scene needs: trainings at reduced size, each twice as long as the one before, until another
//! doubling would not pay (method, section 9). How many splats is decided while they grow: where more gain nothing,
//! growing ends.
//!
//! The gain is measured in SSIM on photos held out. PSNR can stay the same where a click selects .05 IoU less: with transients
//! and a quarter of the steps, or with half of the splats (docs/results/chart/oracle-synthetic).
//!
//! Each is a whole training from coarse to fine. Continuing the one before would take half the steps, but a scene
//! trained on fine photos for long with few splats is worse on photos held out: on `fern` 1 dB less than
//! before, where the whole training gains 3.

use super::{ShortFit, Trials};
use crate::{Photos, TrainError, TrainSettings};
use segwild_objective::Engine;
use segwild_scene::{Scene, View};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Long side of the photos that are tried on: half of those trained on, within these.
const SIZES: (u32, u32) = (96, 480);
/// The shortest training tried, as a share of the longest, and in steps: fewer show nothing, and where a sixteenth is
/// fewer, trials would cost as much as they could save.
const SHORTEST: (u32, u32) = (16, 125);
/// Photos that agree are worth more steps than others, so many times as many at most.
/// Where light differs and transients stand in front, more than the scene's own steps overfit the photos (docs/experiments/2026-11-22-how-many-steps.md).
const MORE: u32 = 8;
/// Expected gain of all further doublings together on the photos held out, in SSIM, from which the next one is made.
const WORTH: f32 = 0.002;
/// How much of a doubling's gain the next one keeps: where only one gain is known, and the bounds of the ratio of two.
const KEEPS: (f32, f32, f32) = (0.5, 0.3, 0.75);
/// The same where gains shrink fast: if even then the end is not in sight, no longer trial is made.
const KEEPS_AT_BEST: f32 = 0.4;

/// The steps chosen for a training, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BudgetChoice {
    /// Optimiser steps.
    pub steps: u32,
    /// Why, in a sentence.
    pub why: String,
    /// The fits that were tried, in the order in which they were.
    pub fits: Vec<ShortFit>,
    /// Photos that these were scored on.
    pub held_out: usize,
}

/// The long side of the photos to try on, where photos are scaled down to `size` for the training.
pub fn trial_size(scene: &Scene, size: u32) -> u32 {
    let long_side = |v: &View| {
        let camera = v.camera.scaled_to(size);
        camera.width.max(camera.height)
    };
    trial_size_of(scene.views.iter().map(long_side).max().unwrap_or(size))
}

fn trial_size_of(trained_on: u32) -> u32 {
    (trained_on / 2).clamp(SIZES.0, SIZES.1).min(trained_on)
}

/// Chooses the least steps that suffice, `settings.steps` at most, or eight times as many if `beyond` is set: where they
/// were left to the scene, and its photos agree ([`super::AppearanceChoice::agrees`]). `photos` gives photos of a long side of
/// [`trial_size`]; `stopping` ends the work. The same scene, photos and settings give the same choice.
pub fn choose_budget(
    engine: Arc<dyn Engine>,
    scene: &Scene,
    photos: Arc<dyn Photos>,
    settings: &TrainSettings,
    beyond: bool,
    stopping: &dyn Fn() -> bool,
) -> Result<BudgetChoice, TrainError> {
    let settings = &settings.decided(scene);
    let own = settings.steps;
    let most = if beyond { own.saturating_mul(MORE) } else { own };
    let mut trials = Trials::new(engine, scene, photos, stopping);
    let whole =
        BudgetChoice { steps: own, why: String::new(), fits: Vec::new(), held_out: trials.held_out.len() };
    if trials.held_out.is_empty() {
        let why = format!("all {own} steps: {} photos are too few to hold any out", trials.usable.len());
        return Ok(BudgetChoice { why, ..whole });
    }
    let mut steps = most / SHORTEST.0;
    let mut promise = f32::INFINITY;
    while (SHORTEST.1..most).contains(&steps) {
        trials.fit(TrainSettings { steps, ..settings.clone() })?;
        let scores: Vec<f32> = trials.fits.iter().map(|fit| fit.ssim).collect();
        promise = promised(&scores);
        if promise < WORTH || ends_at(&scores, steps) >= most as f32 {
            break;
        }
        steps *= 2;
    }
    let (held_out, fits) = (trials.held_out.len(), trials.fits);
    if fits.is_empty() {
        let why = format!("all {own} steps: trials pay from {} steps on", SHORTEST.0 * SHORTEST.1);
        return Ok(BudgetChoice { why, ..whole });
    }
    let listed = |fits: &[ShortFit]| -> String {
        let each = fits.iter().map(|f| format!("{:.3} ({} steps, {} splats)", f.ssim, f.steps, f.splats));
        each.collect::<Vec<_>>().join(", ")
    };
    if promise >= WORTH {
        let why = format!(
            "all {most} steps, for each doubling pays; SSIM on {held_out} photos held out: {}",
            listed(&fits)
        );
        return Ok(BudgetChoice { steps: most, why, fits, ..whole });
    }
    // The last, though one before it may have done: finer photos take longer.
    let Some(chosen) = fits.last().cloned() else { return Ok(whole) };
    let why = format!(
        "{} of {most} steps; SSIM on {held_out} photos held out: {}; all further doublings promise {promise:.3}",
        chosen.steps,
        listed(&fits)
    );
    Ok(BudgetChoice { steps: chosen.steps, why, fits, ..whole })
}

/// Expected gain of all further doublings together, from the scores of the doublings so far: gains are assumed to shrink as they
/// did so far.
fn promised(scores: &[f32]) -> f32 {
    let gains: Vec<f32> = scores.windows(2).map(|w| w[1] - w[0]).collect();
    let Some(&last) = gains.last() else { return f32::INFINITY };
    let keeps = match gains[..] {
        [.., before, last] if before > 0.0 => (last / before).clamp(KEEPS.1, KEEPS.2),
        _ => KEEPS.0,
    };
    last.max(0.0) * keeps / (1.0 - keeps)
}

/// The steps at which no more is worth while, after doublings up to `steps` with these scores, if gains shrink fast from
/// now on.
fn ends_at(scores: &[f32], steps: u32) -> f32 {
    let [.., before, last] = scores[..] else { return 0.0 };
    let promise = (last - before).max(0.0) * KEEPS_AT_BEST / (1.0 - KEEPS_AT_BEST);
    let doublings = (WORTH / promise.max(WORTH)).log(KEEPS_AT_BEST).ceil();
    steps as f32 * doublings.exp2()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_further_steps_promise_follows_the_gains_so_far() {
        assert_eq!(promised(&[20.0]), f32::INFINITY);
        assert_eq!(promised(&[20.0, 21.0]), 1.0);
        assert_eq!(promised(&[20.0, 21.0, 21.5]), 0.5);
        // Gains that do not shrink promise much, and never without end; a loss promises nothing.
        assert!((promised(&[20.0, 21.0, 22.0]) - 3.0).abs() < 1e-5);
        assert_eq!(promised(&[20.0, 21.0, 20.9]), 0.0);
        assert_eq!(promised(&[20.0, 19.0, 20.0]), 1.0);
    }

    #[test]
    fn trials_end_where_not_even_gains_that_shrink_fast_come_to_an_end() {
        // .07 promises .047 at best, and .0012 after four more doublings.
        assert_eq!(ends_at(&[0.675, 0.745], 250), 4000.0);
        assert_eq!(ends_at(&[0.745, 0.747], 250), 250.0);
        assert_eq!(ends_at(&[0.745, 0.740], 250), 250.0);
        assert_eq!(ends_at(&[0.745], 250), 0.0, "one score shows no trend");
    }

    #[test]
    fn photos_are_tried_on_at_half_their_size_and_never_larger() {
        assert_eq!([1000, 640, 160, 80].map(trial_size_of), [480, 320, 96, 80]);
    }
}
