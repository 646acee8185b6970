//! The state of a training.

use crate::TrainError;
use crate::density::{Density, Strategy};
use crate::painter::Painter;
use crate::params::Params;
use crate::photometric::PhotoSide;
use crate::refined_pose::RefinedPose;
use crate::sampler::Sampler;
use crate::splat_budget::SplatBudget;
use segwild_objective::AnyAppearance;
use segwild_objective::background::{BASES, Background};
use segwild_objective::transients::ResidualHistograms;
use segwild_scene::{Mask, Random};
use wincode::{SchemaRead, SchemaWrite};

/// Everything that a step changes: what a checkpoint holds.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct TrainState {
    pub step: u32,
    pub params: Params,
    pub strategy: Strategy,
    pub appearance: AnyAppearance,
    /// Per view of the scene, in the photo's colours; `None` until the photo's first step.
    pub backgrounds: Vec<Option<Background>>,
    pub robust: ResidualHistograms,
    /// Per view, its initial transients.
    pub initial_transients: Vec<Option<Mask>>,
    pub sampler: Sampler,
    pub random: Random,
    /// Per view, -10 log10 of the last squared error at the present size.
    pub quality: Vec<Option<f32>>,
    /// Per view, its refined pose; `None` where the given one stays.
    pub refined: Vec<Option<RefinedPose>>,
    /// Per view, whether the points that it saw leave its pose open.
    pub open_poses: Vec<bool>,
    /// Photos that turned out not to be usable: name and reason.
    pub skipped: Vec<(String, String)>,
    /// Until this step residuals are no evidence of transients.
    pub pause_until: u32,
    /// Scene units per full-size pixel at the scene's median depth.
    pub pixel: f32,
    /// Most splats there may be.
    pub splat_budget: SplatBudget,
    /// Sums of loss, PSNR and share left out since they were last taken, and over how many steps.
    pub since: ([f32; 3], u32),
}

impl TrainState {
    /// The views that are trained on, in ascending order: where there are several blocks, all whose photos had a step
    /// and can still be used. `name`: that of a view.
    pub fn trained_views<'a>(&self, blocks: usize, name: impl Fn(usize) -> &'a str) -> Vec<usize> {
        let takes_part = |view: &usize| self.backgrounds[*view].is_some() && !self.is_skipped(name(*view));
        if blocks > 1 {
            (0..self.backgrounds.len()).filter(takes_part).collect()
        } else {
            self.sampler.views()
        }
    }

    /// Whether the photo of this name has turned out not to be usable.
    pub fn is_skipped(&self, name: &str) -> bool {
        self.skipped.iter().any(|(skipped, _)| skipped == name)
    }

    /// Renders a view that had a step before.
    pub fn painter(&self, view: usize) -> Painter<'_> {
        let background = self.backgrounds[view].as_ref().expect("set at the first step of the view");
        Painter { view, appearance: &self.appearance, background }
    }

    /// What a step changes: the splats and their density control, and what it changes beside them. `fixed`: whether the
    /// photo's appearance and background stay as they are.
    pub fn halves(&mut self, view: usize, fixed: bool) -> (&mut Params, &mut dyn Density, PhotoSide<'_>) {
        let side = PhotoSide {
            appearance: &mut self.appearance,
            background: self.backgrounds[view].as_mut().expect("set at the first step of the view"),
            robust: &mut self.robust,
            initial_transients: self.initial_transients[view].as_ref(),
            quality: &mut self.quality[view],
            step: self.step,
            pause_until: self.pause_until,
            fixed,
        };
        (&mut self.params, self.strategy.as_dyn(), side)
    }

    /// Refuses a state whose parts do not fit each other or the scene.
    pub fn check(&self, views: usize) -> Result<(), TrainError> {
        let lists = [
            self.backgrounds.len(),
            self.quality.len(),
            self.initial_transients.len(),
            self.refined.len(),
            self.open_poses.len(),
        ];
        let per_view = lists.into_iter().chain([self.robust.shares().len(), self.robust.evidence().len()]);
        if per_view.into_iter().any(|n| n != views) || self.sampler.views().iter().any(|&v| v >= views) {
            return Err(TrainError::Checkpoint("it is damaged: its lists of photos differ in length".into()));
        }
        if !self.robust.consistent() {
            return Err(TrainError::Checkpoint(
                "it is damaged: its histograms of residuals do not fit its photos".into(),
            ));
        }
        let sound = |background: &Background| (1..=BASES).contains(&background.coefficients.len());
        if !self.backgrounds.iter().flatten().all(sound) {
            return Err(TrainError::Checkpoint(
                "it is damaged: a background has another number of coefficients".into(),
            ));
        }
        if !self.strategy.fits(self.params.trained()) {
            return Err(TrainError::Checkpoint(
                "it is damaged: the sums of its density control do not fit its splats".into(),
            ));
        }
        if !self.refined.iter().flatten().all(RefinedPose::is_sound) {
            return Err(TrainError::Checkpoint(
                "it is damaged: a refined pose is no rotation with a finite translation".into(),
            ));
        }
        let size = self.appearance.as_appearance().embedding_size();
        if !appearance_fits(&self.appearance, views)
            || self.params.splat_embeddings.len() != size * self.params.splats.len()
        {
            return Err(TrainError::Checkpoint(
                "it is damaged: its appearance does not fit its splats".into(),
            ));
        }
        self.params.consistent().map_err(|e| TrainError::Checkpoint(format!("it is damaged: {e}")))
    }
}

