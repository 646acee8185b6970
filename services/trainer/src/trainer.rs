//! The training loop.

use crate::background::Background;
use crate::density::{Change, Seen, Strategy, Surroundings};
use crate::initial::{Eye, initial_splats};
use crate::looks;
use crate::model::{Model, Stats, options};
use crate::params::{Params, Rates};
use crate::photos::{PhotoCache, Photos, Stored, level_camera};
use crate::pixels::{
    add_behind, alpha_gradient, error_at_centres, first_background, learn_constant, learn_sky,
    mean_difference, pixel_weights, weighted_psnr,
};
use crate::posed::{Posed, colour_pairs, posed};
use crate::robust::{self, Robust};
use crate::sampler::Sampler;
use crate::schedule::Schedule;
use crate::witness::Witness;
use crate::{TrainError, TrainSettings};
use segwild_raster::{AnyLook, Channels, Engine, Frame, FrameGrad, Projected, photometric};
use segwild_scene::Random;
use segwild_scene::{Camera, Image, Pose, Scene, Skipped, Splats};
use std::sync::Arc;
use wincode::{SchemaRead, SchemaWrite};

/// What one step did.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: u32,
    /// Steps of the whole run.
    pub steps: u32,
    /// The view looked at.
    pub view: usize,
    /// Loss before the step.
    pub loss: f32,
    /// PSNR of the photo's counted pixels before the step, in dB, at the size trained at.
    pub psnr: f32,
    /// Share of the photo left out as transient.
    pub left_out: f32,
    /// Width and height of the photo in this step.
    pub size: (usize, usize),
    /// Splats after the step.
    pub splats: usize,
    /// What density control did, when it acted.
    pub change: Option<Change>,
}

/// Trains one scene, one photo per step.
pub struct Trainer {
    engine: Arc<dyn Engine>,
    settings: TrainSettings,
    schedule: Schedule,
    views: Vec<Posed>,
    photos: PhotoCache,
    warnings: Vec<String>,
    state: State,
}

/// A view drawn as its photo would show it.
struct Drawn {
    /// Colour per splat, its own and in the photo's light.
    colours: Vec<f32>,
    channels: Vec<f32>,
    frame: Frame,
    /// What stands behind the splats, in the scene's colours.
    behind: Image,
    /// Splats before what is behind, in the scene's colours.
    scene: Image,
    /// The same in the photo's colours.
    shown: Image,
}

/// Everything that a step changes: what a checkpoint holds.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct State {
    step: u32,
    params: Params,
    strategy: Strategy,
    look: AnyLook,
    /// Per view of the scene, in the photo's colours; `None` until the photo was looked at.
    backgrounds: Vec<Option<Background>>,
    robust: Robust,
    sampler: Sampler,
    random: Random,
    /// Per view, -10 log10 of the last squared error at the present size.
    quality: Vec<Option<f32>>,
    /// Photos that turned out not to be usable: name and reason.
    skipped: Vec<(String, String)>,
    /// Until this step residuals say nothing of transients.
    pause_until: u32,
    /// Scene units per full-size pixel at the scene's median depth.
    pixel: f32,
    /// Most splats.
    cap: u64,
    /// Sums of loss, PSNR and share left out since they were last asked for, and over how many steps.
    since: ([f32; 3], u32),
}

/// A training that can be continued: with the same scene, photos and settings it ends in the same bytes as
/// one that never stopped.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Checkpoint {
    /// The settings, name and value.
    settings: Vec<(String, String)>,
    /// Names of the scene's views.
    names: Vec<String>,
    state: State,
}

impl Checkpoint {
    /// Steps done.
    pub fn step(&self) -> u32 {
        self.state.step
    }
}

