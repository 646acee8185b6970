//! Answers to prompts, compared with the true masks of an object.

use super::options::ClickOptions;
use super::page::{BOUNDARIES, CLICKS_TO, FOUND, STRAY_LIGHT};
use super::prompts::worst_error;
use super::reliability::CONFIDENCE;
use crate::page::PageError;
use crate::point::PointError;
use segwild_eval::protocols::ProtocolError;
use segwild_eval::trial::TrialError;
use segwild_flow::Stopper;
use segwild_pipeline::{Answer, PhotoPrompts, RunError, Session, Settings, SettingsError, score};
use segwild_scene::{Mask, MaskFileError, MaskFiles, Prompts};
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

fn unread(folder: &Path, error: &MaskFileError) -> PageError {
    ProtocolError::File { file: folder.display().to_string(), reason: error.to_string() }.into()
}

/// A run that failed, as a failure of the page.
pub fn failed(error: RunError) -> PageError {
    PageError::Point(PointError::Trial(TrialError::Run(error)))
}

/// An object with its true masks.
pub struct TrueObject<'a> {
    /// The folder of the masks.
    pub masks: &'a Path,
    /// The photos that show it clearly, with their masks.
    pub shown: &'a [(String, Mask)],
}

/// An answer, compared with the true masks.
pub struct ComparedAnswer {
    /// Each photo with a true mask, with the IoU on it; none where nothing was selected.
    pub photos: Vec<(String, f64)>,
    /// Stray light of the object alone: its mean over the photos without prompts, and its worst photo; `None` where nothing was
    /// selected.
    stray_light: Option<[f64; 2]>,
    /// Seconds to the last answer.
    select_s: Option<f64>,
    /// Seconds to the first.
    first_s: Option<f64>,
    /// How sure the program is of it, in numbers by name.
    confidence: Vec<(&'static str, f64)>,
    /// Answers that it lists, itself included.
    answers: usize,
}

impl ComparedAnswer {
    fn mean(&self) -> f64 {
        self.photos.iter().map(|(_, iou)| iou).sum::<f64>() / self.photos.len().max(1) as f64
    }
}

/// How sure an answer is, in numbers by name: its confidence, and what that is made of.
fn confidence_numbers(answer: &Answer) -> Vec<(&'static str, f64)> {
    let confidence = &answer.segmented.confidence;
    let known = [
        (CONFIDENCE, Some(confidence.value)),
        ("agreement", confidence.agreement),
        ("worst_side_agreement", confidence.worst_side_agreement),
        ("levels_agreement", confidence.levels_agreement),
        ("expected_iou", answer.segmented.expected_iou),
    ];
    known.into_iter().filter_map(|(name, number)| Some((name, f64::from(number?)))).collect()
}

/// The mask of the answer that was saved last in a photo, as taken; `None` where it selects nothing there.
pub fn selected_in(
    session: &Session,
    answer: &ComparedAnswer,
    photo: &str,
) -> Result<Option<Mask>, PageError> {
    if answer.photos.is_empty() {
        return Ok(None);
    }
    let folder = session.folder().selection(SELECTION).join("masks");
    let files = MaskFiles::new(&folder, session.scene().views.iter().map(|view| view.name.as_str()));
    let Some(file) = files.find(photo).map_err(|e| unread(&folder, &e))? else { return Ok(None) };
    Ok(Some(Mask::read_png(&file).map_err(|e| failed(e.into()))?))
}

/// The selection that answers are saved as.
const SELECTION: &str = "click";

impl TrueObject<'_> {
    /// The numbers of one prompt: mean IoU over all true masks, the worst photo, stray light, seconds to the first and the last
    /// answer, how sure it is, the best of the answer and its alternatives, IoU by one kind of boundary, and the clicks that it takes
    /// to each IoU of [`FOUND`].
    pub fn numbers(
        &self,
        session: &Session,
        settings: &Settings,
        first: PhotoPrompts,
        options: &ClickOptions,
    ) -> Result<BTreeMap<String, f64>, PageError> {
        let mut prompts = vec![first];
        let mut answer = self.answer(session, settings, &prompts, 0)?;
        let mut numbers = BTreeMap::from([
            ("iou".to_owned(), answer.mean()),
            ("worst".to_owned(), answer.photos.iter().map(|(_, iou)| *iou).reduce(f64::min).unwrap_or(0.0)),
        ]);
        let known = [
            ("select_s", answer.select_s),
            ("first_s", answer.first_s),
            (STRAY_LIGHT[0], answer.stray_light.map(|[mean, _]| mean)),
            (STRAY_LIGHT[1], answer.stray_light.map(|[_, worst]| worst)),
        ];
        numbers.extend(known.into_iter().filter_map(|(name, number)| Some((name.to_owned(), number?))));
        numbers.extend(answer.confidence.iter().map(|(name, number)| ((*name).to_owned(), *number)));
        // Alternatives come first: what is corrected is the answer, and it is the one saved last.
        let mut replaced = false;
        if options.alternatives {
            let mut best = answer.mean();
            for other in 1..answer.answers {
                best = best.max(self.answer(session, settings, &prompts, other)?.mean());
                replaced = true;
            }
            numbers.insert("best_iou".into(), best);
        }
        if options.boundaries {
            for (word, name) in BOUNDARIES {
                let mut alone = settings.clone();
                alone.set("tree_boundaries", word).map_err(SettingsError::from)?;
                numbers.insert(name.into(), self.answer(session, &alone, &prompts, 0)?.mean());
                replaced = true;
            }
        }
        if options.corrections > 0 {
            if replaced {
                answer = self.answer(session, settings, &prompts, 0)?;
            }
            let most = 1 + options.corrections;
            let mut reached = FOUND.map(|_| most);
            for count in 1..=most {
                let mean = answer.mean();
                for (reached, least) in reached.iter_mut().zip(FOUND) {
                    if mean >= least {
                        *reached = count.min(*reached);
                    }
                }
                numbers.insert(format!("iou_{count}"), mean);
                if count == most || reached.iter().all(|reached| *reached <= count) {
                    break;
                }
                let Some(click) = self.correction(session, &answer)? else { break };
                match prompts.iter_mut().find(|known| known.photo == click.photo) {
                    Some(known) => known.prompts.points.extend(click.prompts.points),
                    None => prompts.push(click),
                }
                answer = self.answer(session, settings, &prompts, 0)?;
            }
            for (reached, name) in reached.into_iter().zip(CLICKS_TO) {
                numbers.insert(name.to_owned(), reached as f64);
            }
        }
        Ok(numbers)
    }

