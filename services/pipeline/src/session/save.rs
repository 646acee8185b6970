//! Writes an answer as a selection: the object and its masks, in formats that other tools open.

use super::answer::Answer;
use super::photo_masks::PhotoMasks;
use super::resident::Session;
use crate::artifacts::intact;
use crate::artifacts::selected::Selected;
use crate::artifacts::traces;
use crate::code;
use crate::output::light::{self, find};
use crate::output::report;
use crate::{ObjectProvenance, PhotoPrompts, RunError, RunFolder, TextRanking, transients};
use segwild_flow::{FileError, Stopper, fault, files};
use segwild_scene::{Export, Mask, Scene, ScoredMask};
use segwild_segmenter::{Alternative, PhotoVerdict, Segmented, SelectedObject, SelectionConfidence};
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// The result of `segment`.
#[derive(Clone, Debug, Serialize)]
pub struct SegmentOutcome {
    /// The selection's folder.
    pub folder: PathBuf,
    /// The provider of the masks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// Splats of the object.
    pub splats: usize,
    /// Splats shortened by the spike cut.
    pub cut: usize,
    /// Splats dropped by it.
    pub dropped: usize,
    /// Splats of something else that reached into the object: the piece inside is now part of it.
    pub joined: usize,
    /// Splats that were left out because one photo alone shows them.
    pub seen_once: usize,
    /// Photos on which the object shows.
    pub photos: usize,
    /// Photos whose own boundaries took part.
    pub agreeing: usize,
    /// Photos whose own boundaries disagreed with the selection.
    pub disagreeing: usize,
    /// IoU of the selection with the masks of the prompts, in the prompted photos.
    pub agreement: f32,
    /// Whether only the prompted photos decided, because the others would have moved the selection to something else.
    pub alone: bool,
    /// The expected IoU of the scene tree's answer with what the prompts mean, in [0, 1]; `None` where the photos' own masks
    /// answered.
    pub expected_iou: Option<f32>,
    /// What the prompts may select; the setting `alternative` selects one. Empty where the scene tree took no part.
    pub alternatives: Vec<Alternative>,
    /// How sure the selection is, by photo and by side.
    pub confidence: SelectionConfidence,
    /// What the text may mean, with scores, in the order of the alternatives; `None` where no text selected.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ranking: Option<TextRanking>,
    /// Warnings about the prompts and the selection, a sentence each.
    pub notes: Vec<String>,
    /// Seconds from the prompts to the selection, the scene being loaded.
    pub select_s: f64,
    /// Seconds from the prompts to the last file.
    pub wall_s: f64,
}

/// A warning needs more disagreeing photos than this.
const OPPOSED: usize = 4;
/// Agreement ([`SegmentOutcome::agreement`]) under which a selection is doubtful.
const FAITHFUL: f32 = 0.5;

impl SegmentOutcome {
    /// Warnings about the selection itself, a sentence each.
    fn selection_warnings(&self) -> Vec<String> {
        let mut words = Vec::new();
        if self.alone {
            words
                .push("the other photos took it for something else: the prompted photos alone decide".into());
        } else if self.agreement < FAITHFUL {
            words.push(format!(
                "of what the prompts mean and what was selected in the prompted photos, only {:.0} % is both: look at \
                 prompted/ and masks/, and click once more where they differ",
                100.0 * self.agreement
            ));
        }
        if self.disagreeing > OPPOSED.max(self.agreeing) {
            words.push(format!(
                "{} photos disagree with the selection and {} agree: their masks, or the camera poses, do not fit",
                self.disagreeing, self.agreeing
            ));
        }
        words
    }
}

impl Session {
    /// Writes an answer to the run's `selections/NAME`, as a whole or not at all.
    ///
    /// # Errors
    /// When the name cannot be used, or a file cannot be written.
    pub fn save(&self, name: &str, answer: &Answer) -> Result<SegmentOutcome, RunError> {
        self.save_watched(name, answer, &Stopper::new(), &|_, _| ())
    }

