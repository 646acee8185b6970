//! The training loop.

use crate::appearances;
use crate::colours::coloured;
use crate::density::{DensityChange, Strategy};
use crate::initial::{Eye, initial_splats};
use crate::initial_transients::initial_transients;
use crate::model::{Model, Stats};
use crate::params::Params;
use crate::photos::{Photos, Stored, TrainPhotoCache};
use crate::posed::{Posed, posed};
use crate::sampler::Sampler;
use crate::schedule::Schedule;
use crate::splat_budget::SplatBudget;
use crate::state::{TrainState, mean_quality};
use crate::stereo_points;
use crate::{TrainError, TrainSettings};
use segwild_objective::transients::ResidualHistograms;
use segwild_objective::{AnyAppearance, Engine, Resident};
use segwild_scene::Random;
use segwild_scene::{Camera, Mask, Point, Scene, Skipped};
use std::borrow::Cow;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use wincode::{SchemaRead, SchemaWrite};

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
    pub(crate) photos: TrainPhotoCache,
    warnings: Vec<String>,
    pub(crate) state: TrainState,
    /// Unlike that of any other trainer of the process: engines keep photos by it.
    pub(crate) id: u64,
    /// The splats while they are on the device; those of the state are then old.
    pub(crate) resident: Option<Box<dyn Resident>>,
    /// Whether they may be uploaded.
    pub(crate) may_upload: bool,
    /// Points of the stereo initialisation.
    stereo_count: usize,
    /// Mean share of the photos that is transient, by the search before the training.
    initial_transient_share: Option<f32>,
}

/// A training that can be continued: with the same scene, photos and settings it ends in the same bytes as
/// one that never stopped.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Checkpoint {
    /// The settings, name and value.
    settings: Vec<(String, String)>,
    /// Names of the scene's views.
    names: Vec<String>,
    state: TrainState,
}

impl Checkpoint {
    /// Steps done.
    pub fn step(&self) -> u32 {
        self.state.step
    }

    /// The scene as it was then, if the checkpoint is whole.
    ///
    /// # Errors
    /// When it does not fit itself: it may come from elsewhere.
    pub fn model(&self) -> Result<Model, TrainError> {
        self.state.check(self.names.len())?;
        let settings = settings_of(&self.settings)?;
        Ok(model_of(&self.state, self.names.clone(), settings.antialias))
    }
}

/// The settings of a checkpoint.
fn settings_of(named: &[(String, String)]) -> Result<TrainSettings, TrainError> {
    use segwild_scene::settings::Group;
    let mut settings = TrainSettings::default();
    for (name, value) in named {
        settings.set(name, value).map_err(|e| TrainError::Checkpoint(e.to_string()))?;
    }
    settings.check()?;
    Ok(settings)
}

