//! Density control: how many splats, and where (method, sections 2 and 9).

mod budget;
mod control;
mod gradient;
mod mcmc;
mod reshaping;

pub use control::DensityChange;
pub(crate) use control::{Density, DensityStats, StepObservation, Surroundings};
pub(crate) use reshaping::Reshaping;

use crate::{DensityKind, TrainSettings};
use budget::BudgetStrategy;
use gradient::Gradient;
use mcmc::Mcmc;
use wincode::{SchemaRead, SchemaWrite};

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

    /// Whether what it has summed up is that of so many splats: what comes out of a file may be damaged.
    pub fn fits(&self, splats: usize) -> bool {
        match self {
            Strategy::Budget(s) => s.stats.fits(splats),
            Strategy::Gradient(s) => s.stats.fits(splats),
            Strategy::Mcmc(_) => true,
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

#[cfg(test)]
mod tests {
    use super::control::top;
    use super::mcmc;
    use super::reshaping::split_in_two;
    use crate::params::Params;
    use glam::Vec3;
    use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
    use segwild_scene::{Camera, Image, Pose, Random, Splats};

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
