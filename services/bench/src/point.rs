//! One point of a sweep: a scene trained under some settings, clicked and scored, and what that cost.
//!
//! Cost is only comparable between processes that did one thing each: [`apart`] starts a program for every [`PointJob`],
//! and nothing is shared between two of them.

mod error;
mod folder_objects;

pub use self::error::PointError;
use self::folder_objects::{FolderObject, objects};
use crate::counted::{Calls, counted};
use crate::harm::Harm;
use segwild_eval::oracle::OracleOptions;
use segwild_eval::protocols::folder::Parts;
use segwild_eval::record::Record;
use segwild_eval::trial::{ClickTiming, ProviderKind, Trial, TrialError};
use segwild_flow::{Event, Events, Stopper, cpu};
use segwild_pipeline::{
    Loaded, PhotoPrompts, RunError, RunFolder, RunOptions, Settings, SettingsError, Summary, Until, run,
    score, segment,
};
use segwild_raster::{CpuEngine, Rasterizer};
use segwild_scene::Prompts;
use segwild_synthetic::random::Rng;
use segwild_synthetic::{ObjectKind, ObjectTruth, SyntheticOptions, SyntheticPhoto, generate};
use segwild_vision::Providers;
use serde::{Deserialize, Serialize};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

/// Where the photos come from, and what is true of them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PhotoSource {
    /// A synthetic source: every object is clicked once.
    Synthetic(SyntheticOptions),
    /// A folder of photos. Each object with true masks in `truth/`, or in a folder of its own there, is shown in three photos,
    /// one after the other; where there is no `truth/`, only the training counts.
    Folder {
        /// The scene.
        path: PathBuf,
        /// Where the object's parts meet: of the photos that this lists, by a click into each part; by a box and two clicks
        /// in any photo if it lists none.
        parts: Parts,
    },
}

/// What records and pages call a scene, by its folder.
pub(crate) fn name_of(scene: &Path) -> String {
    scene.file_name().map_or_else(|| "scene".into(), |name| name.to_string_lossy().into_owned())
}

impl PhotoSource {
    /// What records and pages call it.
    pub fn name(&self) -> String {
        match self {
            PhotoSource::Synthetic(options) => format!("seed {}", options.seed),
            PhotoSource::Folder { path, .. } => name_of(path),
        }
    }
}

/// What to measure.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct PointJob {
    /// [`Record::protocol`] of what comes out.
    pub protocol: String,
    /// [`Record::setting`].
    pub setting: String,
    /// [`Record::at`].
    pub at: Option<f64>,
    /// The scene.
    pub source: PhotoSource,
    /// The provider of masks and descriptors.
    pub providers: ProviderKind,
    /// Faults of the oracle, where it is the provider.
    pub faults: OracleOptions,
    /// Settings by name, later ones winning.
    pub settings: Vec<(String, String)>,
    /// What is wrong with a synthetic scene.
    #[serde(default)]
    pub harm: Harm,
    /// Where objects of a synthetic scene are clicked.
    #[serde(default)]
    pub prompting: Prompting,
    /// Whether work is counted beside the quality: `steps`, `calls` of the providers, and `pairs` of a splat and a tile
    /// that rendering every training photo once blends. Counts do not depend on how busy a machine is.
    #[serde(default)]
    pub count: bool,
    /// Seed of the training.
    pub seed: u64,
    /// Folder for the scene and the run.
    pub dir: PathBuf,
}

/// Where objects of a synthetic scene are clicked.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Prompting {
    /// Deepest inside, in the photo that shows the object best; with the built-in provider, a box and clicks as a person gives them.
    #[default]
    Best,
    /// So many pixels from there, in a random direction.
    Beside(f32),
    /// So many pixels inside the outline, in the same photo.
    Inside(f32),
    /// So many times anywhere on the object, each in a random photo that shows it.
    Random(u32),
    /// The same, and only timed: what is selected is neither saved nor scored.
    Timed(u32),
    /// Nowhere: only the training counts.
    Nowhere,
}

