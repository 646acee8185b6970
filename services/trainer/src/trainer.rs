//! A training: its start, and what it holds.

use crate::appearances;
use crate::blocks::{BlockTurn, BlockTurns};
use crate::colours::coloured;
use crate::density::{DensityChange, Strategy};
use crate::initial::{Eye, initial_splats};
use crate::params::{Params, Rates};
use crate::photos::{Photos, Stored, TrainPhotoCache};
use crate::posed::{Posed, posed};
use crate::poses_by_points::PosesByPoints;
use crate::refined_pose::with_poses;
use crate::sampler::Sampler;
use crate::schedule::Schedule;
use crate::splat_budget::SplatBudget;
use crate::state::TrainState;
use crate::{TrainError, TrainSettings};
use segwild_nn::Lpips;
use segwild_objective::transients::ResidualHistograms;
use segwild_objective::{DeviceTraining, Engine};
use segwild_scene::{Camera, Mask, Point, Pose, Random, Scene, Skipped};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// Trainers that there were in this process.
static TRAINERS: AtomicU64 = AtomicU64::new(0);

/// The result of one step.
#[derive(Clone, Debug, PartialEq)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: u32,
    /// Steps of the whole run.
    pub steps: u32,
    /// The view of the step.
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
    pub change: Option<DensityChange>,
}

/// Trains one scene, one photo per step.
pub struct Trainer {
    pub(crate) engine: Arc<dyn Engine>,
    pub(crate) settings: TrainSettings,
    pub(crate) schedule: Schedule,
    pub(crate) views: Vec<Posed>,
    /// Their poses as given; those of the views may be refined.
    pub(crate) given: Vec<Pose>,
    pub(crate) photos: TrainPhotoCache,
    pub(crate) warnings: Vec<String>,
    pub(crate) state: TrainState,
    /// Unlike that of any other trainer of the process: engines keep photos by it.
    pub(crate) id: u64,
    /// The splats while they are on the device; those of the state are then old.
    pub(crate) resident: Option<Box<dyn DeviceTraining>>,
    /// Whether they may be uploaded.
    pub(crate) may_upload: bool,
    /// The perceptual distance, if its weights were given.
    pub(crate) lpips: Option<Arc<Lpips>>,
    /// Points of the stereo initialisation.
    pub(crate) stereo_count: usize,
    /// Mean share of the photos that is transient, by the search before the training.
    pub(crate) initial_transient_share: Option<f32>,
    /// The blocks that the scene is divided into, where it is.
    pub(crate) blocks: Option<Arc<BlockTurns>>,
    /// The turn of the last step.
    pub(crate) turn: Option<BlockTurn>,
}

impl Trainer {
    /// Starts from the scene's points. The views not held out are trained on.
    pub fn new(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        settings: TrainSettings,
    ) -> Result<Trainer, TrainError> {
        Trainer::from_points(engine, scene, photos, settings, true)
    }

    /// The same; by blocks only where that is `divided`. Otherwise it has no more splats than a training by blocks has
    /// at first.
    pub(crate) fn from_points(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        settings: TrainSettings,
        divided: bool,
    ) -> Result<Trainer, TrainError> {
        settings.check()?;
        let requested = settings.blocks;
        let settings = settings.decided(scene);
        let poses = PosesByPoints::of(scene, &settings);
        let mut cache = photo_cache(scene, photos, &settings);
        let refined = with_poses(scene, &poses.refined);
        let coloured = coloured(&refined, &mut cache, &|_, _| false)?;
        let trainer = Trainer::start(engine, &coloured, cache, settings, 0, &[])?.with_poses(scene, poses);
        Ok(if divided { trainer.divided(requested, scene, &coloured.points) } else { trainer })
    }

    /// The same, started from a scene with poses that its points refined.
    pub(crate) fn with_poses(mut self, given: &Scene, poses: PosesByPoints) -> Trainer {
        self.given = given.views.iter().map(|view| view.pose).collect();
        (self.state.refined, self.state.open_poses) = (poses.refined, poses.open);
        self
    }