impl Trainer {
    /// Starts from the scene's points. The views not held out are trained on.
    pub fn new(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        settings: TrainSettings,
    ) -> Result<Trainer, TrainError> {
        settings.check()?;
        let mut train: Vec<usize> = (0..scene.views.len()).filter(|&i| !scene.views[i].test).collect();
        let mut cache = photo_cache(scene, photos, &settings);
        let mut skipped = Vec::new();
        // The first usable photo tells the size trained at.
        let first = loop {
            let Some(&view) = train.first() else {
                return Err(no_photos(&skipped));
            };
            match cache.get(view) {
                Ok(stored) => break (view, stored),
                Err(TrainError::Photo { name, reason }) => {
                    skipped.push((name, reason));
                    train.remove(0);
                }
                Err(other) => return Err(other),
            }
        };
        let size = &first.1.levels[0];
        let long_side = size.width.max(size.height) as u32;
        let mut eyes: Vec<Option<Eye>> = vec![None; scene.views.len()];
        for &i in &train {
            eyes[i] = Some((scene.views[i].camera.scaled_to(long_side), scene.views[i].pose));
        }
        let cap = cap(&settings, scene.points.len(), train.len(), size.pixels());
        let mut random = Random::new(settings.seed);
        let schedule = Schedule::new(&settings);
        let start = initial_splats(scene, &eyes, schedule.sh_degree(0), cap, &mut random);
        let look = looks::begin(&settings, scene.views.len());
        let state = State {
            step: 0,
            strategy: Strategy::new(&settings, start.splats.len()),
            params: Params::new(start.splats, look.as_look().code_size()),
            look,
            backgrounds: vec![None; scene.views.len()],
            robust: Robust::new(scene.views.len(), settings.robust_share),
            sampler: Sampler::new(&train),
            random,
            quality: vec![None; scene.views.len()],
            skipped,
            pause_until: 0,
            pixel: start.pixel,
            cap: cap as u64,
            since: ([0.0; 3], 0),
        };
        for warning in &start.warnings {
            tracing::warn!("{warning}");
        }
        Ok(Trainer {
            engine,
            schedule,
            views: posed(scene),
            photos: cache,
            warnings: start.warnings,
            state,
            settings,
        })
    }

    /// Continues from a checkpoint of the same scene, with the settings it was made with.
    pub fn resume(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        checkpoint: Checkpoint,
    ) -> Result<Trainer, TrainError> {
        use segwild_scene::settings::Group;
        let mut settings = TrainSettings::default();
        for (name, value) in &checkpoint.settings {
            settings.set(name, value).map_err(|e| TrainError::Checkpoint(e.to_string()))?;
        }
        settings.check()?;
        let names: Vec<String> = scene.views.iter().map(|v| v.name.clone()).collect();
        if names != checkpoint.names {
            let odd = names.iter().zip(&checkpoint.names).find(|(a, b)| a != b);
            let reason = match odd {
                Some((here, there)) => format!("it has photo `{there}` where the scene has `{here}`"),
                None => format!("it has {} photos, the scene {}", checkpoint.names.len(), names.len()),
            };
            return Err(TrainError::Checkpoint(reason));
        }
        checkpoint.state.check(scene.views.len())?;
        let photos = photo_cache(scene, photos, &settings);
        let schedule = Schedule::new(&settings);
        let state = checkpoint.state;
        Ok(Trainer { engine, schedule, views: posed(scene), photos, warnings: Vec::new(), state, settings })
    }

    /// Holds so many MiB of decoded photos from now on. What is trained does not depend on it.
    pub fn hold_photos(&mut self, mib: usize) {
        self.photos.limit_to(mib << 20);
    }

    /// Everything needed to continue later.
    pub fn checkpoint(&self) -> Checkpoint {
        use segwild_scene::settings::Group;
        let settings = TrainSettings::FIELDS
            .iter()
            .map(|f| (f.name.to_owned(), self.settings.get(f.name).expect("a field of the group")))
            .collect();
        let names = self.views.iter().map(|v| v.name.clone()).collect();
        Checkpoint { settings, names, state: self.state.clone() }
    }

    /// The settings of this run.
    pub fn settings(&self) -> &TrainSettings {
        &self.settings
    }

    /// Steps done.
    pub fn steps_done(&self) -> u32 {
        self.state.step
    }

    /// Means of loss, PSNR in dB and share left out over the steps since this was last asked, by this trainer or by the
    /// one whose checkpoint it goes on from.
    pub fn means(&mut self) -> [f32; 3] {
        let (sums, steps) = std::mem::take(&mut self.state.since);
        sums.map(|sum| sum / steps.max(1) as f32)
    }

    /// Whether all steps are done.
    pub fn is_done(&self) -> bool {
        self.state.step >= self.settings.steps
    }