/// The scene of a training's state. Views are named by `names`.
fn model_of(state: &TrainState, names: Vec<String>, antialias: bool) -> Model {
    let mut appearance = state.appearance.clone();
    let known = (0..names.len()).filter(|&v| state.backgrounds[v].is_some());
    appearances::set_mean(&mut appearance, names.len(), known);
    if let AnyAppearance::Gsw(appearance) = &mut appearance {
        appearance.forget_training();
    }
    Model {
        splats: state.params.splats.clone(),
        splat_embeddings: state.params.splat_embeddings.clone(),
        appearance,
        backgrounds: state.backgrounds.clone(),
        names,
        trained_on: state.sampler.views().iter().map(|&v| v as u32).collect(),
        transient_shares: state.robust.shares().to_vec(),
        transient_evidence: state.robust.evidence().to_vec(),
        antialias,
        stats: Stats { step: state.step, psnr: mean_quality(&state.sampler.views(), &state.quality) },
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
        let settings = settings.decided(scene);
        let mut cache = photo_cache(scene, photos, &settings);
        let scene = coloured(scene, &mut cache, &|| false)?;
        Trainer::start(engine, &scene, cache, settings, 0, &[])
    }

    /// The same after a search for initial transients by [`TrainSettings::cross_checks`] other trainings, and after stereo
    /// initialisation ([`TrainSettings::stereo`]); `stopping` ends these.
    pub fn prepared(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        settings: TrainSettings,
        stopping: &dyn Fn() -> bool,
    ) -> Result<Trainer, TrainError> {
        settings.check()?;
        let settings = settings.decided(scene);
        let mut cache = photo_cache(scene, photos, &settings);
        let scene = &*coloured(scene, &mut cache, stopping)?;
        let found = initial_transients(&engine, scene, &mut cache, &settings, stopping)?;
        let stereo = stereo_points::points(scene, &mut cache, &settings, &found.masks, stopping)?;
        let robust = ResidualHistograms::new(found.robust_shares(&settings), found.shares.clone());
        let mut trainer = Trainer::start(engine, scene, cache, settings, 0, &stereo)?;
        trainer.initial_transient_share = found.mean_share();
        trainer.state.initial_transients = found.masks;
        trainer.state.robust = robust;
        trainer.stereo_count = stereo.len();
        Ok(trainer)
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
        let start =
            initial_splats(scene, stereo, &eyes, schedule.sh_degree(0), splat_budget.splats(), &mut random);
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
            skipped,
            pause_until: 0,
            pixel: start.pixel,
            splat_budget,
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
            id: TRAINERS.fetch_add(1, Ordering::Relaxed),
            resident: None,
            may_upload: true,
            stereo_count: 0,
            initial_transient_share: None,
        })
    }

    /// Continues from a checkpoint of the same scene, with the settings it was made with.
    pub fn resume(
        engine: Arc<dyn Engine>,
        scene: &Scene,
        photos: Arc<dyn Photos>,
        checkpoint: Checkpoint,
    ) -> Result<Trainer, TrainError> {
        let settings = settings_of(&checkpoint.settings)?;
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
        let mut photos = photo_cache(scene, photos, &settings);
        let schedule = Schedule::new(&settings);
        let state = checkpoint.state;
        // Points' colours are needed at the first step of a photo.
        let unseen = state.sampler.views().iter().any(|&view| state.backgrounds[view].is_none());
        let scene = if unseen { coloured(scene, &mut photos, &|| false)? } else { Cow::Borrowed(scene) };
        Ok(Trainer {
            engine,
            schedule,
            views: posed(&scene),
            photos,
            warnings: Vec::new(),
            state,
            settings,
            id: TRAINERS.fetch_add(1, Ordering::Relaxed),
            resident: None,
            may_upload: true,
            stereo_count: 0,
            initial_transient_share: None,
        })
    }

    /// Holds so many MiB of decoded photos from now on. What is trained does not depend on it.
    pub fn hold_photos(&mut self, mib: usize) {
        self.photos.limit_to(mib << 20);
    }

    /// Everything needed to continue later.
    pub fn checkpoint(&mut self) -> Result<Checkpoint, TrainError> {
        self.download()?;
        use segwild_scene::settings::Group;
        let settings = TrainSettings::FIELDS
            .iter()
            .map(|f| (f.name.to_owned(), self.settings.get(f.name).expect("a field of the group")))
            .collect();
        let names = self.views.iter().map(|v| v.name.clone()).collect();
        Ok(Checkpoint { settings, names, state: self.state.clone() })
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
    pub(crate) fn camera(&self, view: usize, stored: &Stored, level: usize) -> Camera {
        stored.camera(&self.views[view].camera, level)
    }

    /// The scene as it is now.
    pub fn snapshot(&mut self) -> Result<Model, TrainError> {
        self.download()?;
        let names = self.views.iter().map(|v| v.name.clone()).collect();
        Ok(model_of(&self.state, names, self.settings.antialias))
    }

    /// Does the steps that are left, then hands the scene over.
    pub fn finish(mut self) -> Result<Model, TrainError> {
        while !self.is_done() {
            self.step()?;
        }
        self.snapshot()
    }
}

fn photo_cache(scene: &Scene, photos: Arc<dyn Photos>, settings: &TrainSettings) -> TrainPhotoCache {
    let names = scene.views.iter().map(|v| v.name.clone()).collect();
    TrainPhotoCache::new(photos, names, settings.photo_cache_mib << 20)
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