    /// Selects by prompts, and compares the selection with the true masks.
    pub fn answer(
        &self,
        session: &Session,
        settings: &Settings,
        prompts: &[PhotoPrompts],
        alternative: usize,
    ) -> Result<ComparedAnswer, PageError> {
        let mut segment = settings.segment.clone();
        segment.alternative = alternative as u32;
        let began = Instant::now();
        let mut first_s = None;
        let pending = session.ask(&prompts.into(), &segment, &Stopper::new()).map_err(failed)?;
        let answer = pending.wait(|_, _| {
            first_s.get_or_insert_with(|| began.elapsed().as_secs_f64());
        });
        match answer {
            Ok(answer) => {
                session.save(SELECTION, &answer).map_err(failed)?;
                let scored = score(session.folder(), SELECTION, self.masks).map_err(failed)?;
                Ok(ComparedAnswer {
                    photos: scored.photos.iter().map(|of| (of.photo.clone(), of.iou)).collect(),
                    stray_light: Some([scored.stray_light, scored.worst_stray_light()]),
                    select_s: Some(answer.select_s).filter(|s| s.is_finite()),
                    first_s,
                    confidence: confidence_numbers(&answer),
                    answers: answer.segmented.alternatives.len().max(1),
                })
            }
            // Nothing selected is nothing right.
            Err(RunError::Segment(error)) if error.is_nothing() => Ok(ComparedAnswer {
                photos: Vec::new(),
                stray_light: None,
                select_s: None,
                first_s,
                confidence: Vec::new(),
                answers: 1,
            }),
            Err(other) => Err(failed(other)),
        }
    }

    /// A click where the answer that was saved last is most wrong, over all photos that show the object; `None` where nothing is
    /// wrong.
    fn correction(
        &self,
        session: &Session,
        answer: &ComparedAnswer,
    ) -> Result<Option<PhotoPrompts>, PageError> {
        let mut worst: Option<(f32, PhotoPrompts)> = None;
        for (photo, truth) in self.shown {
            let mask = selected_in(session, answer, photo)?
                .unwrap_or_else(|| Mask::empty(truth.width(), truth.height()));
            let Some((depth, point)) = worst_error(truth, &mask.resized(truth.width(), truth.height()))
            else {
                continue;
            };
            if worst.as_ref().is_none_or(|(deepest, _)| depth > *deepest) {
                let prompts = Prompts { points: vec![point], ..Prompts::default() };
                worst = Some((depth, PhotoPrompts { photo: photo.clone(), prompts }));
            }
        }
        Ok(worst.map(|(_, click)| click))
    }
}
