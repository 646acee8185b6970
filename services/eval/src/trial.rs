//! One synthetic scene put through the whole program: trained, clicked once per object, scored against what is true.

use crate::metrics::{self, MetricError, leakage};
use crate::oracle::{ORACLE, Oracle, OracleOptions};
use segwild_flow::Stopper;
use segwild_pipeline::{
    HeldOut, PhotoPrompts, RunError, RunFolder, RunOptions, SegmentOutcome, Selected, Session,
    SessionOptions, Settings, Until, run,
};
use segwild_scene::{BoxPrompt, Mask, PointPrompt, Prompts, SceneError};
use segwild_synthetic::{
    Manifest, ObjectKind, ObjectTruth, SyntheticError, SyntheticOptions, SyntheticPhoto, SyntheticScene,
    generate,
};
use segwild_vision::{Providers, VisionError};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::Instant;

/// The provider of masks and descriptors in a trial.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProviderKind {
    /// The truth, with faults of a known size: what the 3D part alone is worth, whatever the 2D models are. No user has it.
    Oracle,
    /// What the settings name, as a user has it: the built-in provider, or networks.
    #[default]
    Builtin,
}

/// An object counts on the photos on which it covers at least one pixel in this many.
const LEAST: usize = 1000;

/// A part gets a click of its own when it makes up at least one pixel in this many of what is seen of the object.
const PART: usize = 10;

/// The surface that no click may reach.
const OCCLUDED_WALL: &str = "occluded_wall";

/// Why a trial cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum TrialError {
    /// The scene could not be made.
    #[error(transparent)]
    Synthetic(#[from] SyntheticError),
    /// A run failed.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The providers that the settings name cannot be had.
    #[error(transparent)]
    Vision(#[from] VisionError),
    /// A mask that the run wrote cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A mask does not fit its truth.
    #[error("{object}, {photo}: {source}")]
    Metric {
        /// The object.
        object: String,
        /// The photo.
        photo: String,
        /// What does not fit.
        source: MetricError,
    },
    /// The table has no row of this name.
    #[error("there is no row `{requested}`; the rows are {known}")]
    Row {
        /// The name.
        requested: String,
        /// The names of the rows that there are.
        known: String,
    },
}

impl TrialError {
    /// Refuses the name of a row; `known` are the names of those that there are.
    pub(crate) fn no_row<'a>(requested: &str, known: impl Iterator<Item = &'a str>) -> TrialError {
        let mut names: Vec<&str> = Vec::new();
        for name in known {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        TrialError::Row { requested: requested.to_owned(), known: names.join(", ") }
    }
}

/// How well one object was found from its click.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ObjectScore {
    /// The object.
    pub object: String,
    /// The photo that was clicked.
    pub clicked: String,
    /// Photos that count: not clicked, and the object covers at least 0.1 % of them.
    pub photos: usize,
    /// Mean IoU of the visible mask; 0 where nothing was selected.
    pub iou: f64,
    /// The worst photo's IoU.
    pub worst: f64,
    /// Mean share of pixels that are right.
    pub accuracy: f64,
    /// Mean Boundary IoU.
    pub boundary_iou: f64,
    /// Mean IoU of the object rendered alone with what would be seen of it if nothing else were there.
    pub amodal_iou: f64,
    /// Mean Boundary IoU of the same.
    pub amodal_boundary_iou: f64,
    /// IoU in 3D: splats by their nearest true surface, weighted by opacity.
    pub label_iou: f64,
    /// Share of the occluded wall's splats that were selected.
    pub occluded_leak: f64,
    /// Mean share of the selected pixels that are of other objects: what stands on a wall or on the ground that was clicked,
    /// or before it.
    pub standing: f64,
    /// Splats that the spike cut shortened, dropped or took a piece of.
    pub cut: usize,
    /// What the program reported about the prompts: diagnostics, or why it refused.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub notes: Vec<String>,
    /// Seconds from the prompts to the selection, the scene being loaded; `None` where nothing was selected.
    pub select_s: Option<f64>,
}

