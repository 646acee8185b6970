//! What single clicks and boxes find, and how many corrections it takes: random clicks anywhere on the objects of scenes with
//! true masks (method, section 13).

mod page;
mod prompts;
mod reliability;
mod worst;

pub use page::{markdown, write};

use crate::page::{PageError, io};
use crate::point::{PointError, name_of};
use prompts::{BOX, random_box, random_pixel, worst_error};
use segwild_eval::protocols::ProtocolError;
use segwild_eval::protocols::folder::objects;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::trial::TrialError;
use segwild_flow::Stopper;
use segwild_pipeline::{
    Answer, PhotoPrompts, RunError, RunFolder, RunOptions, Session, SessionOptions, Settings, SettingsError,
    Until, run, score,
};
use segwild_scene::{HoldOut, Mask, MaskFileError, MaskFiles, Prompts, Random};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "clicks";

/// A photo is clicked where the object covers at least one pixel in this many.
const LEAST: usize = 200;

/// What to measure.
#[derive(Clone, Debug)]
pub struct ClickOptions {
    /// The scenes' folders, with true masks as for `bench folder`.
    pub scenes: Vec<PathBuf>,
    /// Long sides of the photos, in pixels.
    pub sizes: Vec<u32>,
    /// Clicks on each object.
    pub clicks: usize,
    /// Seed of the clicks and of the trainings.
    pub seed: u64,
    /// Whether each of them is a box around the object in the stead of a click.
    pub boxes: bool,
    /// Whether the alternatives of each click are measured as well.
    pub alternatives: bool,
    /// Whether each click is measured by the trees of the photos' boundaries and by those of the geometry's alone, too.
    pub boundaries: bool,
    /// Further clicks, each where the answer is most wrong.
    pub corrections: usize,
    /// Folder for the results and the page, and for runs while they are made.
    pub out: PathBuf,
    /// The command line that makes it again.
    pub command: String,
    /// Settings of the runs, by name.
    pub settings: Vec<(String, String)>,
}

/// Trains each scene on all photos and clicks its objects; `report` receives each click as it is scored. A scene that cannot be
/// measured is named among what is missing.
///
/// # Errors
/// When settings are refused, or a file cannot be written.
pub fn random_clicks(options: &ClickOptions, mut report: impl FnMut(&Record)) -> Result<Results, PageError> {
    io(&options.out, std::fs::create_dir_all(&options.out))?;
    let mut results = Results { made: Provenance::here(options.command.clone()), ..Results::default() };
    for scene in &options.scenes {
        for &size in &options.sizes {
            let measured = of_scene(options, scene, size, &mut |record| {
                report(&record);
                results.put(record);
            });
            match measured {
                Ok(()) => {}
                Err(error @ PageError::Settings(_)) => return Err(error),
                Err(error) => results.missing.push(format!("{} at {size} px: {error}", name_of(scene))),
            }
            results.write(&options.out.join("results.json"))?;
        }
    }
    Ok(results)
}

fn unread(folder: &Path, error: &MaskFileError) -> PageError {
    ProtocolError::File { file: folder.display().to_string(), reason: error.to_string() }.into()
}

fn failed(error: RunError) -> PageError {
    PageError::Point(PointError::Trial(TrialError::Run(error)))
}

