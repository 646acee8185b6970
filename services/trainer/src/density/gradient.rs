//! Clone, split, prune and opacity reset by gradient threshold (Kerbl et al. 2023; absolute gradients as in
//! AbsGS), with its schedule scaled to the length of the run.

use super::control::{Density, DensityChange, DensityStats, StepObservation, Surroundings, top};
use super::reshaping::Reshaping;
use crate::{TrainError, TrainSettings};
use glam::Vec3;
use segwild_scene::logit;
use wincode::{SchemaRead, SchemaWrite};

/// Absolute screen gradient over which a splat is cloned or split.
const THRESHOLD: f32 = 8e-4;
/// Splats larger than this many pixels are split, smaller ones cloned.
const SPLIT_PIXELS: f32 = 3.0;
/// Below this opacity a splat is removed.
const MIN_OPACITY: f32 = 0.005;
/// What an opacity reset leaves.
const RESET: f32 = 0.01;

#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct Gradient {
    pub(super) stats: DensityStats,
    from: u32,
    until: u32,
    every: u32,
    reset_every: u32,
}

impl Gradient {
    pub fn new(settings: &TrainSettings, splats: usize) -> Gradient {
        let steps = settings.steps;
        Gradient {
            stats: DensityStats::new(splats),
            from: (steps / 20).min(500),
            until: steps / 2,
            every: (steps / 50).clamp(10, 100),
            // A run of 30 000 steps resets every 3000; one too short to recover never does.
            reset_every: if steps < 5000 { u32::MAX } else { (steps / 10).min(3000) },
        }
    }
}

impl Density for Gradient {
    fn observe(&mut self, seen: &StepObservation) {
        self.stats.observe(seen);
    }

    fn keep(&mut self, kept: &[usize]) {
        self.stats.keep(kept);
    }

    fn stats(&mut self) -> Option<&mut DensityStats> {
        Some(&mut self.stats)
    }

    fn acts(&self, step: u32) -> bool {
        step >= self.from && step <= self.until && step.is_multiple_of(self.every)
    }

    fn act(
        &mut self,
        all: &mut Reshaping,
        around: &mut Surroundings,
    ) -> Result<Option<DensityChange>, TrainError> {
        let step = around.step;
        let n = all.splats.len();
        let space = around.cap.saturating_sub(n);
        let wanted: Vec<f32> = (0..n)
            .map(|i| self.stats.mean(&self.stats.gradient, i))
            .map(|g| if g > THRESHOLD { g } else { 0.0 })
            .collect();
        let chosen = top(&wanted, space);
        let large = SPLIT_PIXELS * around.pixel;
        let (split, clone): (Vec<usize>, Vec<usize>) =
            chosen.iter().partition(|&&i| all.splats.scale(i).max_element() > large);
        // Originals, one extra of each clone, one extra of each split (its original becomes the other part).
        let parents: Vec<usize> = (0..n).chain(clone.iter().copied()).chain(split.iter().copied()).collect();
        all.remap(&parents);
        all.forget(n..parents.len());
        for (k, &i) in split.iter().enumerate() {
            let (axes, scale, centre) = (all.splats.rotation(i), all.splats.scale(i), all.splats.mean(i));
            for j in [i, n + clone.len() + k] {
                let offset =
                    Vec3::new(around.random.normal(), around.random.normal(), around.random.normal());
                all.splats.means[j] = (centre + axes * (scale * offset)).into();
                all.splats.log_scales[j] = scale.to_array().map(|s| (s / 1.6).ln());
            }
        }
        let keep: Vec<usize> = (0..all.splats.len())
            .filter(|&i| all.healthy(i) && all.splats.opacity(i) >= MIN_OPACITY)
            .filter(|&i| self.stats.radius.get(i).is_none_or(|&r| r < 1.0))
            .collect();
        let removed = all.splats.len() - keep.len();
        if removed > 0 && !keep.is_empty() {
            all.remap(&keep);
        }
        let opacity_reset = step.is_multiple_of(self.reset_every) && step < self.until;
        if opacity_reset {
            for o in &mut all.splats.opacities {
                *o = o.min(logit(RESET));
            }
            all.forget_opacities();
        }
        self.stats = DensityStats::new(all.splats.len());
        Ok(Some(DensityChange { added: chosen.len(), removed, opacity_reset, note: None }))
    }
}