impl ObjectScore {
    /// The numbers by the names that records have for them.
    pub fn numbers(&self) -> BTreeMap<String, f64> {
        let mut numbers = vec![
            ("iou", self.iou),
            ("worst", self.worst),
            ("accuracy", self.accuracy),
            ("boundary_iou", self.boundary_iou),
            ("amodal_iou", self.amodal_iou),
            ("amodal_boundary_iou", self.amodal_boundary_iou),
            ("label_iou", self.label_iou),
            ("occluded_leak", self.occluded_leak),
            ("photos", self.photos as f64),
        ];
        numbers.extend(self.select_s.map(|s| ("select_s", s)));
        numbers.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
    }
}

/// A scene, its truth and its run.
pub struct Trial {
    scene: SyntheticScene,
    manifest: Manifest,
    folder: RunFolder,
    scene_dir: PathBuf,
    oracle: Option<Arc<Oracle>>,
    /// The amodal masks of each instance (what would be seen of it alone), traced at first use.
    alone: Vec<OnceLock<Vec<Mask>>>,
}

impl Trial {
    /// Makes the scene in `dir/scene`; its run lives in `dir/run`. A trial in the same folder continues.
    pub fn new(
        dir: &Path,
        options: &SyntheticOptions,
        providers: ProviderKind,
        faults: &OracleOptions,
    ) -> Result<Trial, TrialError> {
        Trial::of(dir, generate(options)?, providers, faults)
    }

    /// The same for a scene that was made, and perhaps changed, before.
    pub fn of(
        dir: &Path,
        scene: SyntheticScene,
        providers: ProviderKind,
        faults: &OracleOptions,
    ) -> Result<Trial, TrialError> {
        let scene_dir = dir.join("scene");
        let manifest = scene.write(&scene_dir)?;
        let folder = RunFolder::create(&dir.join("run"))?;
        let oracle =
            (providers == ProviderKind::Oracle).then(|| Arc::new(Oracle::new(&scene, faults.clone())));
        let alone = scene.instances.iter().map(|_| OnceLock::new()).collect();
        Ok(Trial { scene, manifest, folder, scene_dir, oracle, alone })
    }

    /// The scene and its truth.
    pub fn scene(&self) -> &SyntheticScene {
        &self.scene
    }

    /// The contents of the scene's `truth.json`.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Where the scene was written.
    pub fn scene_dir(&self) -> &Path {
        &self.scene_dir
    }

    /// The run.
    pub fn folder(&self) -> &RunFolder {
        &self.folder
    }

    /// The providers that settings mean here. The oracle also finds the sky, unless there is to be none.
    pub fn providers(&self, settings: &Settings) -> Result<Providers, TrialError> {
        let mut providers = Providers::from_settings(&settings.vision)?;
        if let Some(oracle) = &self.oracle {
            providers.embedder = oracle.clone();
            providers.proposer = oracle.clone();
            providers.segmenter = oracle.clone();
            if settings.vision.sky != segwild_vision::SkyChoice::None {
                providers.sky = oracle.clone();
            }
            providers.name = ORACLE.into();
            providers.notes = vec!["descriptors, masks, refinement and sky: oracle".into()];
        }
        Ok(providers)
    }

    /// Trains the scene up to the feature field; what is already there is not made again.
    pub fn train(&self, settings: &Settings) -> Result<(), TrialError> {
        let providers = Some(self.providers(settings)?);
        let options = RunOptions { until: Until::stage("features"), providers, ..RunOptions::default() };
        run(&self.scene_dir, &self.folder, settings, &options)?;
        Ok(())
    }

    /// Trains the scene and scores the photos that are held out.
    pub fn held_out(&self, settings: &Settings) -> Result<Option<HeldOut>, TrialError> {
        let providers = Some(self.providers(settings)?);
        let options = RunOptions { until: Until::stage("evaluate"), providers, ..RunOptions::default() };
        Ok(run(&self.scene_dir, &self.folder, settings, &options)?.held_out)
    }

    /// Clicks every object once, in the training photo that shows it best, and scores what is selected. `report` receives
    /// of each as soon as it is known.
    pub fn objects(
        &self,
        settings: &Settings,
        mut report: impl FnMut(&ObjectScore),
    ) -> Result<Vec<ObjectScore>, TrialError> {
        let session = self.session(settings)?;
        let mut scores = Vec::new();
        for object in self.manifest.objects.iter().filter(|o| o.kind == ObjectKind::Object) {
            let Some(click) = object.clicks.first() else { continue };
            let prompts = Prompts::click(click.x, click.y);
            let score = session.score(object, PhotoPrompts { photo: click.photo.clone(), prompts })?;
            report(&score);
            scores.push(score);
        }
        Ok(scores)
    }