    /// The same. `progress` receives the photos whose masks are written, and all photos; of a save that `stopper` stops, nothing is
    /// left.
    ///
    /// # Errors
    /// As [`Session::save`], and when `stopper` stops it.
    pub fn save_watched(
        &self,
        name: &str,
        answer: &Answer,
        stopper: &Stopper,
        progress: &dyn Fn(usize, usize),
    ) -> Result<SegmentOutcome, RunError> {
        let began = Instant::now();
        let Session { folder, scene, model, providers, files: image_files, system, .. } = self;
        let Answer { replay, ranking, segmented, select_s } = answer;
        let appearance = replay.settings.as_ref().map_or("", |settings| &settings.object_appearance);
        RunFolder::can_name(name)?;
        image_files.fit(&folder.selection(name))?;
        traces::of_selection(folder, name, &system.report())?;
        let in_colour = light::shown(scene, model, appearance)?;
        // Written aside and then renamed, so that a selection is there as a whole or not at all.
        files::remove_litter(&folder.path().join("selections"));
        let target = folder.selection(name);
        let Segmented { selection, cut, masks, expected_iou, alternatives, confidence } = &**segmented;
        let selected = Selected::new(&selection.labels, cut);
        let object = SelectedObject::new(&in_colour, &selection.labels, cut);
        let count = |verdict: PhotoVerdict| selection.visits.iter().filter(|v| v.verdict == verdict).count();
        let mut outcome = SegmentOutcome {
            folder: target.clone(),
            provider: providers.name.clone(),
            splats: object.splats.len(),
            cut: cut.changed.len() - cut.joined.len(),
            dropped: cut.dropped.len(),
            joined: cut.joined.len(),
            seen_once: selection.seen_once,
            photos: 0,
            agreement: selection.agreement,
            alone: selection.alone,
            expected_iou: *expected_iou,
            alternatives: alternatives.clone(),
            confidence: confidence.clone(),
            ranking: ranking.clone(),
            notes: prompt_warnings(folder, scene, &replay.prompts, masks),
            agreeing: count(PhotoVerdict::Accepted),
            disagreeing: count(PhotoVerdict::Disagrees),
            select_s: *select_s,
            wall_s: 0.0,
        };
        let alternative = replay.settings.as_ref().map_or(0, |settings| settings.alternative);
        outcome.notes.extend(ranking.as_ref().and_then(|ranking| ranking.warning(alternative)));
        outcome.notes.extend(outcome.selection_warnings());
        outcome.notes.extend(transients::damaged(folder, scene));
        outcome.notes.extend(code::changes(&code::of_clicks(code::recorded(folder)), &providers.networks));
        files::write_folder(&target, |aside| -> Result<(), RunError> {
            let dir = |sub: &str| -> Result<PathBuf, RunError> {
                let path = aside.join(sub);
                std::fs::create_dir_all(&path).map_err(|e| FileError::new("create", &path, e))?;
                Ok(path)
            };
            let pass = || fault::point("selection.file").map_err(|e| FileError::new("write", &target, e));
            let json = |name: &str, value: serde_json::Result<Vec<u8>>| -> Result<(), RunError> {
                let path = aside.join(name);
                let bytes =
                    value.map_err(|e| RunError::Folder { path: path.clone(), reason: e.to_string() })?;
                Ok(files::write_atomic(&path, &bytes)?)
            };
            let names = image_files.names();
            let (mask_dir, amodal_dir, prompt_dir) = (dir("masks")?, dir("amodal")?, dir("prompted")?);
            json("prompts.json", serde_json::to_vec_pretty(replay))?;
            let path = aside.join("selection.bin");
            files::write_atomic(&path, &selected.to_bytes())?;
            pass()?;
            let made_by = self.provenance(vec![ObjectProvenance {
                name: name.to_owned(),
                replay: Some(replay.clone()),
                edited: false,
            }]);
            json("provenance.json", serde_json::to_vec_pretty(&made_by))?;
            let made_by = made_by.value();
            let export = Export { provenance: Some(&made_by), ..light::export(scene, model) };
            export.write(&aside.join("object.ply"), &object.splats)?;
            let labels: Vec<u8> = selected.labels.iter().map(|&l| u8::from(l)).collect();
            let labelled = Export { extra: &[("label", &labels)], ..export };
            labelled.write(&aside.join("labels.ply"), &selected.cut_scene(&in_colour))?;
            pass()?;
            for (view, mask) in masks {
                let full = &scene.views[*view].camera;
                let mask = mask.mask.resized(full.width, full.height);
                scene.views[*view].mask_to_taken(mask).write_png(&prompt_dir.join(&names[*view]))?;
            }
            let object = self.masked_object(&selected);
            let photo_masks = PhotoMasks::new(self, &object)?;
            let photos: Vec<usize> = (0..scene.views.len()).collect();
            let write = |photo: usize, [visible, amodal]: [Mask; 2]| -> Result<bool, RunError> {
                visible.write_png(&mask_dir.join(&names[photo]))?;
                amodal.write_png(&amodal_dir.join(&names[photo]))?;
                Ok(!visible.is_empty())
            };
            let mut written = 0;
            for some in photos.chunks(PhotoMasks::at_once()) {
                RunError::unless_running(stopper)?;
                for shown in photo_masks.each(some, write)? {
                    outcome.photos += usize::from(shown);
                    written += 1;
                    progress(written, photos.len());
                    pass()?;
                }
            }
            intact::write_list(aside)?;
            outcome.wall_s = select_s + began.elapsed().as_secs_f64();
            json("summary.json", serde_json::to_vec_pretty(&outcome))
        })?;
        report::add_object(folder, name)?;
        Ok(outcome)
    }
}

