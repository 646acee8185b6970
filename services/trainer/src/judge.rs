//! The photo's half of a step: what a photo says of an image of the scene. The splats' half is drawing them and learning
//! from the image's gradient, wherever they are.

use crate::background::Background;
use crate::photos::{Level, Stored};
use crate::pixels::{
    alpha_gradient, error_around, learn_constant, learn_sky, mean_difference, pixel_weights, weighted_psnr,
};
use crate::posed::Posed;
use crate::robust::{self, Robust};
use crate::schedule::Schedule;
use crate::state::{Painter, Shown};
use crate::{TrainSettings, visibility};
use segwild_raster::{AnyLook, FrameGrad, Impression, photometric};
use segwild_scene::{Camera, Image, Mask, Pose};

/// The photo that a step looks at, at the size it looks at.
pub(crate) struct Looked<'a> {
    pub view: usize,
    pub stored: &'a Stored,
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

/// What the photo says.
pub(crate) struct Judged {
    pub loss: f32,
    /// Of the pixels that count, in dB.
    pub psnr: f32,
    /// Share of them left out as transient.
    pub left_out: f32,
    /// Gradients of the frame's image and of its alpha.
    pub image: Image,
    pub alpha: Image,
    /// Mean error around each pixel, one plane, for density control.
    pub error: Image,
    /// For the network of the look `gsw`: see [`segwild_raster::GswLook::tint_backward`].
    pub blame: Vec<Option<f32>>,
}

impl Judged {
    /// What enters the backward pass.
    pub fn grad(&self) -> FrameGrad<'_> {
        FrameGrad { image: &self.image, alpha: Some(&self.alpha) }
    }
}

impl PhotoSide<'_> {
    /// What draws the photo's view.
    pub fn painter(&self, view: usize) -> Painter<'_> {
        Painter { view, look: self.look, background: self.background }
    }

    /// Compares, and lets look, background and robust masks learn from it.
    pub fn judge(
        &mut self,
        settings: &TrainSettings,
        schedule: &Schedule,
        posed: &Posed,
        looked: &Looked,
        light: Option<&Impression>,
        drawn: &Shown,
    ) -> Judged {
        let &Looked { view, stored, photo, ref camera, ref pose } = looked;
        let Shown { frame, behind, scene, shown } = drawn;
        let target = photo.image();
        // What counts.
        let residual = mean_difference(shown, &target);
        let active = settings.robust && schedule.robust(self.step) && self.step >= self.pause_until;
        let active = active && !stored.strangers_known;
        let (mut kept, mut doubted) = (None, Vec::new());
        let suspects = self.suspects.filter(|_| !stored.strangers_known);
        let suspected = |i| suspects.is_some_and(|s| photo.lies_in(i, s));
        if active {
            doubted = posed.doubted(&residual, photo);
            kept = self.robust.weights(view, &doubted, photo.width, |i| photo.counts(i), suspected);
        } else if suspects.is_some() {
            kept = Some((0..photo.pixels()).map(|i| f32::from(u8::from(!suspected(i)))).collect());
        }
        let (mut visible, mut blame) = (None, Vec::new());
        if let Some(light) = light.filter(|_| active) {
            let share = settings.robust_share;
            let ratio = robust::relative(&doubted, photo.width, |i| photo.counts(i), share);
            blame = visibility::blame(light, &ratio, photo);
            if schedule.visible(self.step) {
                visible = visibility::weights(light, photo, kept.as_deref(), share);
            }
        }
        let (weights, left_out) = pixel_weights(photo, visible.as_deref().or(kept.as_deref()));
        let psnr = weighted_psnr(shown, &target, &weights.data);
        *self.quality = Some(psnr);
        // Loss and its gradient on the way back: look, background, sky.
        let (loss, grad) = photometric(shown, &target, Some(&weights), settings.lambda_ssim);
        let image = self.look.as_look_mut().backward(view, scene, &grad);
        let alpha = alpha_gradient(&image, behind, &frame.alpha, photo, settings.sky_weight);
        if stored.has_sky {
            learn_sky(self.background, photo, camera, pose, &frame.alpha, &weights.data);
        } else {
            learn_constant(self.background, shown, &target, &frame.alpha, &weights.data);
        }
        let error = error_around(&residual, &weights.data, photo);
        Judged { loss, psnr, left_out, image, alpha, error, blame }
    }
}