    /// What a person who wants the whole object says on the photo that shows it best: a box around what is seen of
    /// it, and a click on each of its larger parts. `None` where no photo shows it well enough.
    pub fn prompts(&self, object: &ObjectTruth) -> Option<PhotoPrompts> {
        let click = object.clicks.first()?;
        let photo = self.scene.photos.iter().find(|p| p.name == click.photo)?;
        let seen = photo.mask(object.id).minus(&photo.transients);
        let mut prompts = Prompts::default();
        let mut around = BoxPrompt { x0: f32::MAX, y0: f32::MAX, x1: 0.0, y1: 0.0 };
        for (x, y) in seen.pixels() {
            let (x, y) = (x as f32, y as f32);
            around.x0 = around.x0.min(x);
            around.y0 = around.y0.min(y);
            around.x1 = around.x1.max(x + 1.0);
            around.y1 = around.y1.max(y + 1.0);
        }
        prompts.boxes.push(around);
        let parts = (0..self.scene.parts.len() as u16)
            .filter(|p| self.scene.parts[usize::from(*p)].instance == object.id);
        for part in parts {
            let mask = photo.part_mask(part).minus(&photo.transients);
            if mask.count() * PART < seen.count() {
                continue;
            }
            let depth = mask.not().distances();
            let deepest = mask.pixels().map(|(x, y)| (depth[(y * mask.width() + x) as usize], x, y));
            if let Some((_, x, y)) = deepest.max_by(|a, b| a.0.total_cmp(&b.0)) {
                prompts.points.push(PointPrompt { x: x as f32 + 0.5, y: y as f32 + 0.5, inside: true });
            }
        }
        Some(PhotoPrompts { photo: click.photo.clone(), prompts })
    }

    /// The trained run, ready for prompts.
    pub fn session<'a>(&'a self, settings: &'a Settings) -> Result<TrialSession<'a>, TrialError> {
        let options =
            SessionOptions { providers: Some(self.providers(settings)?), ..SessionOptions::default() };
        let session = Session::open(&self.folder, options)?;
        let labels = self.scene.label(&session.scene().frame, &session.model().splats.means);
        Ok(TrialSession { trial: self, settings, session, labels })
    }

    /// Scores the masks that a selection left.
    fn masks(&self, id: u16, score: &mut ObjectScore) -> Result<(), TrialError> {
        let (object, clicked) = (score.object.clone(), score.clicked.clone());
        let target = self.folder.selection(&object);
        let mut sums = [0.0; 5];
        let (mut count, mut worst, mut standing) = (0, 1.0f64, 0.0);
        let whole = self.alone[usize::from(id)].get_or_init(|| self.scene.amodal(id));
        for (photo, whole) in self.scene.photos.iter().zip(whole).filter(|p| p.0.name != clicked) {
            let truth = photo.mask(id);
            if truth.count() * LEAST < photo.instances.len() {
                continue;
            }
            let file = Path::new(&photo.name).with_extension("png");
            let visible = Mask::read_png(&target.join("masks").join(&file))?;
            let alone = Mask::read_png(&target.join("amodal").join(&file))?;
            let compare = |mask: &Mask, truth: &Mask| {
                metrics::score(mask, truth, None).map_err(|source| TrialError::Metric {
                    object: object.clone(),
                    photo: photo.name.clone(),
                    source,
                })
            };
            let (seen, alone) = (compare(&visible, &truth)?, compare(&alone, whole)?);
            let found = [seen.iou, seen.accuracy, seen.boundary_iou, alone.iou, alone.boundary_iou];
            sums.iter_mut().zip(found).for_each(|(sum, x)| *sum += x);
            worst = worst.min(seen.iou);
            standing += self.standing(photo, &visible, id);
            count += 1;
        }
        if count > 0 {
            [score.iou, score.accuracy, score.boundary_iou, score.amodal_iou, score.amodal_boundary_iou] =
                sums.map(|s| s / f64::from(count));
            (score.photos, score.worst) = (count as usize, worst);
            score.standing = standing / f64::from(count);
        }
        Ok(())
    }

