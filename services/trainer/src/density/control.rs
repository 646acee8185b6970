//! What a strategy of density control observes and does.

use super::reshaping::Reshaping;
use crate::TrainError;
use segwild_raster::SplatGrads;
use segwild_scene::{Random, Splats};
use wincode::{SchemaRead, SchemaWrite};

/// What density control observes of every splat in one step.
pub(crate) struct StepObservation<'a> {
    /// Radius in pixels of the image rendered; 0 for a culled splat.
    pub radii: &'a [f32],
    /// Gradients of this step.
    pub grads: &'a SplatGrads,
    /// Mean colour error around each splat's centre; 0 outside the frame.
    pub error: &'a [f32],
    /// Long side of the image rendered, in pixels.
    pub long_side: f32,
}

/// Inputs of a strategy when it acts.
pub(crate) struct Surroundings<'a> {
    /// Steps done.
    pub step: u32,
    /// Halvings of the photos of the last step.
    pub level: usize,
    /// Scene units per full-size pixel at the scene's median depth.
    pub pixel: f32,
    /// Most splats allowed.
    pub cap: usize,
    /// Mean over the training photos of -10 log10 of the last squared error, if all were seen at this size.
    pub quality: Option<f32>,
    /// Random numbers.
    pub random: &'a mut Random,
    /// Per splat, the sum of `alpha T` over all training photos, in full-size pixels.
    pub contribution: &'a mut dyn FnMut(&Splats) -> Result<Vec<f32>, TrainError>,
}

/// What a strategy did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DensityChange {
    /// Splats added.
    pub added: usize,
    /// Splats removed or moved elsewhere.
    pub removed: usize,
    /// All opacities were lowered: for a while residuals are no evidence of transients.
    pub opacity_reset: bool,
    /// A decision worth printing, with its evidence.
    pub note: Option<String>,
}

/// A density control strategy. Its state is part of a checkpoint.
pub(crate) trait Density {
    /// Accumulates a step's observation; called after every backward pass.
    fn observe(&mut self, seen: &StepObservation);

    /// Adds terms of its own to the gradients.
    fn regularise(&self, _splats: &Splats, _grads: &mut SplatGrads) {}

    /// Called when only these splats are left, in this order.
    fn keep(&mut self, _kept: &[usize]) {}

    /// The sums it accumulates over the steps, if it does nothing else between its acts: then the splats may be
    /// on the device meanwhile.
    fn stats(&mut self) -> Option<&mut DensityStats> {
        None
    }

    /// Whether it acts after so many steps.
    fn acts(&self, step: u32) -> bool;

    /// Changes the splats after an optimiser step after which it [`Density::acts`].
    fn act(
        &mut self,
        splats: &mut Reshaping,
        around: &mut Surroundings,
    ) -> Result<Option<DensityChange>, TrainError>;
}

/// Running sums per splat since the last change.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct DensityStats {
    /// Sum of screen gradients.
    pub gradient: Vec<f32>,
    /// Sum of errors around the centre.
    pub error: Vec<f32>,
    /// Steps that saw the splat.
    pub seen: Vec<f32>,
    /// Largest radius, as a share of the image's long side.
    pub radius: Vec<f32>,
}

impl DensityStats {
    pub fn new(n: usize) -> DensityStats {
        DensityStats { gradient: vec![0.0; n], error: vec![0.0; n], seen: vec![0.0; n], radius: vec![0.0; n] }
    }

    pub fn observe(&mut self, seen: &StepObservation) {
        for i in 0..self.seen.len() {
            if seen.radii[i] > 0.0 {
                self.gradient[i] += seen.grads.screen_abs[i];
                self.error[i] += seen.error[i];
                self.seen[i] += 1.0;
                self.radius[i] = self.radius[i].max(seen.radii[i] / seen.long_side);
            }
        }
    }

    /// Keeps these splats only, in this order.
    pub fn keep(&mut self, kept: &[usize]) {
        for sums in [&mut self.gradient, &mut self.error, &mut self.seen, &mut self.radius] {
            *sums = kept.iter().map(|&i| sums[i]).collect();
        }
    }

    /// Whether there are the sums of so many splats: those that come out of a file may be damaged.
    pub fn fits(&self, splats: usize) -> bool {
        let DensityStats { gradient, error, seen, radius } = self;
        [gradient, error, seen, radius].into_iter().all(|sums| sums.len() == splats)
    }

    /// Per splat the sums in the order of [`segwild_objective::TrainingSplats::sums`].
    pub fn rows(&self) -> Vec<[f32; 4]> {
        let sums = self.gradient.iter().zip(&self.error).zip(&self.seen).zip(&self.radius);
        sums.map(|(((&g, &e), &s), &r)| [g, e, s, r]).collect()
    }

    /// The sums of such rows.
    pub fn of_rows(rows: &[[f32; 4]]) -> DensityStats {
        let column = |k: usize| rows.iter().map(|row| row[k]).collect();
        DensityStats { gradient: column(0), error: column(1), seen: column(2), radius: column(3) }
    }

    /// Mean of a sum over the steps that saw splat `i`.
    pub fn mean(&self, sum: &[f32], i: usize) -> f32 {
        if self.seen[i] > 0.0 { sum[i] / self.seen[i] } else { 0.0 }
    }
}

/// The `count` indices with the largest scores over 0, larger first; ties by index.
pub(crate) fn top(scores: &[f32], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..scores.len()).filter(|&i| scores[i] > 0.0).collect();
    let larger = |a: &usize, b: &usize| scores[*b].total_cmp(&scores[*a]).then(a.cmp(b));
    // Only the largest are sorted: of millions of splats a few per cent grow.
    if count < order.len() {
        order.select_nth_unstable_by(count, larger);
        order.truncate(count);
    }
    order.sort_unstable_by(larger);
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_scores_come_first_and_equal_ones_by_index() {
        let scores: Vec<f32> = (0..1000).map(|i| ((i * 7919) % 37) as f32 - 5.0).chain([f32::NAN]).collect();
        let mut all: Vec<usize> = (0..1000).filter(|&i| scores[i] > 0.0).collect();
        all.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
        for count in [0, 1, 100, all.len() - 1, all.len(), 2000] {
            assert_eq!(top(&scores, count), all[..count.min(all.len())], "{count}");
        }
    }
}
