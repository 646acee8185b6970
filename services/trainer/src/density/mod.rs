//! Density control: how many splats, and where (method, sections 2 and 9).

mod budget;
mod gradient;
mod mcmc;
mod reshaping;

pub(crate) use budget::BudgetStrategy;
pub(crate) use gradient::Gradient;
pub(crate) use mcmc::Mcmc;
pub(crate) use reshaping::Reshaping;

use crate::initial::logit;
use crate::{DensityKind, TrainError, TrainSettings};
use glam::Vec3;
use segwild_raster::SplatGrads;
use segwild_scene::Random;
use segwild_scene::Splats;
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

/// One of the strategies, as a checkpoint holds it.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) enum Strategy {
    Budget(BudgetStrategy),
    Gradient(Gradient),
    Mcmc(Mcmc),
}

impl Strategy {
    /// The strategy that the settings name, for `splats` splats.
    pub fn new(settings: &TrainSettings, splats: usize) -> Strategy {
        match settings.density {
            DensityKind::Budget => Strategy::Budget(BudgetStrategy::new(settings, splats)),
            DensityKind::Gradient => Strategy::Gradient(Gradient::new(settings, splats)),
            DensityKind::Mcmc => Strategy::Mcmc(Mcmc::new(settings)),
        }
    }

    pub fn as_dyn(&mut self) -> &mut dyn Density {
        match self {
            Strategy::Budget(s) => s,
            Strategy::Gradient(s) => s,
            Strategy::Mcmc(s) => s,
        }
    }
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

    /// Per splat the sums in the order of [`segwild_objective::Held::sums`].
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

/// Replaces splats by two halves each, along their longest axis; the second halves go to the end.
///
/// A Gaussian of deviation s becomes two at +-d with deviation s' such that d^2 + s'^2 = s^2; the other axes
/// shrink a little and the opacity falls, so that the image hardly changes. The optimiser forgets both: its
/// first steps on new splats are then its longest, which is what puts them to use in short runs.
pub(crate) fn split_in_two(all: &mut Reshaping, which: &[usize]) {
    const OFFSET: f32 = 0.7;
    const SHRINK: f32 = 0.714;
    const NARROW: f32 = 0.85;
    let n = all.len();
    let parents: Vec<usize> = (0..n).chain(which.iter().copied()).collect();
    all.remap(&parents);
    all.forget((n..parents.len()).chain(which.iter().copied()));
    let splats = &mut all.splats;
    for (k, &i) in which.iter().enumerate() {
        let scale = splats.scale(i);
        let axis = (0..3).max_by(|&a, &b| scale[a].total_cmp(&scale[b])).expect("three axes");
        let direction: Vec3 = splats.rotation(i).col(axis) * scale[axis] * OFFSET;
        let lowered = logit((1.0 - (1.0 - splats.opacity(i)).powf(0.7)).clamp(0.004, 0.995));
        for (j, sign) in [(i, 1.0), (n + k, -1.0)] {
            for a in 0..3 {
                splats.means[j][a] += sign * direction[a];
                splats.log_scales[j][a] += if a == axis { SHRINK.ln() } else { NARROW.ln() };
            }
            splats.opacities[j] = lowered;
        }
    }
}

/// The `count` indices with the largest scores over 0, larger first; ties by index.
pub(crate) fn top(scores: &[f32], count: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..scores.len()).filter(|&i| scores[i] > 0.0).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]).then(a.cmp(&b)));
    order.truncate(count);
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::Params;
    use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
    use segwild_scene::{Camera, Image, Pose};

    /// Large and small splats of many opacities.
    fn splats() -> Splats {
        let mut r = Random::new(11);
        let mut s = Splats { sh_degree: 1, ..Splats::default() };
        for _ in 0..60 {
            s.means.push([r.normal() * 0.3, r.normal() * 0.3, r.normal() * 0.2]);
            s.log_scales.push([0, 1, 2].map(|_| (0.02 + 0.1 * r.uniform()).ln()));
            s.rotations.push([r.normal(), r.normal(), r.normal(), r.normal()]);
            s.opacities.push(r.normal() * 1.5);
            s.sh.extend((0..12).map(|_| 0.5 * r.normal()));
        }
        s
    }

    fn image(splats: &Splats) -> Image {
        let camera = Camera { width: 80, height: 60, fx: 80.0, fy: 80.0, cx: 40.0, cy: 30.0 };
        let pose = Pose::look_at(Vec3::new(0.0, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y);
        let engine = CpuEngine::new();
        let projected = engine.project(splats, &camera, &pose, &ProjectOptions::default()).unwrap();
        let colours = projected.shade();
        projected.blend(&Channels { count: 3, values: &colours }).unwrap().image
    }

    fn difference(a: &Image, b: &Image) -> f32 {
        a.data.iter().zip(&b.data).map(|(a, b)| (a - b).abs()).sum::<f32>() / a.data.len() as f32
    }

    #[test]
    fn splitting_and_relocating_hardly_change_the_image() {
        let mut params = Params::new(splats(), vec![0.0; 5 * 60]);
        let before = image(&params.splats);
        let mean = before.data.iter().map(|v| v.abs()).sum::<f32>() / before.data.len() as f32;
        let which: Vec<usize> = (0..60).step_by(2).collect();
        let mut reshaping = params.lend();
        split_in_two(&mut reshaping, &which);
        params.reshape(reshaping.done());
        assert_eq!(params.splats.len(), 90);
        params.consistent().unwrap();
        let split = difference(&before, &image(&params.splats));
        assert!(split < 0.12 * mean, "split {split} of {mean}");

        // Twelve invisible splats move onto four living ones, as relocation does.
        let mut moved = splats();
        let dead: Vec<usize> = (48..60).collect();
        dead.iter().for_each(|&i| moved.opacities[i] = -12.0);
        let before = image(&moved);
        let sources: Vec<usize> = (0..12).map(|k| 5 * (k % 4)).collect();
        mcmc::copy_splats(&mut moved, &sources, &dead);
        let relocated = difference(&before, &image(&moved));
        assert!(relocated < 0.05 * mean, "relocated {relocated} of {mean}");
        // The naive copy, nothing corrected, is far worse: the correction is what keeps the image.
        let mut naive = splats();
        dead.iter().for_each(|&i| naive.opacities[i] = -12.0);
        let pick: Vec<usize> = (0..48).chain(sources.iter().copied()).collect();
        assert!(difference(&before, &image(&naive.select(&pick))) > 3.0 * relocated);
    }

    #[test]
    fn arrays_stay_consistent_whatever_is_mapped() {
        let mut params = Params::new(splats(), vec![0.0; 5 * 60]);
        params.remap(&[3, 3, 59, 0]);
        params.raise_sh_degree(3);
        params.consistent().unwrap();
        let mut reshaping = params.lend();
        reshaping.remap(&[1, 2]);
        reshaping.forget(0..2);
        reshaping.forget_opacities();
        params.reshape(reshaping.done());
        params.consistent().unwrap();
        assert_eq!((params.splats.len(), params.splats.sh_degree, params.splats.sh.len()), (2, 3, 96));
        assert_eq!(top(&[0.5, 0.0, 2.0, 0.5, -1.0], 3), [2, 0, 3]);
    }
}
