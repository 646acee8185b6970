//! The settings of the training.

use crate::TrainError;
use crate::blocks::{SEAMS, is_divisible};
use segwild_objective::GswWidth;
use segwild_scene::Scene;
use segwild_scene::settings::Group;

/// Steps for the square root of the photos, at an effort of 1.
const STEPS: f32 = 200.0;
/// So many times as many where photos are of one light: seven of eight such scenes gain by them, and scenes of many lights
/// do not (docs/experiments/2026-11-27-transients-by-evidence.md).
const ONE_LIGHT_STEPS: f32 = 1.25;

segwild_scene::choice! {
    /// How the number of splats is controlled.
    pub enum DensityKind {
        /// Grow where gradient and error are large, only while it pays, and prune what no photo needs.
        Budget = "budget",
        /// Clone, split, prune and opacity reset by gradient threshold, as 3D Gaussian splatting does.
        Gradient = "gradient",
        /// A fixed cap, dead splats relocated, noise on the centres (3DGS as Markov chain Monte Carlo).
        Mcmc = "mcmc",
    }
}

segwild_scene::choice! {
    /// How much each photo may differ in light and camera.
    pub enum AppearanceModel {
        /// All photos share one appearance.
        None = "none",
        /// A colour matrix with offset per photo.
        Affine = "affine",
        /// The same, and light that falls on each splat in its own way: sun and shadow.
        Embed = "embed",
        /// The simplest of these that suffices, chosen by points and short fits before the training.
        Auto = "auto",
        /// A network predicts the light from the photo (GS-W).
        Gsw = "gsw",
    }
}

segwild_scene::choice! {
    /// How much time to spend.
    pub enum Preset {
        /// A first result within minutes.
        Draft = "draft",
        /// Good enough to click objects.
        Standard = "standard",
        /// As good as this program gets.
        Best = "best",
        /// The numbers of Seg-Wild's paper, as far as they are settings: for comparisons, not for results.
        Paper = "paper",
    }
}

