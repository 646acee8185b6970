//! The photo's half of a step: what it is compared under, and what look, background and robust masks learn from that. The
//! comparison itself is where the splats are ([`segwild_raster::compare`]).

use crate::TrainSettings;
use crate::background::Background;
use crate::looks::{self, Affine};
use crate::photos::{Level, Stored};
use crate::posed::Posed;
use crate::robust::Robust;
use crate::schedule::Schedule;
use crate::state::Painter;
use segwild_raster::AnyLook;
use segwild_raster::compare::{LeaveOut, Said, Sitting, Target};
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
    pub look: &'a mut AnyLook,
    pub background: &'a mut Background,
    pub robust: &'a mut Robust,
    pub suspects: Option<&'a Mask>,
    pub quality: &'a mut Option<f32>,
    pub step: u32,
    /// Until this step residuals say nothing of transients.
    pub pause_until: u32,
}

impl PhotoSide<'_> {
    /// What draws the photo's view.
    pub fn painter(&self, view: usize) -> Painter<'_> {
        Painter { view, look: self.look, background: self.background }
    }

    /// The photo, with what is known of its pixels; how far points vouch for them only where that is `wanted`.
    pub fn target(&self, looked: &Looked, posed: &Posed, wanted: bool) -> Target {
        let suspects = self.suspects.filter(|_| !looked.stored.strangers_known);
        let trust = if wanted { posed.trusted(looked.photo) } else { Vec::new() };
        looked.photo.target(suspects, trust)
    }

    /// The colours behind the splats, in the scene's colours.
    pub fn behind(&self, view: usize) -> Background {
        self.background.before(&looks::matrix(self.look, view))
    }

    /// What the photo is compared under, before such a background.
    pub fn sitting<'a>(
        &'a self,
        settings: &TrainSettings,
        schedule: &Schedule,
        looked: &'a Looked,
        behind: &'a Background,
    ) -> Sitting<'a> {
        let unknown = !looked.stored.strangers_known;
        let active = settings.robust && schedule.robust(self.step) && self.step >= self.pause_until;
        let leave_out = if active && unknown {
            LeaveOut::Residual(self.robust.known(looked.view))
        } else if self.suspects.is_some() && unknown {
            LeaveOut::Suspects
        } else {
            LeaveOut::None
        };
        let matrix: Option<Affine> = match &*self.look {
            AnyLook::Affine(look) => Some(look.matrix(looked.view)),
            AnyLook::None(_) | AnyLook::Embed(_) | AnyLook::Gsw(_) => None,
        };
        Sitting {
            camera: &looked.camera,
            pose: &looked.pose,
            matrix,
            behind: &behind.coefficients,
            has_sky: looked.stored.has_sky,
            leave_out,
            lambda_ssim: settings.lambda_ssim,
            sky_weight: settings.sky_weight,
        }
    }

    /// Lets look, background and robust masks learn from what the photo said.
    pub fn hear(&mut self, looked: &Looked, said: &Said) {
        *self.quality = Some(said.psnr);
        if let Some(residuals) = &said.residuals {
            self.robust.hear(looked.view, residuals.clone());
        }
        if let (AnyLook::Affine(look), Some(grad)) = (&mut *self.look, &said.matrix) {
            look.add_gradient(looked.view, grad);
        }
        self.background.learn(&said.behind);
    }
}