    /// Share of a mask's pixels on which the photo shows another object than `id`.
    fn standing(&self, photo: &SyntheticPhoto, mask: &Mask, id: u16) -> f64 {
        let is_other = |i: u16| {
            i != id && self.scene.instances.get(usize::from(i)).is_some_and(|o| o.kind != ObjectKind::Surface)
        };
        let (w, h) = (photo.camera.width, photo.camera.height);
        let mask = if (mask.width(), mask.height()) == (w, h) { mask.clone() } else { mask.resized(w, h) };
        let others = mask.pixels().filter(|&(x, y)| is_other(photo.instances[(y * w + x) as usize])).count();
        others as f64 / mask.count().max(1) as f64
    }
}

/// How long a click took, and what it visited.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClickTiming {
    /// Seconds to the first answer.
    pub first_s: f64,
    /// Seconds to the last one.
    pub last_s: f64,
    /// Photos that were visited beside the clicked one.
    pub visited: usize,
}

/// A trained trial and what is true of its splats.
pub struct TrialSession<'a> {
    trial: &'a Trial,
    settings: &'a Settings,
    session: Session,
    /// Nearest instance per splat.
    labels: Vec<u16>,
}

impl TrialSession<'_> {
    /// Who makes the masks.
    pub fn provider(&self) -> &str {
        self.session.provider()
    }

    fn select(&self, name: &str, prompts: PhotoPrompts) -> Result<SegmentOutcome, RunError> {
        let pending = self.session.ask(&[prompts][..].into(), &self.settings.segment, &Stopper::new())?;
        self.session.save(name, &pending.wait(|_, _| ())?)
    }

    /// Times the answers to prompts, without saving or scoring them; `None` where they select nothing.
    pub fn time(&self, prompts: PhotoPrompts) -> Result<Option<ClickTiming>, TrialError> {
        let began = Instant::now();
        let mut first_s = None;
        let pending = self.session.ask(&[prompts][..].into(), &self.settings.segment, &Stopper::new());
        let answer = pending.and_then(|pending| {
            pending.wait(|_, _| {
                first_s.get_or_insert_with(|| began.elapsed().as_secs_f64());
            })
        });
        match answer {
            Ok(answer) => {
                let (last_s, visited) = (answer.select_s, answer.segmented.selection.visits.len());
                Ok(Some(ClickTiming { first_s: first_s.unwrap_or(last_s), last_s, visited }))
            }
            Err(RunError::Segment(error)) if error.is_nothing() => Ok(None),
            Err(other) => Err(other.into()),
        }
    }

    /// Selects what the prompts mean and scores it.
    pub fn score(&self, object: &ObjectTruth, prompts: PhotoPrompts) -> Result<ObjectScore, TrialError> {
        let (trial, name) = (self.trial, &object.name);
        let mut score = ObjectScore {
            object: name.clone(),
            clicked: prompts.photo.clone(),
            photos: 0,
            iou: 0.0,
            worst: 0.0,
            accuracy: 0.0,
            boundary_iou: 0.0,
            amodal_iou: 0.0,
            amodal_boundary_iou: 0.0,
            label_iou: 0.0,
            occluded_leak: 0.0,
            standing: 0.0,
            cut: 0,
            notes: Vec::new(),
            select_s: None,
        };
        match self.select(name, prompts) {
            Ok(outcome) => {
                score.select_s = Some(outcome.select_s);
                score.cut = outcome.cut + outcome.dropped + outcome.joined;
                score.notes = outcome.notes;
                trial.masks(object.id, &mut score)?;
                let splats = &self.session.model().splats;
                let selected = Selected::read(&trial.folder, name, splats.len())?.labels;
                let opacity = |i: usize| f64::from(splats.opacity(i));
                score.label_iou = metrics::label_iou(&selected, &self.labels, object.id, opacity);
                let wall = trial.scene.instance_named(OCCLUDED_WALL);
                score.occluded_leak = wall.map_or(0.0, |wall| leakage(&selected, &self.labels, wall));
            }
            // Nothing selected is nothing right.
            Err(RunError::Segment(error)) if error.is_nothing() => score.notes.push(error.to_string()),
            Err(other) => return Err(other.into()),
        }
        Ok(score)
    }
}
