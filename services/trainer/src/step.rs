//! One step of the training.

use crate::TrainError;
use crate::density::{Change, Seen, Surroundings};
use crate::looks;
use crate::model::options;
use crate::params::Rates;
use crate::pixels::{
    alpha_gradient, error_at_centres, first_background, learn_constant, learn_sky, mean_difference,
    pixel_weights, weighted_psnr,
};
use crate::robust;
use crate::state::{Drawn, mean_quality};
use crate::trainer::{StepReport, Trainer};
use crate::visibility;
use crate::witness::Witness;
use segwild_raster::{Channels, FrameGrad, Sight, photometric};
use segwild_scene::{Image, Splats};

impl Trainer {
    /// One optimiser step on one photo.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        let (view, stored) = self.next_photo()?;
        let step = self.state.step;
        let wanted = self.schedule.level(step);
        if step > 0 && wanted != self.schedule.level(step - 1) {
            self.state.quality.fill(None);
        }
        self.state.params.raise_sh_degree(self.schedule.sh_degree(step));
        let (level, photo) = stored.level(wanted);
        let camera = self.camera(view, &stored, level);
        let pose = self.views[view].pose;
        if self.state.backgrounds[view].is_none() {
            let full = self.camera(view, &stored, 0);
            self.state.backgrounds[view] = Some(first_background(&stored, &full, &pose));
            looks::start(&mut self.state.look, view, &self.views[view], &stored);
            self.state.room.look_at(photo.ground());
        }
        let engine = self.engine.clone();
        let projected =
            engine.project(&self.state.params.splats, &camera, &pose, &options(self.settings.antialias))?;
        let draw = Some(u64::from(step));
        let Drawn { light, colours, channels, frame, behind, scene, shown } =
            self.state.draw(view, &*projected, &camera, &pose, draw)?;
        let target = photo.image();
        // What counts.
        let residual = mean_difference(&shown, &target);
        let active = self.settings.robust && self.schedule.robust(step) && step >= self.state.pause_until;
        let active = active && !stored.strangers_known;
        let (mut kept, mut doubted) = (None, Vec::new());
        let suspects = self.state.suspects[view].as_ref().filter(|_| !stored.strangers_known);
        let suspected = |i| suspects.is_some_and(|s| photo.lies_in(i, s));
        if active {
            doubted = self.views[view].doubted(&residual, photo);
            kept = self.state.robust.weights(view, &doubted, photo.width, |i| photo.counts(i), suspected);
        } else if suspects.is_some() {
            kept = Some((0..photo.pixels()).map(|i| f32::from(u8::from(!suspected(i)))).collect());
        }
        let (mut visible, mut blame) = (None, Vec::new());
        if let Some(light) = light.as_ref().filter(|_| active) {
            let share = self.settings.robust_share;
            let ratio = robust::relative(&doubted, photo.width, |i| photo.counts(i), share);
            blame = visibility::blame(light, &ratio, photo);
            if self.schedule.visible(step) {
                visible = visibility::weights(light, photo, kept.as_deref(), share);
            }
        }
        let (weights, left_out) = pixel_weights(photo, visible.as_deref().or(kept.as_deref()));
        let psnr = weighted_psnr(&shown, &target, &weights.data);
        self.state.quality[view] = Some(psnr);
        // Loss and its gradient on the way back: look, background, sky, splats.
        let (loss, grad) = photometric(&shown, &target, Some(&weights), self.settings.lambda_ssim);
        let grad = self.state.look.as_look_mut().backward(view, &scene, &grad);
        let alpha_grad = alpha_gradient(&grad, &behind, &frame.alpha, photo, self.settings.sky_weight);
        let background = self.state.backgrounds[view].as_mut().expect("just set");
        if stored.has_sky {
            learn_sky(background, photo, &camera, &pose, &frame.alpha, &weights.data);
        } else {
            learn_constant(background, &shown, &target, &frame.alpha, &weights.data);
        }
        let mut grads = projected.backward(
            &Channels { count: 3, values: &channels },
            &frame,
            &FrameGrad { image: &grad, alpha: Some(&alpha_grad) },
        )?;
        let colour_grads = std::mem::take(&mut grads.values);
        let sight = Sight {
            means: &self.state.params.splats.means,
            codes: &self.state.params.codes,
            radii: projected.radii(),
            eye: pose.centre().to_array(),
        };
        let look = &mut self.state.look;
        let (colour_grads, code_grads) =
            look.colour_backward(view, light.as_ref(), &sight, &colours, colour_grads, &blame);
        let sh_grads = projected.shade_backward(&colour_grads, &mut grads);
        let error = error_at_centres(&residual, &weights.data, photo, projected.as_ref());
        let seen = Seen {
            radii: projected.radii(),
            grads: &grads,
            error: &error,
            long_side: photo.width.max(photo.height) as f32,
        };
        self.state.strategy.as_dyn().observe(&seen);
        let radii = projected.radii().to_vec();
        drop(projected);
        // Update.
        self.state.strategy.as_dyn().regularise(&self.state.params.splats, &mut grads);
        let rates = self.rates(step);
        self.state.params.update(&grads, &sh_grads, &rates);
        let fading = self.state.look.as_look().fading();
        self.state.params.update_codes(&code_grads, &radii, &rates, fading);
        self.state.look.as_look_mut().step(self.schedule.late_factor(step));
        self.state.step += 1;
        let dropped = self.drop_unwitnessed()?;
        let mut change = self.control_density()?;
        if dropped > 0 {
            change.get_or_insert_default().removed += dropped;
        }
        let (sums, steps) = &mut self.state.since;
        *sums = [sums[0] + loss, sums[1] + psnr, sums[2] + left_out];
        *steps += 1;
        Ok(StepReport {
            step: self.state.step,
            steps: self.settings.steps,
            view,
            loss,
            psnr,
            left_out,
            size: (photo.width, photo.height),
            splats: self.state.params.splats.len(),
            change,
        })
    }

    fn rates(&self, step: u32) -> Rates {
        let s = &self.settings;
        let late = self.schedule.late_factor(step);
        Rates {
            mean: s.lr_mean * self.state.pixel * self.schedule.mean_factor(step),
            opacity: s.lr_opacity * late,
            scale: s.lr_scale * late,
            rotation: s.lr_rotation * late,
            colour: s.lr_colour * late,
            code: s.lr_code * self.schedule.code_factor(step),
        }
    }

    /// Removes splats that the photos do not bear out: strangers that one photo put before its camera.
    fn drop_unwitnessed(&mut self) -> Result<usize, TrainError> {
        if !self.settings.robust || !self.schedule.witness(self.state.step) {
            return Ok(0);
        }
        let n = self.state.params.splats.len();
        let mut witness = Witness::new(n);
        let engine = self.engine.clone();
        let level = self.schedule.level(self.state.step).max(1);
        for view in self.state.sampler.views() {
            if self.state.backgrounds[view].is_none() {
                continue;
            }
            let stored = self.photos.get(view)?;
            let (level, photo) = stored.level(level);
            let camera = self.camera(view, &stored, level);
            let pose = self.views[view].pose;
            let splats = &self.state.params.splats;
            let projected = engine.project(splats, &camera, &pose, &options(self.settings.antialias))?;
            let shown = self.state.draw(view, &*projected, &camera, &pose, None)?.shown;
            let residual = self.views[view].doubted(&mean_difference(&shown, &photo.image()), photo);
            let share = if stored.strangers_known { 0.0 } else { self.settings.robust_share };
            let contradicted = robust::contradicted(&residual, photo.width, |i| photo.counts(i), share);
            witness.hear(&*projected, photo.width, &contradicted, |i| photo.counts(i))?;
        }
        let kept = witness.borne_out();
        if kept.is_empty() || kept.len() == n {
            return Ok(0);
        }
        self.state.params.remap(&kept);
        self.state.strategy.as_dyn().keep(&kept);
        Ok(n - kept.len())
    }

    /// Lets the density strategy act on the splats as they are after the step.
    fn control_density(&mut self) -> Result<Option<Change>, TrainError> {
        let views = self.state.sampler.views();
        let quality = mean_quality(&views, &self.state.quality);
        let engine = self.engine.clone();
        let (photos, posed, antialias) = (&mut self.photos, &self.views, self.settings.antialias);
        let mut contribution = |splats: &Splats| {
            let mut sum = vec![0.0f32; splats.len()];
            for &view in &views {
                let stored = photos.get(view)?;
                let (level, size) = stored.level(1);
                let camera = stored.camera(&posed[view].camera, level);
                let projected = engine.project(splats, &camera, &posed[view].pose, &options(antialias))?;
                let seen =
                    projected.gather(&Image::filled(size.width, size.height, 1, 4f32.powi(level as i32)))?;
                for (s, v) in sum.iter_mut().zip(seen) {
                    *s += v;
                }
            }
            Ok(sum)
        };
        let state = &mut self.state;
        let mut around = Surroundings {
            step: state.step,
            pixel: state.pixel,
            cap: state.room.splats(),
            quality,
            random: &mut state.random,
            contribution: &mut contribution,
        };
        let change = state.strategy.as_dyn().act(&mut state.params, &mut around)?;
        if let Some(change) = &change {
            if change.opacity_reset {
                state.pause_until = state.step + self.schedule.reset_pause();
            }
            if let Some(note) = &change.note {
                tracing::info!("{note}");
            }
        }
        Ok(change)
    }
}