segwild_scene::settings! {
    /// Training of the splats. Schedules are fractions of `steps`, so any number of steps is a whole training.
    pub struct TrainSettings("train", user: steps effort splats appearance_model seed) {
        /// Training steps, a photo each; 0 lets the scene decide. That is 200 times the square root of its photos, and 250
        /// times where they are of one light.
        steps: u32 = 0 => 0..=10_000_000,
        /// Factor on the steps that the scene decides. More than 2 overfits the photos.
        effort: f32 = 1.0 => 0.01..=100.0,
        /// Most splats; 0 lets the scene decide. That is 16 times the square root of all photos' pixels, and 20 times where they
        /// are of one light, less the share of the sky: between 2000 and 200000, and no fewer than points, up to 20000 of them.
        splats: usize = 0,
        /// Share of the most splats allowed that start from points: the reconstruction's, and between them points that photos
        /// agree on when they are compared with one another (stereo). 0: the reconstruction's alone.
        stereo: f32 = 0.6 => 0.0..=1.0,
        /// How the number of splats is controlled.
        density: DensityKind = DensityKind::Budget,
        /// Spherical-harmonics degree of the colours, 0 to 3.
        sh_degree: u32 = 2 => 0..=3,
        /// How much each photo may differ in light and camera.
        appearance_model: AppearanceModel = AppearanceModel::Auto,
        /// Width of the networks of the appearance model `gsw`.
        gsw_width: GswWidth = GswWidth::Cpu,
        /// Leave out pixels that keep contradicting the scene: people, cars and other transients.
        robust: bool = true,
        /// Largest share of a photo that may be left out as transient.
        robust_share: f32 = 0.35 => 0.0..=0.6,
        /// Refine camera poses that are off: by the points that the photo saw, or where these are too few and photos are of one
        /// light, by aligning the photo to the splats.
        refine_poses: bool = true,
        /// Short trainings on small photos that find initial transients before the training itself: each leaves out a
        /// part of the photos and marks the pixels in them that contradict it. 0 or 2 and more.
        cross_checks: u32 = 2 => 0..=8,
        /// Seed of everything random. The same seed gives the same bytes.
        seed: u64 = 1,
        /// Learning rate of the centres at the start, in pixels of the photo at the scene's median depth.
        lr_mean: f32 = 0.5 => 0.0..=10.0,
        /// Learning rate of the opacity logits.
        lr_opacity: f32 = 0.05 => 0.0..=10.0,
        /// Learning rate of the log scales.
        lr_scale: f32 = 0.03 => 0.0..=10.0,
        /// Learning rate of the rotations.
        lr_rotation: f32 = 0.005 => 0.0..=10.0,
        /// Learning rate of the base colours; higher degrees take a twentieth.
        lr_colour: f32 = 0.005 => 0.0..=10.0,
        /// Learning rate of the per-photo appearance.
        lr_appearance: f32 = 0.002 => 0.0..=10.0,
        /// Learning rate of the networks of the appearance model `gsw`.
        lr_net: f32 = 0.002 => 0.0..=10.0,
        /// Learning rate of the per-splat appearance embeddings of `embed` and `gsw`.
        lr_splat_embedding: f32 = 0.01 => 0.0..=10.0,
        /// Share of the steps before those embeddings are trained: shapes that were trained without them fit
        /// their objects better.
        splat_embedding_from: f32 = 0.25 => 0.0..=1.0,
        /// Weight of 1 - SSIM in the loss; the rest is L1. The paper's 0.2 is for photos of one light: SSIM cares less for
        /// what a photo's light and camera change.
        lambda_ssim: f32 = 0.5 => 0.0..=1.0,
        /// Weight of LPIPS, the perceptual distance, in the loss; the paper has 0.005. It needs `lpips_weights`, is computed on the
        /// CPU and takes most of a step's time. 0: without it.
        lambda_lpips: f32 = 0.0 => 0.0..=10.0,
        /// Weight of the loss that keeps the sky empty.
        sky_weight: f32 = 0.5 => 0.0..=100.0,
        /// Share of the steps trained on photos at reduced size.
        coarse: f32 = 0.3 => 0.0..=1.0,
        /// Lower opacities by what the pixel filter widens, so that small splats do not grow brighter. False: as plain Gaussian
        /// splatting does, for viewers that cannot (docs/reference/exports.md).
        antialias: bool = true,
        /// Stop growing when 10 % more splats gain less than this many dB on the training photos.
        grow_gain: f32 = 0.01 => 0.0..=100.0,
        /// When the intermediate scene for the mask stage is taken, as a share of the steps; of a scene in several blocks at
        /// 0.9 at the earliest.
        snapshot_at: f32 = 0.5 => 0.0..=1.0,
        /// Blocks that the scene is trained in, one after another; splats outside a block are rendered and not trained,
        /// so that the training takes less memory, and longer. 0: one, or where that does not fit in the memory budget
        /// as many as it needs.
        blocks: usize = 0 => 0..=64,
        /// Memory for decoded photos, in MiB; older ones are read again when needed.
        photo_cache_mib: usize = 256 => 0..=1 << 20,
    }
}

impl Preset {
    /// The settings this preset stands for.
    pub fn settings(self) -> TrainSettings {
        let standard = TrainSettings::default();
        match self {
            Preset::Draft => TrainSettings { effort: 0.5, sh_degree: 1, stereo: 0.0, ..standard },
            Preset::Standard => standard,
            Preset::Best => TrainSettings { effort: 1.5, sh_degree: 3, ..standard },
            // Sections 2 and 3 of docs/method.md; what differs all the same stands in docs/guide/research.md.
            Preset::Paper => TrainSettings {
                steps: 70_000,
                density: DensityKind::Gradient,
                sh_degree: 3,
                stereo: 0.0,
                appearance_model: AppearanceModel::Gsw,
                gsw_width: GswWidth::Paper,
                refine_poses: false,
                cross_checks: 0,
                lr_scale: 0.005,
                lr_rotation: 0.001,
                lr_colour: 0.0025,
                lr_splat_embedding: 1.25e-4,
                splat_embedding_from: 0.0,
                lambda_ssim: 0.2,
                sky_weight: 0.0,
                coarse: 0.0,
                antialias: false,
                ..standard
            },
        }
    }
}

