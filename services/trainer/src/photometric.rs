//! The photo's half of a step: the inputs of its photometric loss, and what appearance, background and robust masks learn
//! from the output. The loss itself is computed where the splats are ([`segwild_objective::compare`]).

use crate::TrainSettings;
use crate::appearances::{self, AffineColour};
use crate::painter::Painter;
use crate::photos::{PhotoLevel, Stored};
use crate::posed::Posed;
use crate::schedule::Schedule;
use segwild_objective::AnyAppearance;
use segwild_objective::background::Background;
use segwild_objective::compare::{LeaveOut, LossInputs, LossOutput, PhotoTarget};
use segwild_objective::transients::ResidualHistograms;
use segwild_scene::{Camera, Mask, Pose};

/// The photo of a step, at the size of the step.
pub(crate) struct StepPhoto<'a> {
    pub view: usize,
    pub stored: &'a Stored,
    pub level: usize,
    pub photo: &'a PhotoLevel,
    pub camera: Camera,
    pub pose: Pose,
}

/// What a step changes beside the splats.
pub(crate) struct PhotoSide<'a> {
    pub appearance: &'a mut AnyAppearance,
    pub background: &'a mut Background,
    pub robust: &'a mut ResidualHistograms,
    pub initial_transients: Option<&'a Mask>,
    pub quality: &'a mut Option<f32>,
    pub step: u32,
    /// Until this step residuals are no evidence of transients.
    pub pause_until: u32,
    /// Whether appearance and background stay as they are.
    pub fixed: bool,
}

impl PhotoSide<'_> {
    /// Renders the photo's view.
    pub fn painter(&self, view: usize) -> Painter<'_> {
        Painter { view, appearance: self.appearance, background: self.background }
    }

    /// The photo with the flags of its pixels; their trust by points only where that is `wanted`.
    pub fn target(&self, step_photo: &StepPhoto, posed: &Posed, wanted: bool) -> PhotoTarget {
        let initial_transients = self.initial_transients.filter(|_| self.may_show_transients(step_photo));
        let trust = if wanted { posed.trusted(step_photo.photo) } else { Vec::new() };
        step_photo.photo.target(initial_transients, trust)
    }

    /// Whether transients are searched for in the photo.
    pub fn may_show_transients(&self, step_photo: &StepPhoto) -> bool {
        step_photo.stored.transient_share(self.robust.shares()[step_photo.view]) > 0.0
    }

    /// The background, in the scene's colours.
    pub fn scene_background(&self, view: usize) -> Background {
        appearances::background_before(self.background, &appearances::matrix(self.appearance, view))
    }

    /// The inputs of the photo's loss, over such a background.
    pub fn loss_inputs<'a>(
        &'a self,
        settings: &TrainSettings,
        schedule: &Schedule,
        step_photo: &'a StepPhoto,
        background: &'a Background,
    ) -> LossInputs<'a> {
        let unknown = self.may_show_transients(step_photo);
        let active = settings.robust && schedule.robust(self.step) && self.step >= self.pause_until;
        let leave_out = if active && unknown {
            LeaveOut::Residual(self.robust.known(step_photo.view))
        } else if self.initial_transients.is_some() && unknown {
            LeaveOut::InitialTransients
        } else {
            LeaveOut::None
        };
        let matrix: Option<AffineColour> = match &*self.appearance {
            AnyAppearance::Affine(appearance) => Some(appearance.matrix(step_photo.view)),
            AnyAppearance::None(_) | AnyAppearance::Embed(_) | AnyAppearance::Gsw(_) => None,
        };
        LossInputs {
            camera: &step_photo.camera,
            pose: &step_photo.pose,
            matrix,
            background: &background.coefficients,
            has_sky: step_photo.stored.has_sky,
            leave_out,
            lambda_ssim: settings.lambda_ssim,
            sky_weight: settings.sky_weight,
        }
    }

    /// Lets appearance, background and robust masks learn from the loss output of the photo.
    pub fn apply(&mut self, step_photo: &StepPhoto, output: &LossOutput) {
        *self.quality = Some(output.psnr);
        if let Some(residuals) = &output.residuals {
            self.robust.update(step_photo.view, residuals.clone());
        }
        if self.fixed {
            return;
        }
        if let (AnyAppearance::Affine(appearance), Some(grad)) = (&mut *self.appearance, &output.matrix) {
            appearance.add_gradient(step_photo.view, grad);
        }
        self.background.learn(&output.background);
    }
}
