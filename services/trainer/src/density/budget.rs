//! Grow while it pays, where gradient and error are large; prune what no photo needs (method, section 9).

use super::control::{Density, DensityChange, DensityStats, StepObservation, Surroundings, top};
use super::reshaping::{Reshaping, split_in_two};
use crate::{TrainError, TrainSettings};
use wincode::{SchemaRead, SchemaWrite};

/// Below this opacity a splat is removed.
const MIN_OPACITY: f32 = 0.01;
/// A splat that covers less than this many full-size pixels of all photos together is removed.
const UNSEEN: f32 = 0.5;
/// Checks in a row that must find that growth does not pay before it stops.
const PATIENCE: u32 = 3;
/// Most that one event adds, as a share of the splats there are.
const STRIDE: f64 = 0.6;

#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct BudgetStrategy {
    pub(super) stats: DensityStats,
    /// Splats at the start.
    first: usize,
    from: u32,
    until: u32,
    every: u32,
    /// Steps at which splats that no photo needs are pruned.
    prune_at: [u32; 2],
    gain: f32,
    /// Halvings of the photos when it last acted.
    level: usize,
    /// Quality, and logarithm of the count, when growth last paid, or at the first check.
    reference: Option<(f32, f32)>,
    /// Checks in a row that found that growth does not pay.
    idle: u32,
    stopped: bool,
}

impl BudgetStrategy {
    pub fn new(settings: &TrainSettings, splats: usize) -> BudgetStrategy {
        let steps = settings.steps;
        let at = |share: f32| (steps as f32 * share) as u32;
        BudgetStrategy {
            stats: DensityStats::new(splats),
            first: splats,
            from: at(0.04),
            until: at(0.6),
            every: (steps / 25).clamp(5, 150),
            prune_at: [at(0.62), at(0.85)],
            gain: settings.grow_gain,
            level: usize::MAX,
            reference: None,
            idle: 0,
            stopped: false,
        }
    }

    fn prunes(&self, step: u32) -> bool {
        self.prune_at.contains(&step)
    }

    fn grows(&self, step: u32) -> bool {
        step >= self.from && step <= self.until && step.is_multiple_of(self.every)
    }

    /// Splats there should be at a step: geometric from the first count to the cap over the first three
    /// quarters of the growing time.
    fn target(&self, step: u32, cap: usize) -> usize {
        let span = f64::from(self.until - self.from).max(1.0) * 0.75;
        let t = (f64::from(step.saturating_sub(self.from) + self.every) / span).min(1.0);
        let (a, b) = (self.first.max(1) as f64, cap as f64);
        (a * (b / a).powf(t)) as usize
    }

    /// Whether growth pays; `Some(note)` when it is to stop. Quality wavers from one visit of the photos to the next, so
    /// growth only stops when several checks in a row fall short of the last one that did not.
    fn check_growth(&mut self, quality: Option<f32>, n: usize) -> Option<String> {
        let quality = quality?;
        let now = (quality, (n as f32).ln());
        let Some((before, count)) = self.reference else {
            self.reference = Some(now);
            return None;
        };
        let grown = (now.1 - count) / 1.1f32.ln();
        if grown < 1.0 {
            return None;
        }
        let paid = (quality - before) / grown;
        if paid >= self.gain {
            self.reference = Some(now);
            self.idle = 0;
            return None;
        }
        self.idle += 1;
        (self.idle >= PATIENCE).then(|| {
            format!("growth stopped at {n} splats: the last 10 % gained {paid:.3} dB, under {:.3}", self.gain)
        })
    }
}