impl PointJob {
    /// The settings in force. What is compared is scored alike, whatever its appearance model.
    pub fn settings(&self) -> Result<Settings, SettingsError> {
        let mut pairs = vec![("scoring".to_owned(), "halves".to_owned())];
        pairs.extend(self.settings.iter().cloned());
        pairs.push(("seed".into(), self.seed.to_string()));
        Settings::layered(None, &pairs)
    }

    fn record(&self, target: &str, prompt: u32, numbers: &[(&str, f64)]) -> Record {
        Record {
            protocol: self.protocol.clone(),
            scene: self.source.name(),
            setting: self.setting.clone(),
            at: self.at,
            target: target.into(),
            seed: self.seed,
            prompt,
            numbers: numbers.iter().map(|(name, value)| ((*name).to_owned(), *value)).collect(),
            ..Record::default()
        }
    }
}

/// Measures in a process of its own: `program bench point` reads the job from its standard input and writes the records
/// to its standard output.
pub fn apart(program: &Path, job: &PointJob) -> Result<Vec<Record>, PointError> {
    let failed = |what: String| PointError::Child(what);
    let text = serde_json::to_vec(job).map_err(|e| failed(e.to_string()))?;
    let mut child = Command::new(program)
        .args(["bench", "point"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|e| failed(format!("{}: {e}", program.display())))?;
    if let Some(mut input) = child.stdin.take() {
        input.write_all(&text).map_err(|e| failed(e.to_string()))?;
    }
    let output = child.wait_with_output().map_err(|e| failed(e.to_string()))?;
    if !output.status.success() {
        let message = String::from_utf8_lossy(&output.stderr);
        return Err(failed(format!("{}: {}", output.status, message.trim())));
    }
    serde_json::from_slice(&output.stdout).map_err(|e| failed(e.to_string()))
}

/// Measures here: the scene's record first, then one per target.
pub fn measure(job: &PointJob) -> Result<Vec<Record>, PointError> {
    let settings = job.settings().map_err(RunError::from)?;
    match &job.source {
        PhotoSource::Synthetic(options) => synthetic(job, options, &settings),
        PhotoSource::Folder { path, parts } => folder(job, path, parts, &settings),
    }
}

fn synthetic(
    job: &PointJob,
    options: &SyntheticOptions,
    settings: &Settings,
) -> Result<Vec<Record>, PointError> {
    let mut scene = generate(options).map_err(TrialError::from)?;
    job.harm.apply(&mut scene, job.seed);
    let trial = Trial::of(&job.dir, scene, job.providers, &job.faults)?;
    let providers = trial.providers(settings)?;
    let name = providers.name.clone();
    let mut first = trained(job, trial.scene_dir(), trial.folder(), settings, providers)?;
    let session = trial.session(settings)?;
    let mut targets = Vec::new();
    let began = Instant::now();
    for object in trial.manifest().objects.iter().filter(|o| o.kind == ObjectKind::Object) {
        for (k, prompts) in clicks(job, &trial, object).into_iter().enumerate() {
            if let Prompting::Timed(_) = job.prompting {
                if let Some(ClickTiming { first_s, last_s, visited }) = session.time(prompts)? {
                    let numbers = [("first_s", first_s), ("click_s", last_s), ("visited", visited as f64)];
                    targets.push(job.record(&object.name, k as u32, &numbers));
                }
                continue;
            }
            let s = session.score(object, prompts)?;
            let numbers = [
                ("iou", s.iou),
                ("boundary_iou", s.boundary_iou),
                ("accuracy", s.accuracy),
                ("amodal_iou", s.amodal_iou),
                ("label_iou", s.label_iou),
                ("occluded_leak", s.occluded_leak),
            ];
            targets.push(Record { notes: s.notes, ..job.record(&s.object, k as u32, &numbers) });
        }
    }
    first.numbers.insert("click_s".into(), began.elapsed().as_secs_f64() / targets.len().max(1) as f64);
    targets.insert(0, first);
    Ok(seen_by(&name, targets))
}

/// The records with who made the masks.
fn seen_by(provider: &str, mut records: Vec<Record>) -> Vec<Record> {
    records.iter_mut().for_each(|r| r.provider = provider.into());
    records
}

/// Prompts for an object, one set per selection.
fn clicks(job: &PointJob, trial: &Trial, object: &ObjectTruth) -> Vec<PhotoPrompts> {
    let Some(best) = object.clicks.first() else { return Vec::new() };
    let one =
        |photo: &str, x: f32, y: f32| PhotoPrompts { photo: photo.into(), prompts: Prompts::click(x, y) };
    let shown = trial.scene().photos.iter().find(|p| p.name == best.photo);
    let mut rng = Rng::new(job.seed, (31 << 32) + u64::from(object.id));
    match job.prompting {
        // The oracle knows the whole from one click; the built-in provider gets the prompts that a person would give.
        Prompting::Best if job.providers == ProviderKind::Builtin => {
            trial.prompts(object).into_iter().collect()
        }
        Prompting::Best => vec![one(&best.photo, best.x, best.y)],
        Prompting::Beside(distance) => {
            let angle = std::f32::consts::TAU * rng.unit();
            let (w, h) = shown.map_or((1, 1), |p| (p.camera.width, p.camera.height));
            let x = (best.x + distance * angle.cos()).clamp(0.5, w as f32 - 0.5);
            let y = (best.y + distance * angle.sin()).clamp(0.5, h as f32 - 0.5);
            vec![one(&best.photo, x, y)]
        }
        Prompting::Inside(depth) => {
            let Some(photo) = shown else { return Vec::new() };
            let seen = photo.mask(object.id).minus(&photo.transients);
            let depths = seen.not().distances();
            let off = |x: u32, y: u32| (depths[(y * seen.width() + x) as usize] - depth).abs();
            let nearest = seen.pixels().min_by(|a, b| off(a.0, a.1).total_cmp(&off(b.0, b.1)));
            nearest.map(|(x, y)| one(&best.photo, x as f32 + 0.5, y as f32 + 0.5)).into_iter().collect()
        }
        Prompting::Nowhere => Vec::new(),
        Prompting::Random(times) | Prompting::Timed(times) => {
            let shows = |p: &&SyntheticPhoto| {
                let seen = p.mask(object.id).minus(&p.transients).count();
                !p.test && seen * SHOWN >= p.instances.len()
            };
            let photos: Vec<&SyntheticPhoto> = trial.scene().photos.iter().filter(shows).collect();
            let mut all = Vec::new();
            for _ in 0..times {
                if photos.is_empty() {
                    break;
                }
                let photo = photos[rng.below(photos.len())];
                let pixels: Vec<(u32, u32)> =
                    photo.mask(object.id).minus(&photo.transients).pixels().collect();
                let (x, y) = pixels[rng.below(pixels.len())];
                all.push(one(&photo.name, x as f32 + 0.5, y as f32 + 0.5));
            }
            all
        }
    }
}

/// A photo shows an object when at least one pixel in this many is the object's.
const SHOWN: usize = 200;

fn folder(
    job: &PointJob,
    path: &Path,
    parts: &Parts,
    settings: &Settings,
) -> Result<Vec<Record>, PointError> {
    let objects = objects(path, parts, settings)?;
    let run = RunFolder::create(&job.dir.join("run"))?;
    let providers = Providers::from_settings(&settings.vision).map_err(TrialError::from)?;
    let mut first = trained(job, path, &run, settings, providers.clone())?;
    let mut targets = Vec::new();
    let mut click_s = 0.0;
    for FolderObject { name: object, truth, shown } in &objects {
        for (k, prompts) in shown.iter().enumerate() {
            let began = Instant::now();
            let name = format!("{object}-{k}");
            let made = segment(
                &run,
                &name,
                &std::slice::from_ref(prompts).into(),
                &settings.segment,
                Some(&providers),
                &Stopper::new(),
            );
            click_s += began.elapsed().as_secs_f64();
            let numbers = match made {
                Ok(_) => {
                    let s = score(&run, &name, truth)?;
                    [s.iou, s.boundary_iou, s.accuracy, s.amodal_iou]
                }
                Err(RunError::Segment(_)) => [0.0; 4], // nothing selected is nothing right
                Err(other) => return Err(other.into()),
            };
            let names = ["iou", "boundary_iou", "accuracy", "amodal_iou"];
            let numbers: Vec<(&str, f64)> = names.into_iter().zip(numbers).collect();
            targets.push(job.record(object, k as u32, &numbers));
        }
    }
    if !targets.is_empty() {
        first.numbers.insert("click_s".into(), click_s / targets.len() as f64);
    }
    targets.insert(0, first);
    Ok(seen_by(&providers.name, targets))
}

/// Trains up to the held-out scores; records the cost and the warnings.
fn trained(
    job: &PointJob,
    scene: &Path,
    folder: &RunFolder,
    settings: &Settings,
    providers: Providers,
) -> Result<Record, PointError> {
    let (providers, calls) = if job.count { counted(&providers) } else { (providers, Calls::default()) };
    let events = Events::new();
    let listener = events.subscribe();
    let options = RunOptions {
        events,
        providers: Some(providers),
        until: Until::stage("evaluate"),
        ..RunOptions::default()
    };
    let before = forget_peak();
    let (cpu_before, began) = (cpu::process_seconds(), Instant::now());
    let Summary { splats, held_out, train_fit, .. } = run(scene, folder, settings, &options)?;
    let wall = began.elapsed().as_secs_f64();
    let cpu_s = cpu::process_seconds().zip(cpu_before).map(|(after, before)| after - before);
    let peak = cpu::peak_memory().zip(before).map(|(peak, before)| peak.saturating_sub(before) as f64 / MIB);
    let mut record = job.record("", 0, &[("wall_s", wall), ("splats", splats as f64)]);
    let more =
        [("cpu_s", cpu_s), ("peak_mib", peak), ("train_psnr", train_fit.map(|fit| f64::from(fit.psnr)))];
    let known = more.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?)));
    record.numbers.extend(known);
    record.numbers.extend(held_out.iter().flat_map(|held| held.numbers()));
    if job.count {
        let loaded = folder.load()?;
        let steps = loaded.model.stats.step + settings.features.refine_steps;
        record.numbers.insert("steps".into(), f64::from(steps));
        record.numbers.insert("calls".into(), calls.count() as f64);
        record.numbers.insert("pairs".into(), pairs(&loaded, settings)? as f64);
    }
    while let Some(event) = listener.try_next() {
        if let Event::Warning { message, .. } = &event.event {
            record.notes.push(message.clone());
        }
    }
    Ok(record)
}