    /// Starts from the scene's points and those of `stereo`, on photos that are halved `finest` times at the least.
    pub(crate) fn start(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        mut cache: TrainPhotoCache,
        settings: TrainSettings,
        finest: usize,
        stereo: &[Point],
    ) -> Result<Trainer, TrainError> {
        let mut train: Vec<usize> = (0..scene.views.len()).filter(|&i| !scene.views[i].test).collect();
        let mut skipped: Vec<(String, String)> = train.iter().filter_map(|&i| cache.refused(i)).collect();
        train.retain(|&i| cache.refused(i).is_none());
        // The first usable photo gives the size trained at.
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
        let (_, size) = first.1.level(finest);
        let long_side = size.width.max(size.height) as u32;
        let mut eyes: Vec<Option<Eye>> = vec![None; scene.views.len()];
        for &i in &train {
            eyes[i] = Some((scene.views[i].camera.scaled_to(long_side), scene.views[i].pose));
        }
        let splat_budget = SplatBudget::new(&settings, scene.points.len(), train.len(), size.pixels());
        let mut random = Random::new(settings.seed);
        let schedule = Schedule::new(&settings).no_finer_than(finest);
        let cap = settings.first_cap(splat_budget.splats());
        let start = initial_splats(scene, stereo, &eyes, schedule.sh_degree(0), cap, &mut random);
        let appearance = appearances::initial(&settings, scene.views.len());
        let splat_embeddings = appearance.as_appearance().first_embeddings(&start.splats.means);
        let state = TrainState {
            step: 0,
            strategy: Strategy::new(&settings, start.splats.len()),
            params: Params::new(start.splats, splat_embeddings),
            appearance,
            backgrounds: vec![None; scene.views.len()],
            robust: ResidualHistograms::new(
                vec![settings.robust_share; scene.views.len()],
                vec![None; scene.views.len()],
            ),
            initial_transients: vec![None; scene.views.len()],
            sampler: Sampler::new(&train),
            random,
            quality: vec![None; scene.views.len()],
            refined: vec![None; scene.views.len()],
            open_poses: vec![false; scene.views.len()],
            skipped,
            pause_until: 0,
            pixel: start.pixel,
            splat_budget,
            since: ([0.0; 3], 0),
        };
        for warning in &start.warnings {
            tracing::warn!("{warning}");
        }
        let warnings = start.warnings;
        Ok(Trainer { warnings, ..Trainer::of_state(engine, settings, schedule, posed(scene), cache, state) })
    }

    /// A training in a given state, its splats on the host.
    pub(crate) fn of_state(
        engine: Arc<dyn Engine>,
        settings: TrainSettings,
        schedule: Schedule,
        mut views: Vec<Posed>,
        photos: TrainPhotoCache,
        state: TrainState,
    ) -> Trainer {
        let given = views.iter().map(|view| view.pose).collect();
        for (view, refined) in views.iter_mut().zip(&state.refined) {
            if let Some(refined) = refined {
                view.pose = refined.pose();
            }
        }
        Trainer {
            engine,
            settings,
            schedule,
            views,
            given,
            photos,
            warnings: Vec::new(),
            state,
            id: TRAINERS.fetch_add(1, Ordering::Relaxed),
            resident: None,
            may_upload: true,
            lpips: None,
            stereo_count: 0,
            initial_transient_share: None,
            blocks: None,
            turn: None,
        }
    }

    /// Holds so many MiB of decoded photos from now on. What is trained does not depend on it.
    pub fn hold_photos(&mut self, mib: usize) {
        self.photos.limit_to(mib << 20);
    }

    /// Gives the weights of LPIPS, which the loss has where [`TrainSettings::lambda_lpips`] is above 0. No checkpoint holds
    /// them.
    pub fn set_lpips(&mut self, lpips: Option<Arc<Lpips>>) {
        self.lpips = lpips;
    }