    /// What was odd about the start, in words.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The photos in the order in which the next steps look at them, each at least once: what to have ready first.
    pub fn upcoming(&self) -> Vec<usize> {
        let (mut sampler, mut random) = (self.state.sampler.clone(), self.state.random.clone());
        let rest_of_round_and_next = 0..2 * sampler.views().len();
        rest_of_round_and_next.filter_map(|_| sampler.next(&mut random)).collect()
    }

    /// Photos that turned out not to be usable.
    pub fn skipped(&self) -> Vec<Skipped> {
        let of = |(name, reason): &(String, String)| Skipped { name: name.clone(), reason: reason.clone() };
        self.state.skipped.iter().map(of).collect()
    }

    /// The next photo, skipping those that cannot be used.
    fn next_photo(&mut self) -> Result<(usize, Arc<Stored>), TrainError> {
        loop {
            let Some(view) = self.state.sampler.next(&mut self.state.random) else {
                return Err(no_photos(&self.state.skipped));
            };
            match self.photos.get(view) {
                Ok(stored) => return Ok((view, stored)),
                Err(TrainError::Photo { name, reason }) => {
                    tracing::warn!("photo `{name}` is left out: {reason}");
                    self.state.skipped.push((name, reason));
                    self.state.sampler.drop_last();
                }
                Err(other) => return Err(other),
            }
        }
    }

    /// The camera of a view at a level of its photo.
    fn camera(&self, view: usize, stored: &Stored, level: usize) -> Camera {
        let size = &stored.levels[0];
        let full = self.views[view].camera.resized(size.width as u32, size.height as u32);
        level_camera(&full, level, &stored.levels[level])
    }

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
            looks::start(&mut self.state.look, view, &colour_pairs(&self.views[view], &stored));
        }
        let engine = self.engine.clone();
        let projected =
            engine.project(&self.state.params.splats, &camera, &pose, &options(self.settings.antialias))?;
        let Drawn { colours, channels, frame, behind, scene, shown } =
            self.state.draw(view, &*projected, &camera, &pose);
        let target = photo.image();
        // What counts.
        let residual = mean_difference(&shown, &target);
        let active = self.settings.robust && self.schedule.robust(step) && step >= self.state.pause_until;
        let active = active && !stored.strangers_known;
        let trusted = self.views[view].trusted(photo);
        let doubted: Vec<f32> = residual.iter().zip(&trusted).map(|(r, t)| r * (1.0 - t)).collect();
        let kept = self.state.robust.weights(view, &doubted, photo.width, |i| photo.counts(i), active);
        let (weights, left_out) = pixel_weights(photo, kept.as_deref());
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
        );
        let colour_grads = std::mem::take(&mut grads.values);
        let look = self.state.look.as_look_mut();
        let (colour_grads, code_grads) =
            look.tint_backward(view, &self.state.params.codes, &colours, colour_grads);
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
        self.state.params.update_codes(&code_grads, &radii, &rates);
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
            code: s.lr_code * late,
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
            let shown = self.state.draw(view, &*projected, &camera, &pose).shown;
            let mut residual = mean_difference(&shown, &photo.image());
            for (r, t) in residual.iter_mut().zip(&self.views[view].trusted(photo)) {
                *r *= 1.0 - t;
            }
            let share = if stored.strangers_known { 0.0 } else { self.settings.robust_share };
            let contradicted = robust::contradicted(&residual, photo.width, |i| photo.counts(i), share);
            witness.hear(&*projected, photo.width, &contradicted, |i| photo.counts(i));
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
                let full =
                    posed[view].camera.resized(stored.levels[0].width as u32, stored.levels[0].height as u32);
                let (level, size) = stored.level(1);
                let camera = level_camera(&full, level, size);
                let projected = engine.project(splats, &camera, &posed[view].pose, &options(antialias))?;
                let seen =
                    projected.gather(&Image::filled(size.width, size.height, 1, 4f32.powi(level as i32)));
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
            cap: state.cap as usize,
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

    /// The scene as it is now.
    pub fn snapshot(&self) -> Model {
        let state = &self.state;
        let mut look = state.look.clone();
        let known = (0..self.views.len()).filter(|&v| state.backgrounds[v].is_some());
        looks::set_mean(&mut look, self.views.len(), known);
        Model {
            splats: state.params.splats.clone(),
            codes: state.params.codes.clone(),
            look,
            backgrounds: state.backgrounds.clone(),
            names: self.views.iter().map(|v| v.name.clone()).collect(),
            trained_on: state.sampler.views().iter().map(|&v| v as u32).collect(),
            antialias: self.settings.antialias,
            stats: Stats { step: state.step, psnr: mean_quality(&state.sampler.views(), &state.quality) },
        }
    }

    /// Does the steps that are left, then hands the scene over.
    pub fn finish(mut self) -> Result<Model, TrainError> {
        while !self.is_done() {
            self.step()?;
        }
        Ok(self.snapshot())
    }
}