/// Side of a tile in pixels, as in both engines.
const TILE: f32 = 16.0;

/// Pairs of a splat and a tile that it may reach, over the training photos.
fn pairs(Loaded { scene, model, .. }: &Loaded, settings: &Settings) -> Result<usize, PointError> {
    let engine = CpuEngine::new();
    let mut pairs = 0;
    for view in scene.views.iter().filter(|v| !v.test) {
        let camera = view.camera.scaled_to(settings.scene.size);
        let projected =
            engine.project(&model.splats, &camera, &view.pose, &model.options()).map_err(RunError::from)?;
        let tiles = |at: f32, radius: f32, size: u32| {
            let last = ((size.max(1) - 1) as f32 / TILE).floor();
            let from = ((at - radius) / TILE).floor().max(0.0);
            let to = ((at + radius) / TILE).floor().min(last);
            (to - from + 1.0).max(0.0) as usize
        };
        pairs += projected
            .radii()
            .iter()
            .zip(projected.centres())
            .filter(|(radius, _)| **radius > 0.0)
            .map(|(&radius, &[x, y])| tiles(x, radius, camera.width) * tiles(y, radius, camera.height))
            .sum::<usize>();
    }
    Ok(pairs)
}

const MIB: f64 = (1 << 20) as f64;

/// Lets the system forget the most memory that this process held, so that what comes is measured and not the making of
/// the scene; what it holds now, in bytes.
fn forget_peak() -> Option<u64> {
    // Where this is refused, the peak is that of the whole process, and what is held now no part of it.
    std::fs::write("/proc/self/clear_refs", "5").ok()?;
    cpu::peak_memory()
}