fn of_scene(
    options: &ClickOptions,
    path: &Path,
    size: u32,
    put: &mut dyn FnMut(Record),
) -> Result<(), PageError> {
    let mut changes = options.settings.clone();
    changes.push(("size".into(), size.to_string()));
    changes.push(("seed".into(), options.seed.to_string()));
    let mut settings = Settings::layered(None, &changes)?;
    settings.scene.hold_out = HoldOut::None;
    let run_path = options.out.join("runs").join(format!("{}-{size}-{}", name_of(path), options.seed));
    let folder = RunFolder::create(&run_path).map_err(failed)?;
    let run_options = RunOptions { until: Until::stage("objects"), ..RunOptions::default() };
    run(path, &folder, &settings, &run_options).map_err(failed)?;
    let session = Session::open(&folder, SessionOptions::default()).map_err(failed)?;
    let photos: Vec<String> = session.scene().views.iter().map(|v| v.name.clone()).collect();
    for (at, (name, truth)) in objects(path, &photos)?.into_iter().enumerate() {
        let shown: Vec<(String, Mask)> = truth
            .iter()
            .filter_map(|(photo, file)| Some((photo.clone(), Mask::read_png(file).ok()?)))
            .filter(|(_, mask)| mask.count() * LEAST >= mask.width() as usize * mask.height() as usize)
            .collect();
        let Some(masks) = truth.first().and_then(|(_, file)| file.parent()).filter(|_| !shown.is_empty())
        else {
            continue;
        };
        let object = TrueObject { masks, shown: &shown };
        let mut random = Random::stream(options.seed, at as u64);
        let mut worst: Option<(f64, PhotoPrompts)> = None;
        for click in 0..options.clicks {
            let (photo, mask) = &shown[random.below(shown.len())];
            let (prompts, note) = if options.boxes {
                let b = random_box(mask, &mut random);
                let note = format!("{photo}, box {:.0},{:.0},{:.0},{:.0}", b.x0, b.y0, b.x1, b.y1);
                (Prompts { boxes: vec![b], ..Prompts::default() }, note)
            } else {
                let [x, y] = random_pixel(mask, &mut random);
                (Prompts::click(x, y), format!("{photo} at ({x}, {y})"))
            };
            let prompts = PhotoPrompts { photo: photo.clone(), prompts };
            let numbers = object.numbers(&session, &settings, prompts.clone(), options)?;
            let iou = numbers.get("iou").copied().unwrap_or(0.0);
            if worst.as_ref().is_none_or(|(least, _)| iou < *least) {
                worst = Some((iou, prompts));
            }
            put(Record {
                protocol: PROTOCOL.into(),
                scene: name_of(path),
                setting: if options.boxes { BOX } else { "default" }.into(),
                provider: session.provider().to_owned(),
                at: Some(f64::from(size)),
                target: name.clone(),
                seed: options.seed,
                prompt: click as u32,
                numbers,
                notes: vec![note],
            });
        }
        if let Some((_, prompts)) = worst {
            let image = options.out.join(worst::image_of(&name_of(path), &name, f64::from(size)));
            object.draw(&session, &settings, prompts, &image)?;
        }
    }
    drop(session);
    io(&run_path, std::fs::remove_dir_all(&run_path))
}

/// An object with its true masks.
struct TrueObject<'a> {
    /// The folder of the masks.
    masks: &'a Path,
    /// The photos that show it clearly, with their masks.
    shown: &'a [(String, Mask)],
}

/// An answer, compared with the true masks.
struct ComparedAnswer {
    /// Each photo with a true mask, with the IoU on it; none where nothing was selected.
    photos: Vec<(String, f64)>,
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
        (reliability::CONFIDENCE, Some(confidence.value)),
        ("agreement", confidence.agreement),
        ("worst_side_agreement", confidence.worst_side_agreement),
        ("levels_agreement", confidence.levels_agreement),
        ("expected_iou", answer.segmented.expected_iou),
    ];
    known.into_iter().filter_map(|(name, number)| Some((name, f64::from(number?)))).collect()
}

/// The mask of the answer that was saved last in a photo, as taken; `None` where it selects nothing there.
fn selected_in(session: &Session, answer: &ComparedAnswer, photo: &str) -> Result<Option<Mask>, PageError> {
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
    /// to each IoU of [`page::FOUND`].
    fn numbers(
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
            (page::STRAY_LIGHT[0], answer.stray_light.map(|[mean, _]| mean)),
            (page::STRAY_LIGHT[1], answer.stray_light.map(|[_, worst]| worst)),
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
            for (word, name) in page::BOUNDARIES {
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
            let mut reached = page::FOUND.map(|_| most);
            for count in 1..=most {
                let mean = answer.mean();
                for (reached, least) in reached.iter_mut().zip(page::FOUND) {
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
            for (reached, name) in reached.into_iter().zip(page::CLICKS_TO) {
                numbers.insert(name.to_owned(), reached as f64);
            }
        }
        Ok(numbers)
    }

    /// Selects by prompts, and compares the selection with the true masks.
    fn answer(
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