    /// The settings of this run.
    pub fn settings(&self) -> &TrainSettings {
        &self.settings
    }

    /// Steps done.
    pub fn steps_done(&self) -> u32 {
        self.state.step
    }

    /// Means of loss, PSNR in dB and share left out over the steps since the last call, of this trainer or of the
    /// one whose checkpoint it continues.
    pub fn means(&mut self) -> [f32; 3] {
        let (sums, steps) = std::mem::take(&mut self.state.since);
        sums.map(|sum| sum / steps.max(1) as f32)
    }

    /// Whether all steps are done.
    pub fn is_done(&self) -> bool {
        self.state.step >= self.settings.steps
    }

    /// Warnings about the start, in sentences.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The initial transients of a view, at any size: pixels left out from the start. `None` where nothing
    /// is known.
    pub fn initial_transients(&self, view: usize) -> Option<&Mask> {
        self.state.initial_transients[view].as_ref()
    }

    /// Mean share of the photos that is transient, by the search before the training; `None` where none was made, and in
    /// a training that was resumed.
    pub fn initial_transient_share(&self) -> Option<f32> {
        self.initial_transient_share
    }

    /// Per view, the largest share of its photo that may be left out as transient; 0 where it shows none.
    pub fn robust_shares(&self) -> &[f32] {
        self.state.robust.shares()
    }

    /// Number of points of the stereo initialisation; 0 in a training that was resumed.
    pub fn stereo_count(&self) -> usize {
        self.stereo_count
    }

    /// The photos in the order of the next steps, each at least once: which to have ready first.
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
    pub(crate) fn next_photo(&mut self) -> Result<(usize, Arc<Stored>), TrainError> {
        loop {
            let Some(view) = self.state.sampler.next(&mut self.state.random) else {
                // Without blocks, or without a photo in any of them.
                if !self.leave_turn()? {
                    return Err(no_photos(&self.state.skipped));
                }
                continue;
            };
            match self.photos.get(view) {
                Ok(stored) => {
                    let is_last = self.state.step + 1 >= self.settings.steps;
                    if let Some(next) = self.state.sampler.upcoming().filter(|_| !is_last) {
                        self.photos.read_ahead(next);
                    }
                    return Ok((view, stored));
                }
                Err(TrainError::Photo { name, reason }) => {
                    tracing::warn!("photo `{name}` is left out: {reason}");
                    self.state.skipped.push((name, reason));
                    self.state.sampler.drop_last();
                }
                Err(other) => return Err(other),
            }
        }
    }

    /// The learning rates of a step.
    pub(crate) fn rates(&self, step: u32) -> Rates {
        let s = &self.settings;
        let late = self.schedule.late_factor(step);
        Rates {
            mean: s.lr_mean * self.state.pixel * self.schedule.mean_factor(step),
            opacity: s.lr_opacity * late,
            scale: s.lr_scale * late,
            rotation: s.lr_rotation * late,
            colour: s.lr_colour * late,
            splat_embedding: s.lr_splat_embedding * self.schedule.embedding_factor(step),
        }
    }

    /// The camera of a view at a level of its photo.
    pub(crate) fn camera(&self, view: usize, stored: &Stored, level: usize) -> Camera {
        stored.camera(&self.views[view].camera, level)
    }
}

/// The photos of a scene, held as far as the settings say.
pub(crate) fn photo_cache(
    scene: &Scene,
    photos: Arc<dyn Photos>,
    settings: &TrainSettings,
) -> TrainPhotoCache {
    let names = scene.views.iter().map(|v| v.name.clone()).collect();
    TrainPhotoCache::new(photos, names, settings.photo_cache_mib << 20)
}

/// The error of a training none of whose photos can be used, by their names and reasons: the first three, and how many more
/// there are.
pub(crate) fn no_photos(skipped: &[(String, String)]) -> TrainError {
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