/// Whether an appearance that comes out of a file has all its parts for so many views, and for the mean of them.
pub(crate) fn appearance_fits(appearance: &AnyAppearance, views: usize) -> bool {
    match appearance {
        AnyAppearance::None(_) => true,
        AnyAppearance::Affine(appearance) => appearance.consistent(views + 1),
        AnyAppearance::Embed(appearance) => appearance.consistent(views + 1),
        AnyAppearance::Gsw(appearance) => appearance.consistent(views + 1),
    }
}

/// Mean over the photos seen at the present size, when most of them were.
pub(crate) fn mean_quality(views: &[usize], quality: &[Option<f32>]) -> Option<f32> {
    let known: Vec<f32> = views.iter().filter_map(|&v| quality[v]).collect();
    (!known.is_empty() && known.len() * 10 >= views.len().min(100) * 9)
        .then(|| known.iter().sum::<f32>() / known.len() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{TrainSettings, appearances};
    use segwild_scene::Splats;

    /// Of one photo and one splat.
    fn state() -> TrainState {
        let settings = TrainSettings::default();
        let splats = Splats {
            means: vec![[0.0; 3]],
            log_scales: vec![[-3.0; 3]],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]],
            opacities: vec![1.0],
            sh: vec![0.0; 3],
            ..Splats::default()
        };
        TrainState {
            step: 1,
            params: Params::new(splats, Vec::new()),
            strategy: Strategy::new(&settings, 1),
            appearance: appearances::initial(&settings, 1),
            backgrounds: vec![Some(Background::constant([0.5; 3]))],
            robust: ResidualHistograms::new(vec![0.2], vec![None]),
            initial_transients: vec![None],
            sampler: Sampler::new(&[0]),
            random: Random::new(1),
            quality: vec![None],
            refined: vec![None],
            open_poses: vec![false],
            skipped: Vec::new(),
            pause_until: 0,
            pixel: 0.01,
            splat_budget: SplatBudget::new(&settings, 1, 1, 100),
            since: ([0.0; 3], 0),
        }
    }

    #[test]
    fn a_forged_checkpoint_is_refused_before_a_step_panics() {
        state().check(1).unwrap();
        let background = |n: usize| Some(Background { coefficients: vec![[0.5; 3]; n] });
        let histogram = |n: usize| {
            let mut robust = ResidualHistograms::new(vec![0.2], vec![None]);
            robust.update(0, vec![0.0; n]);
            robust
        };
        let strategy = |n: usize| Strategy::new(&TrainSettings::default(), n);
        for (forged, words) in [
            (TrainState { backgrounds: vec![background(0)], ..state() }, "coefficients"),
            (TrainState { backgrounds: vec![background(BASES + 1)], ..state() }, "coefficients"),
            (TrainState { robust: histogram(3), ..state() }, "histograms"),
            (TrainState { strategy: strategy(0), ..state() }, "density control"),
            (TrainState { strategy: strategy(2), ..state() }, "density control"),
        ] {
            let refused = forged.check(1).unwrap_err();
            assert!(matches!(refused, TrainError::Checkpoint(_)), "{refused}");
            assert!(refused.to_string().contains(words), "{refused}");
        }
    }
}
