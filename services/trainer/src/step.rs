//! One step of the training.

use crate::TrainError;
use crate::appearances;
use crate::density::{DensityChange, StepObservation, Surroundings};
use crate::model::options;
use crate::multi_view_pruning::MultiViewPruning;
use crate::painter::RenderedView;
use crate::params::joined;
use crate::photometric::StepPhoto;
use crate::pixels::{at_centres, first_background};
use crate::state::mean_quality;
use crate::trainer::{StepReport, Trainer};
use glam::Vec3;
use segwild_objective::compare::{self, Compared, LeaveOut, LossOutput, PerceptualLoss};
use segwild_objective::transients::VisibilityMap;
use segwild_objective::{AnyAppearance, AppearanceMaps};
use segwild_raster::{Channels, FrameGrad};
use segwild_scene::{Image, Splats};

impl Trainer {
    /// One optimiser step on one photo.
    pub fn step(&mut self) -> Result<StepReport, TrainError> {
        if self.settings.lambda_lpips > 0.0 && self.lpips.is_none() {
            let why = "`lambda_lpips` is above 0, and the training was given no weights of LPIPS";
            return Err(TrainError::Setting(why.into()));
        }
        self.start_turn()?;
        let (view, stored) = self.next_photo()?;
        let step = self.state.step;
        let wanted = self.schedule.level(step);
        if step > 0 && wanted != self.schedule.level(step - 1) {
            self.state.quality.fill(None);
            // The network of `gsw` learns transients from all visits, and from every residual.
            if !matches!(self.state.appearance, AnyAppearance::Gsw(_)) {
                self.state.pause_until = step + self.schedule.pause();
            }
        }
        let degree = self.schedule.sh_degree(step);
        if degree > self.state.params.splats.sh_degree {
            self.download()?;
            self.state.params.raise_sh_degree(degree);
        }
        let (level, photo) = stored.level(wanted);
        let camera = self.camera(view, &stored, level);
        let pose = self.views[view].pose;
        if self.state.backgrounds[view].is_none() {
            let full = self.camera(view, &stored, 0);
            self.state.backgrounds[view] = Some(first_background(&stored, &full, &pose));
            appearances::start(&mut self.state.appearance, view, &self.views[view], &stored);
            self.state.splat_budget.add_photo(photo.ground());
        }
        self.upload()?;
        let step_photo = StepPhoto { view, stored: &stored, level, photo, camera, pose };
        let LossOutput { loss, psnr, left_out, .. } = if self.is_on_device() {
            self.step_on_device(&step_photo)?
        } else {
            self.learn_here(&step_photo)?
        };
        // At a rate of 0 the gradients go, and the appearances stay.
        let fixed = self.photos_are_fixed();
        let rate = if fixed { 0.0 } else { self.schedule.late_factor(step) };
        self.state.appearance.as_appearance_mut().step(rate);
        self.state.step += 1;
        if !fixed {
            self.refine_poses()?;
        }
        let dropped = self.prune_unsupported()?;
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
            splats: self.splats(),
            change,
        })
    }

    /// The step on the host.
    fn learn_here(&mut self, step_photo: &StepPhoto) -> Result<LossOutput, TrainError> {
        let &StepPhoto { view, photo, ref camera, ref pose, .. } = step_photo;
        let step = self.state.step;
        let rates = self.rates(step);
        let fixed = self.photos_are_fixed();
        let (settings, schedule, posed) = (&self.settings, &self.schedule, &self.views[view]);
        let lpips = self.lpips.as_deref().filter(|_| settings.lambda_lpips > 0.0);
        let perceptual = lpips.map(|lpips| PerceptualLoss { lpips, weight: settings.lambda_lpips });
        let (params, strategy, mut side) = self.state.halves(view, fixed);
        let projected = self.engine.project(&params.splats, camera, pose, &options(settings.antialias))?;
        let RenderedView { light, colours, channels, frame } =
            side.painter(view).render(params, &*projected, pose, Some(u64::from(step)))?;
        let background = side.scene_background(view);
        let loss_inputs = side.loss_inputs(settings, schedule, step_photo, &background);
        let target = side.target(step_photo, posed, matches!(loss_inputs.leave_out, LeaveOut::Residual(_)));
        // The network of `gsw` predicts the visible pixels, and gets a gradient for that.
        let map = light.as_ref().and_then(AppearanceMaps::visible);
        let seeing = map.as_ref().map(|map| VisibilityMap { map, decides: schedule.visible(step) });
        let compared = compare::compare(&frame, &target, &loss_inputs, seeing.as_ref(), perceptual.as_ref());
        let Compared { output, image, alpha, error, part_residuals, .. } = compared;
        side.apply(step_photo, &output);
        let channels = Channels { count: 3, values: &channels };
        let grad = FrameGrad { image: &image, alpha: Some(&alpha) };
        let mut grads = projected.backward(&channels, &frame, &grad)?;
        let colour_grads = std::mem::take(&mut grads.values);
        let sight = params.sight(&*projected, pose);
        let (colour_grads, embedding_grads) = side.appearance.colour_backward(
            view,
            light.as_ref(),
            &sight,
            &colours,
            colour_grads,
            &part_residuals,
        );
        let sh_grads = projected.shade_backward(&colour_grads, &mut grads);
        let error = at_centres(&error, projected.as_ref());
        let seen = StepObservation {
            radii: projected.radii(),
            grads: &grads,
            error: &error,
            long_side: photo.width.max(photo.height) as f32,
        };
        strategy.observe(&seen);
        let radii = projected.radii().to_vec();
        drop(projected);
        strategy.regularise(&params.splats, &mut grads);
        params.update(&grads, &sh_grads, &rates);
        params.update_embeddings(&embedding_grads, &radii, &rates, side.appearance.as_appearance().fading());
        Ok(output)
    }

    /// Removes splats without multi-view support: transients that one photo put before its camera.
    fn prune_unsupported(&mut self) -> Result<usize, TrainError> {
        let photos = self.state.sampler.count();
        let none = self.state.robust.shares().iter().all(|&share| share == 0.0);
        if none || !self.settings.robust || !self.schedule.multi_view_pruning(self.state.step, photos) {
            return Ok(0);
        }
        self.download()?;
        let n = self.state.params.trained();
        let mut multi_view_pruning = MultiViewPruning::new(self.state.params.splats.len());
        let engine = self.engine.clone();
        let splats = &self.state.params.splats;
        let resident = engine.upload_splats(splats)?;
        let engine = resident.as_deref().unwrap_or(&*engine);
        let level = self.schedule.level(self.state.step).max(1);
        for view in self.state.sampler.views() {
            if self.state.backgrounds[view].is_none() {
                continue;
            }
            let Some(stored) = self.photos.usable(view)? else { continue };
            let (level, photo) = stored.level(level);
            let camera = self.camera(view, &stored, level);
            let pose = self.views[view].pose;
            let projected = engine.project(splats, &camera, &pose, &options(self.settings.antialias))?;
            let painter = self.state.painter(view);
            let rendered = painter.render(&self.state.params, &*projected, &pose, None)?;
            let shown = painter.show(&rendered.frame, &camera, &pose);
            let share = stored.transient_share(self.state.robust.shares()[view]);
            let contradicted = self.views[view].contradicted(&shown, photo, share);
            multi_view_pruning.add_photo(&*projected, photo.width, &contradicted, |i| photo.counts(i))?;
        }
        drop(resident);
        let kept = multi_view_pruning.supported().into_iter().filter(|&i| i < n);
        let kept: Vec<usize> = match self.core() {
            None => kept.collect(),
            Some(core) => {
                let mut stays: Vec<bool> =
                    splats.means[..n].iter().map(|mean| !core.contains(Vec3::from(*mean))).collect();
                kept.for_each(|i| stays[i] = true);
                (0..n).filter(|&i| stays[i]).collect()
            }
        };
        if kept.is_empty() || kept.len() == n {
            return Ok(0);
        }
        self.state.params.remap(&kept);
        self.state.strategy.as_dyn().keep(&kept);
        Ok(n - kept.len())
    }

    /// Lets the density strategy act on the splats as they are after the step.
    fn control_density(&mut self) -> Result<Option<DensityChange>, TrainError> {
        let step = self.schedule.since_start(self.state.step);
        if !self.state.strategy.as_dyn().acts(step) || self.state.params.trained() == 0 {
            return Ok(None);
        }
        let mut reshaping = self.lend_shapes()?;
        let views = self.state.sampler.views();
        let quality = mean_quality(&views, &self.state.quality);
        let engine = self.engine.clone();
        let (cap, core, frozen) = (self.cap(), self.core(), self.state.params.frozen_shapes());
        let (photos, posed, antialias) = (&mut self.photos, &self.views, self.settings.antialias);
        let mut contribution = |trained: &Splats| {
            let whole = (!frozen.is_empty()).then(|| joined(trained.clone(), &frozen));
            let splats = whole.as_ref().unwrap_or(trained);
            let resident = engine.upload_splats(splats)?;
            let engine = resident.as_deref().unwrap_or(&*engine);
            let mut sum = vec![0.0f32; splats.len()];
            for &view in &views {
                // A thousand photos take minutes.
                segwild_flow::sign_of_life();
                let Some(stored) = photos.usable(view)? else { continue };
                let (level, size) = stored.level(1);
                let camera = stored.camera(&posed[view].camera, level);
                let projected = engine.project(splats, &camera, &posed[view].pose, &options(antialias))?;
                let seen =
                    projected.gather(&Image::filled(size.width, size.height, 1, 4f32.powi(level as i32)))?;
                for (s, v) in sum.iter_mut().zip(seen) {
                    *s += v;
                }
            }
            sum.truncate(trained.len());
            if let Some(core) = core {
                let around = sum.iter_mut().zip(&trained.means);
                let around = around.filter(|(_, mean)| !core.contains(Vec3::from(**mean)));
                around.for_each(|(sum, _)| *sum = f32::INFINITY);
            }
            Ok(sum)
        };
        let state = &mut self.state;
        let mut around = Surroundings {
            step,
            level: self.schedule.level(state.step - 1),
            pixel: state.pixel,
            cap,
            quality,
            random: &mut state.random,
            contribution: &mut contribution,
        };
        let change = state.strategy.as_dyn().act(&mut reshaping, &mut around)?;
        self.take_shapes(reshaping.done())?;
        if let Some(change) = &change {
            if change.opacity_reset {
                self.state.pause_until = self.state.step + self.schedule.pause();
            }
            if let Some(note) = &change.note {
                tracing::info!("{note}");
            }
        }
        Ok(change)
    }
}
