//! A scene of real photos with true masks of some of them, and the queries on it.

use super::base::{OnRecord, ProtocolBase, keep};
use super::error::{Missing, ProtocolError};
use crate::ablation::Variant;
use crate::metrics::{self, MaskMetrics};
use crate::record::{Record, Results};
use segwild_flow::{Stopper, files};
use segwild_pipeline::{
    Code, PhotoPrompts, RunError, RunFolder, RunOptions, Settings, Until, providers_for, run, segment,
};
use segwild_scene::{Mask, Scene, SceneError};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A scene and its queries.
#[derive(Clone, Debug)]
pub struct EvalScene {
    /// The protocol that it belongs to.
    pub protocol: &'static str,
    /// Name of the scene.
    pub name: String,
    /// Where it lies.
    pub scene: PathBuf,
    /// Its split file, where that does not lie beside the photos.
    pub split: Option<PathBuf>,
    /// Seed of the training.
    pub seed: u64,
    /// The objects to find, with their prompts and true masks.
    pub queries: Vec<EvalQuery>,
    /// Whether photos that the scene's split holds out are scored as well.
    pub held_out: bool,
}

/// What a protocol found of the data that it needs.
#[derive(Clone, Debug, Default)]
pub struct FoundScenes {
    /// The scenes that can be measured, with their queries.
    pub scenes: Vec<EvalScene>,
    /// What is not there and so is not measured, a sentence each: scenes, targets, single photos of targets.
    pub missing: Vec<String>,
}

impl FoundScenes {
    /// Itself where any query is left; an error that names all that is missing otherwise.
    ///
    /// # Errors
    /// [`ProtocolError::Missing`] when there is no query.
    pub(super) fn or_refused(self, layout: &str) -> Result<FoundScenes, ProtocolError> {
        if self.scenes.iter().any(|p| !p.queries.is_empty()) {
            return Ok(self);
        }
        Err(ProtocolError::Missing(Missing { what: self.missing, layout: layout.into() }))
    }
}

impl From<EvalScene> for FoundScenes {
    fn from(eval_scene: EvalScene) -> FoundScenes {
        FoundScenes { scenes: vec![eval_scene], missing: Vec::new() }
    }
}

/// One object, the prompts it is to be found from, and the photos on which that is scored.
#[derive(Clone, Debug, PartialEq)]
pub struct EvalQuery {
    /// The object.
    pub target: String,
    /// Which of several prompts for it.
    pub prompt: u32,
    /// The prompts.
    pub prompts: Vec<PhotoPrompts>,
    /// Photos, and the object's true mask on each. Those without a pixel of it do not count.
    pub truth: Vec<(String, PathBuf)>,
    /// Photos that should be scored and are not there, a sentence each.
    pub missing: Vec<String>,
}

/// How one photo's mask fits, as `photos.jsonl` lists them.
#[derive(Clone, Debug, Serialize)]
pub struct PhotoScore {
    /// The scene.
    pub scene: String,
    /// The row.
    pub setting: String,
    /// Who made the masks.
    pub provider: String,
    /// The object.
    pub target: String,
    /// Seed of the training.
    pub seed: u64,
    /// Which of several prompts.
    pub prompt: u32,
    /// The photo.
    pub photo: String,
    /// How well the visible mask fits.
    #[serde(flatten)]
    pub score: MaskMetrics,
}

/// The photos of a scene, by name.
///
/// # Errors
/// When there is no scene, in words that say what to put where.
pub fn photos(scene: &Path, settings: &Settings) -> Result<Vec<String>, ProtocolError> {
    Ok(Scene::open(scene, &settings.scene)?.views.into_iter().map(|v| v.name).collect())
}

/// The name of a file without its folder and ending.
pub fn stem(name: &str) -> &str {
    let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
    name.rsplit_once('.').map_or(name, |(stem, _)| stem)
}

/// The photo of a stem.
pub(super) fn photo_of<'a>(photos: &'a [String], wanted: &str) -> Option<&'a String> {
    photos.iter().find(|p| stem(p) == wanted)
}