impl TrainSettings {
    /// Refuses values outside their range; the error names the setting.
    pub fn check(&self) -> Result<(), TrainError> {
        Group::check(self).map_err(|e| TrainError::Setting(e.to_string()))?;
        if self.cross_checks == 1 {
            let why =
                "`cross_checks` is 1, and a training that leaves out all photos has none: 0, or 2 and more";
            return Err(TrainError::Setting(why.into()));
        }
        match self.appearance_model {
            AppearanceModel::Auto => Err(TrainError::Setting(
                "`appearance_model` is `auto`, which is decided before the training (`choose_appearance`)"
                    .into(),
            )),
            _ => Ok(()),
        }
    }

    /// The most of a photo that may be transients.
    pub(crate) fn transient_share(&self) -> f32 {
        if self.robust { self.robust_share } else { 0.0 }
    }

    /// With the number of steps for the scene's photos, where that is left to the scene, and with one block where the
    /// scene cannot be divided.
    #[must_use]
    pub fn decided(&self, scene: &Scene) -> TrainSettings {
        let photos = scene.views.iter().filter(|v| !v.test).count();
        if scene.imported.is_some() {
            // Nothing is trained: a step is the fit of a photo's appearance.
            return TrainSettings { steps: photos as u32, effort: 1.0, ..self.clone() };
        }
        let blocks = if self.blocks > 1 && !is_divisible(scene, self.blocks) { 1 } else { self.blocks };
        let divided = TrainSettings { blocks, ..self.clone() };
        // The effort is part of the steps now.
        TrainSettings { steps: divided.steps_for(photos), effort: 1.0, ..divided }
    }

    /// Of the splats that a training may come to, as many as it has at first: those of a block, where there are
    /// several.
    pub(crate) fn first_cap(&self, most: usize) -> usize {
        (most / self.blocks.max(1)).max(1)
    }

    /// Photos of one scene overlap: they count by the square root (docs/experiments/2026-11-22-how-many-steps.md).
    /// Blocks are scenes of fewer photos each.
    fn steps_for(&self, photos: usize) -> u32 {
        match self.steps {
            0 => {
                let photos = photos as f32 * self.blocks.max(1) as f32;
                let steps = (self.effort * STEPS * photos.sqrt()).round().max(1.0) as u32;
                if self.appearance_model == AppearanceModel::None { one_light_steps(steps) } else { steps }
            }
            steps => steps,
        }
    }

    /// The step after which [`crate::Trainer::snapshot`] is to be taken for the mask stage; at least 1.
    pub fn snapshot_step(&self) -> u32 {
        // With several blocks not before each had its turn: until then most of the scene is coarse.
        let at = if self.blocks > 1 { self.snapshot_at.max(1.0 - SEAMS) } else { self.snapshot_at };
        ((f64::from(at) * f64::from(self.steps)).round() as u32).clamp(1, self.steps)
    }
}

/// The steps of a scene whose photos turn out to be of one light, from those that were decided for any light.
pub(crate) fn one_light_steps(steps: u32) -> u32 {
    (ONE_LIGHT_STEPS * steps as f32).round() as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_times_the_photos_take_twice_the_steps() {
        let standard = TrainSettings::default();
        assert_eq!((standard.steps_for(25), standard.steps_for(100)), (1000, 2000));
        assert_eq!(Preset::Draft.settings().steps_for(25), 500);
        let one_light = TrainSettings { appearance_model: AppearanceModel::None, ..standard.clone() };
        assert_eq!((one_light.steps_for(25), one_light_steps(standard.steps_for(25))), (1250, 1250));
        assert_eq!(standard.steps_for(0), 1, "a scene without photos is refused in other words");
        let [one, four] = [1, 4].map(|blocks| TrainSettings { blocks, ..standard.clone() }.steps_for(100));
        assert_eq!((one, four), (2000, 4000), "four blocks of 25 photos take 1000 steps each");
        assert_eq!(TrainSettings { steps: 77, ..Preset::Best.settings() }.steps_for(25), 77);
    }
}