/// A click closer than this to the edge of its mask, in pixels of the working size, may have been meant for the other
/// side.
const EDGE: f32 = 2.0;
/// The warning needs a mask that is somewhere this many times deeper: on a thin object every click is near the edge.
const DEEPER: f32 = 4.0;

/// Warnings about prompts that did select something: clicks on transients, and clicks at the edge of a mask.
fn prompt_warnings(
    folder: &RunFolder,
    scene: &Scene,
    prompts: &[PhotoPrompts],
    masks: &[(usize, ScoredMask)],
) -> Vec<String> {
    let mut words = Vec::new();
    let transients = transients::of_run(folder, scene);
    for p in prompts {
        let Ok(view) = find(scene, &p.photo) else { continue };
        let camera = &scene.views[view].camera;
        let inside = |mask: &Mask, x: f32, y: f32| {
            let scale = |v: f32, of: u32, to: u32| {
                ((v / of.max(1) as f32 * to as f32) as u32).min(to.saturating_sub(1))
            };
            let (u, v) = (scale(x, camera.width, mask.width()), scale(y, camera.height, mask.height()));
            (mask.get(u, v), (v * mask.width() + u) as usize)
        };
        let transient = transients(view);
        let meant = masks.iter().find(|(v, _)| *v == view).map(|(_, m)| &m.mask);
        let depths = meant.map(|m| m.not().distances());
        let deepest = depths.iter().flatten().copied().fold(0.0, f32::max);
        for point in p.prompts.points.iter().filter(|p| p.inside) {
            let (x, y) = (point.x, point.y);
            let Some([u, v]) = scene.views[view].from_taken([x, y]) else { continue };
            if transient.as_ref().is_some_and(|s| inside(s, u, v).0) {
                words.push(format!(
                    "photo {}: the click at ({x}, {y}) lies on a transient; it may select what the transient \
                     occludes: click in a photo without a transient there",
                    p.photo
                ));
            }
            if let (Some(mask), Some(depths)) = (meant, &depths) {
                let (hit, at) = inside(mask, u, v);
                if !hit || (depths[at] < EDGE && deepest > DEEPER * depths[at]) {
                    words.push(format!(
                        "photo {}: the click at ({x}, {y}) lies at the edge of the predicted mask (see prompted/): a click deeper \
                         inside is safer",
                        p.photo
                    ));
                }
            }
        }
    }
    words
}