impl Density for BudgetStrategy {
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
        self.prunes(step) || self.grows(step)
    }

    fn act(
        &mut self,
        all: &mut Reshaping,
        around: &mut Surroundings,
    ) -> Result<Option<DensityChange>, TrainError> {
        let step = around.step;
        let (prune, grow) = (self.prunes(step), self.grows(step));
        let n = all.len();
        // No bound on the size in the image: the ground before a camera is large there.
        let mut keep: Vec<bool> =
            (0..n).map(|i| all.healthy(i) && all.splats.opacity(i) >= MIN_OPACITY).collect();
        if prune {
            let contribution = (around.contribution)(&all.splats)?;
            for i in 0..n {
                keep[i] &= contribution[i] >= UNSEEN;
            }
        }
        let mut note = None;
        let mut added = 0;
        let mut scores: Vec<f32> = (0..n)
            .map(|i| {
                let pull = self.stats.mean(&self.stats.gradient, i);
                let error = self.stats.mean(&self.stats.error, i);
                if keep[i] { pull * error } else { 0.0 }
            })
            .collect();
        let kept: Vec<usize> = (0..n).filter(|&i| keep[i]).collect();
        // A scene that would lose every splat keeps them all: an empty scene cannot recover.
        if !kept.is_empty() && kept.len() < n {
            all.remap(&kept);
            scores = kept.iter().map(|&i| scores[i]).collect();
        }
        if grow {
            let n = all.len();
            if self.level != around.level {
                // Qualities before and after are not comparable, and finer photos may support more splats.
                (self.level, self.reference, self.idle, self.stopped) = (around.level, None, 0, false);
            }
            if !self.stopped {
                note = self.check_growth(around.quality, n);
                self.stopped = note.is_some();
            }
            if !self.stopped {
                let target = self.target(step, around.cap).min((n as f64 * (1.0 + STRIDE)) as usize);
                let chosen = top(&scores, target.saturating_sub(n));
                added = chosen.len();
                split_in_two(all, &chosen);
            }
        }
        let removed = n + added - all.len();
        self.stats = DensityStats::new(all.len());
        Ok(Some(DensityChange { added, removed, opacity_reset: false, note }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Random, Splats};

    /// Splats of so many opacity logits, in a row along x, that all photos need.
    fn row(opacities: &[f32]) -> Reshaping {
        let n = opacities.len();
        let splats = Splats {
            means: (0..n).map(|i| [i as f32, 0.0, 0.0]).collect(),
            log_scales: vec![[-3.0; 3]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacities: opacities.to_vec(),
            sh: vec![0.0; 3 * n],
            ..Splats::default()
        };
        Reshaping::new(splats, vec![true; n])
    }

    /// One act of a strategy whose statistics are the same for every splat.
    fn act(
        budget: &mut BudgetStrategy,
        all: &mut Reshaping,
        step: u32,
        cap: usize,
        level: usize,
        quality: Option<f32>,
    ) {
        let n = all.len();
        let DensityStats { gradient, error, seen, .. } = &mut budget.stats;
        [gradient, error, seen].into_iter().for_each(|sums| *sums = vec![1.0; n]);
        let mut around = Surroundings {
            step,
            level,
            pixel: 0.01,
            cap,
            quality,
            random: &mut Random::new(1),
            contribution: &mut |splats| Ok(vec![1.0; splats.len()]),
        };
        budget.act(all, &mut around).unwrap();
    }

    /// The ground under a camera fills its photo, and is an ordinary splat in all others.
    #[test]
    fn the_ground_before_a_camera_stays_however_large_it_is_in_the_image() {
        let mut budget = BudgetStrategy::new(&TrainSettings { steps: 100, ..TrainSettings::default() }, 3);
        budget.stats.radius = vec![0.1, 4.0, 0.1];
        // The last is hardly there.
        let mut all = row(&[1.0, 1.0, -9.0]);
        assert!(budget.acts(10));
        act(&mut budget, &mut all, 10, 2, 0, None);
        assert_eq!(all.len(), 2);
    }

    /// All photos were visited at their new size before the next check of growth: it then stayed stopped, and a
    /// training of four times the steps ended with a quarter fewer splats.
    #[test]
    fn growth_that_stopped_on_coarse_photos_goes_on_with_finer_ones_in_long_trainings_too() {
        let settings = TrainSettings { steps: 1000, ..TrainSettings::default() };
        let mut all = row(&[1.0; 40]);
        let mut budget = BudgetStrategy::new(&settings, all.len());
        // A quality that never rises ends growth, and it stays ended on photos of that size.
        for step in [40, 80, 120, 160, 200, 240] {
            act(&mut budget, &mut all, step, 1000, 2, Some(20.0));
        }
        assert!(budget.stopped);
        let coarse = all.len();
        act(&mut budget, &mut all, 280, 1000, 2, Some(25.0));
        assert_eq!(all.len(), coarse);
        act(&mut budget, &mut all, 320, 1000, 1, Some(20.0));
        assert!(!budget.stopped && all.len() > coarse, "{coarse} splats before, {} after", all.len());
    }
}