fn photo_cache(scene: &Scene, photos: Arc<dyn Photos>, settings: &TrainSettings) -> PhotoCache {
    let names = scene.views.iter().map(|v| v.name.clone()).collect();
    PhotoCache::new(photos, names, settings.photo_cache_mib << 20)
}

fn no_photos(skipped: &[(String, String)]) -> TrainError {
    if skipped.is_empty() {
        return TrainError::NoPhotos("the scene has none that is not held out".into());
    }
    let mut reasons: Vec<String> =
        skipped.iter().take(3).map(|(name, reason)| format!("`{name}`: {reason}")).collect();
    if skipped.len() > reasons.len() {
        reasons.push(format!("and {} more", skipped.len() - reasons.len()));
    }
    TrainError::NoPhotos(reasons.join("; "))
}

impl State {
    /// Draws a view that was looked at before.
    fn draw(&self, view: usize, projected: &dyn Projected, camera: &Camera, pose: &Pose) -> Drawn {
        let colours = projected.shade();
        let channels = self.look.as_look().tint(view, &self.params.codes, colours.clone());
        let frame = projected.blend(&Channels { count: 3, values: &channels });
        let matrix = looks::matrix(&self.look, view);
        let background = self.backgrounds[view].as_ref().expect("set at the first look");
        let behind = background.before(&matrix).paint(camera, pose);
        let mut scene = frame.image.clone();
        add_behind(&mut scene, &frame.alpha, &behind);
        let shown = self.look.as_look().apply(view, &scene);
        Drawn { colours, channels, frame, behind, scene, shown }
    }

    /// Refuses a state whose parts do not fit each other or the scene.
    fn check(&self, views: usize) -> Result<(), TrainError> {
        let per_view = [self.backgrounds.len(), self.quality.len()];
        if per_view.iter().any(|&n| n != views) || self.sampler.views().iter().any(|&v| v >= views) {
            return Err(TrainError::Checkpoint("it is damaged: its lists of photos differ in length".into()));
        }
        self.params.consistent().map_err(|e| TrainError::Checkpoint(format!("it is damaged: {e}")))
    }
}

/// Most splats that a training on this scene may come to, at the size photos are trained at (long side).
pub fn splat_cap(settings: &TrainSettings, scene: &Scene, long_side: u32) -> usize {
    let train: Vec<_> = scene.views.iter().filter(|v| !v.test).collect();
    let pixels = train.iter().map(|v| {
        let camera = v.camera.scaled_to(long_side);
        camera.width as usize * camera.height as usize
    });
    cap(settings, scene.points.len(), train.len(), pixels.max().unwrap_or(0))
}

/// Most splats: as the settings say, or what points, photos and pixels can support.
fn cap(settings: &TrainSettings, points: usize, photos: usize, pixels: usize) -> usize {
    if settings.splats > 0 {
        return settings.splats;
    }
    // A splat needs some pixels in several photos to be determined; photos of one place overlap, so their
    // pixels count by the square root.
    let supported = pixels as f32 * (photos as f32).sqrt() / 26.0;
    (supported as usize).max(points.min(20_000)).clamp(2_000, 200_000)
}

/// Mean over the photos seen at the present size, when most of them were.
fn mean_quality(views: &[usize], quality: &[Option<f32>]) -> Option<f32> {
    let known: Vec<f32> = views.iter().filter_map(|&v| quality[v]).collect();
    (!known.is_empty() && known.len() * 10 >= views.len().min(100) * 9)
        .then(|| known.iter().sum::<f32>() / known.len() as f32)
}
