//! The photo's half of a step: what it is compared under, and what look, background and robust masks learn from that. The
//! comparison itself is where the splats are ([`segwild_raster::compare`]).

use crate::TrainSettings;
use crate::appearances::{self, Affine};
use crate::background::Background;
use crate::photos::{Level, Stored};
use crate::posed::Posed;
use crate::robust::Robust;
use crate::schedule::Schedule;
use crate::state::Painter;
use segwild_raster::AnyAppearance;
use segwild_raster::compare::{LeaveOut, LossInputs, LossOutput, Target};
use segwild_scene::{Camera, Mask, Pose};

/// The photo that a step looks at, at the size it looks at.
pub(crate) struct Looked<'a> {
    pub view: usize,
    pub stored: &'a Stored,
    pub level: usize,
    pub photo: &'a Level,
    pub camera: Camera,
    pub pose: Pose,
}

/// What a step changes beside the splats.
pub(crate) struct PhotoSide<'a> {
    pub appearance: &'a mut AnyAppearance,
    pub background: &'a mut Background,
    pub robust: &'a mut Robust,
    pub initial_transients: Option<&'a Mask>,
    pub quality: &'a mut Option<f32>,
    pub step: u32,
    /// Until this step residuals say nothing of transients.
    pub pause_until: u32,
}

impl PhotoSide<'_> {
    /// What draws the photo's view.
    pub fn painter(&self, view: usize) -> Painter<'_> {
        Painter { view, appearance: self.appearance, background: self.background }
    }

    /// The photo, with what is known of its pixels; how far points vouch for them only where that is `wanted`.
    pub fn target(&self, looked: &Looked, posed: &Posed, wanted: bool) -> Target {
        let initial_transients = self.initial_transients.filter(|_| !looked.stored.transients_known);
        let trust = if wanted { posed.trusted(looked.photo) } else { Vec::new() };
        looked.photo.target(initial_transients, trust)
    }

    /// The colours behind the splats, in the scene's colours.
    pub fn behind(&self, view: usize) -> Background {
        self.background.before(&appearances::matrix(self.appearance, view))
    }

    /// What the photo is compared under, before such a background.
    pub fn loss_inputs<'a>(
        &'a self,
        settings: &TrainSettings,
        schedule: &Schedule,
        looked: &'a Looked,
        behind: &'a Background,
    ) -> LossInputs<'a> {
        let unknown = !looked.stored.transients_known;
        let active = settings.robust && schedule.robust(self.step) && self.step >= self.pause_until;
        let leave_out = if active && unknown {
            LeaveOut::Residual(self.robust.known(looked.view))
        } else if self.initial_transients.is_some() && unknown {
            LeaveOut::InitialTransients
        } else {
            LeaveOut::None
        };
        let matrix: Option<Affine> = match &*self.appearance {
            AnyAppearance::Affine(appearance) => Some(appearance.matrix(looked.view)),
            AnyAppearance::None(_) | AnyAppearance::Embed(_) | AnyAppearance::Gsw(_) => None,
        };
        LossInputs {
            camera: &looked.camera,
            pose: &looked.pose,
            matrix,
            background: &behind.coefficients,
            has_sky: looked.stored.has_sky,
            leave_out,
            lambda_ssim: settings.lambda_ssim,
            sky_weight: settings.sky_weight,
        }
    }

    /// Lets look, background and robust masks learn from what the photo said.
    pub fn hear(&mut self, looked: &Looked, said: &LossOutput) {
        *self.quality = Some(said.psnr);
        if let Some(residuals) = &said.residuals {
            self.robust.hear(looked.view, residuals.clone());
        }
        if let (AnyAppearance::Affine(appearance), Some(grad)) = (&mut *self.appearance, &said.matrix) {
            appearance.add_gradient(looked.view, grad);
        }
        self.background.learn(&said.background);
    }
}