/// Puts rows through a scene: trains (what rows share only once), runs every query, scores it. Leaves
/// `results.json` and `photos.jsonl`, a line per photo.
///
/// # Errors
/// When a run fails, or a true mask cannot be read.
pub fn measure(
    out: &Path,
    eval_scene: &EvalScene,
    rows: &[&Variant],
    base: &ProtocolBase,
    results: &mut Results,
    report: OnRecord,
) -> Result<(), ProtocolError> {
    if eval_scene.queries.is_empty() && !eval_scene.held_out {
        return Err(ProtocolError::Missing(Missing {
            what: vec![format!("a query for {}", eval_scene.scene.display())],
            layout: "a target needs a reference photo and a true mask of at least one other photo".into(),
        }));
    }
    let folder =
        RunFolder::create(&out.join(format!("{}-{}", file_name(&eval_scene.name), eval_scene.seed)))?;
    for row in rows {
        let mut settings = base.row(row)?;
        settings.train.seed = eval_scene.seed;
        if let Some(split) = &eval_scene.split {
            settings.scene.split = split.display().to_string();
        }
        let until = (!eval_scene.held_out).then(|| Until::stage("features")).flatten();
        let summary =
            run(&eval_scene.scene, &folder, &settings, &RunOptions { until, ..RunOptions::default() })?;
        let record = |target: &str, prompt, numbers| Record {
            protocol: eval_scene.protocol.into(),
            scene: eval_scene.name.clone(),
            setting: row.name.into(),
            provider: summary.provider.clone(),
            target: target.into(),
            seed: eval_scene.seed,
            prompt,
            numbers,
            ..Record::default()
        };
        if let Some(held) = summary.held_out.clone() {
            let numbers = held.numbers().into_iter().collect();
            let record = Record { notes: vec![held.protocol], ..record("", 0, numbers) };
            keep(results, record, out, report)?;
        }
        for query in &eval_scene.queries {
            let ScoredAnswer { numbers, photos, unread } = ask(&folder, query, &settings)?;
            results.miss(unread.iter().map(|u| format!("{}, {}: {u}", eval_scene.name, query.target)));
            let line = |(photo, score): (String, MaskMetrics)| PhotoScore {
                scene: eval_scene.name.clone(),
                setting: row.name.into(),
                provider: summary.provider.clone(),
                target: query.target.clone(),
                seed: eval_scene.seed,
                prompt: query.prompt,
                photo,
                score,
            };
            append(&out.join("photos.jsonl"), photos.into_iter().map(line))?;
            let clicked: Vec<&str> = query.prompts.iter().map(|p| p.photo.as_str()).collect();
            let mut notes = vec![format!("clicked {}", clicked.join(", "))];
            notes.extend(query.missing.iter().chain(&unread).map(|m| format!("not scored: {m}")));
            let record = Record { notes, ..record(&query.target, query.prompt, numbers) };
            keep(results, record, out, report)?;
        }
    }
    Ok(())
}

/// A name that can be a file's.
fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect()
}

/// What came of a question.
struct ScoredAnswer {
    /// By the names that records have for them. There is no IoU where no photo could be scored.
    numbers: BTreeMap<String, f64>,
    /// Each photo's score.
    photos: Vec<(String, MaskMetrics)>,
    /// Photos whose true mask cannot be read, and why.
    unread: Vec<String>,
}

/// Selects, and scores the masks of the photos that were not clicked. Nothing selected is nothing right.
fn ask(folder: &RunFolder, query: &EvalQuery, settings: &Settings) -> Result<ScoredAnswer, ProtocolError> {
    let name = format!("{}-{}", file_name(&query.target), query.prompt);
    let eyes = providers_for(folder, &Code::of(&settings.vision))?;
    let selected =
        segment(folder, &name, &query.prompts[..].into(), &settings.segment, Some(&eyes), &Stopper::new());
    let selected = match selected {
        Ok(outcome) => Some(outcome),
        Err(RunError::Segment(error)) if error.is_nothing() => None,
        Err(other) => return Err(other.into()),
    };
    let files = folder.mask_files()?;
    let (mut visible, mut amodal, mut unread) = (Vec::new(), Vec::new(), Vec::new());
    for (photo, file) in &query.truth {
        if query.prompts.iter().any(|p| p.photo == *photo) {
            continue;
        }
        let truth = match Mask::read_png(file) {
            Ok(truth) => truth,
            Err(error) => {
                unread.push(error.to_string());
                continue;
            }
        };
        if truth.is_empty() {
            continue;
        }
        let (w, h) = (truth.width(), truth.height());
        let of = |kind: &str| -> Result<MaskMetrics, ProtocolError> {
            let mask = match (&selected, files.get(photo)) {
                (Some(outcome), Some(file)) => {
                    let mask = Mask::read_png(&outcome.folder.join(kind).join(file))?;
                    if (mask.width(), mask.height()) == (w, h) { mask } else { mask.resized(w, h) }
                }
                _ => Mask::empty(w, h),
            };
            metrics::score(&mask, &truth, None).map_err(|source| ProtocolError::Metric {
                target: query.target.clone(),
                photo: photo.clone(),
                source,
            })
        };
        visible.push((photo.clone(), of("masks")?));
        amodal.push(of("amodal")?.iou);
    }
    let mut numbers = scores(&visible, &amodal);
    numbers.extend(selected.iter().flat_map(|o| [("select_s", o.select_s), ("splats", o.splats as f64)]));
    let numbers = numbers.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
    Ok(ScoredAnswer { numbers, photos: visible, unread })
}

/// Means over the photos that were scored; nothing where there are none.
fn scores(visible: &[(String, MaskMetrics)], amodal: &[f64]) -> Vec<(&'static str, f64)> {
    let count = visible.len() as f64;
    if visible.is_empty() {
        return vec![("photos", 0.0)];
    }
    let mean = |of: fn(&MaskMetrics) -> f64| visible.iter().map(|(_, s)| of(s)).sum::<f64>() / count;
    vec![
        ("iou", mean(|s| s.iou)),
        ("accuracy", mean(|s| s.accuracy)),
        ("boundary_iou", mean(|s| s.boundary_iou)),
        ("amodal_iou", amodal.iter().sum::<f64>() / count),
        ("worst", visible.iter().map(|(_, s)| s.iou).fold(f64::INFINITY, f64::min)),
        ("photos", count),
    ]
}

/// Adds lines to a file of JSON lines.
fn append<T: Serialize>(file: &Path, lines: impl Iterator<Item = T>) -> Result<(), ProtocolError> {
    let lines: Result<Vec<String>, _> = lines.map(|line| serde_json::to_string(&line)).collect();
    let lines = lines.map_err(|e| SceneError::invalid(file, "line", e.to_string()))?;
    match lines.is_empty() {
        true => Ok(()),
        false => Ok(files::append_line(file, &lines.join("\n")).map_err(SceneError::from)?),
    }
}
