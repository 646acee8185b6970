//! What single clicks find: random clicks anywhere on the objects of scenes with true masks (method, section 13).

use crate::page::{PageError, io};
use crate::point::{PointError, name_of};
use segwild_eval::metrics::Spread;
use segwild_eval::protocols::folder::objects;
use segwild_eval::record::{Provenance, Record, Results};
use segwild_eval::stamp;
use segwild_eval::trial::TrialError;
use segwild_flow::{Stopper, files};
use segwild_pipeline::{
    AnswerStep, PhotoPrompts, RunError, RunFolder, RunOptions, Session, SessionOptions, Settings, Until, run,
    score,
};
use segwild_scene::{HoldOut, Mask, Prompts, Random};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The protocol under which everything here is recorded.
pub const PROTOCOL: &str = "clicks";

/// A photo is clicked where the object covers at least one pixel in this many.
const LEAST: usize = 200;

/// Clicks keep away from an object's outline by this share of the photo's diagonal, where the object is wide enough: a person
/// aims inside.
const INSET: f32 = 0.01;

/// IoU from which a click has found the object.
const FOUND: f64 = 0.85;

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
    /// Whether the alternatives of each click are measured as well.
    pub alternatives: bool,
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
    for (at, (object, truth)) in objects(path, &photos)?.into_iter().enumerate() {
        let shown: Vec<(String, Mask)> = truth
            .iter()
            .filter_map(|(photo, file)| Some((photo.clone(), Mask::read_png(file).ok()?)))
            .filter(|(_, mask)| mask.count() * LEAST >= mask.width() as usize * mask.height() as usize)
            .collect();
        let Some(masks) = truth.first().and_then(|(_, file)| file.parent()).filter(|_| !shown.is_empty())
        else {
            continue;
        };
        let mut random = Random::stream(options.seed, at as u64);
        for click in 0..options.clicks {
            let (photo, mask) = &shown[random.below(shown.len())];
            let [x, y] = random_pixel(mask, &mut random);
            let prompts = PhotoPrompts { photo: photo.clone(), prompts: Prompts::click(x, y) };
            let numbers = of_click(&session, &settings, &prompts, masks, options.alternatives)?;
            put(Record {
                protocol: PROTOCOL.into(),
                scene: name_of(path),
                setting: "default".into(),
                provider: session.provider().to_owned(),
                at: Some(f64::from(size)),
                target: object.clone(),
                seed: options.seed,
                prompt: click as u32,
                numbers,
                notes: vec![format!("{photo} at ({x}, {y})")],
            });
        }
    }
    drop(session);
    io(&run_path, std::fs::remove_dir_all(&run_path))
}

/// A pixel of a mask, away from its outline where the mask is wide enough.
fn random_pixel(mask: &Mask, random: &mut Random) -> [f32; 2] {
    let depths = mask.not().distances();
    let inset = INSET * (mask.width() as f32).hypot(mask.height() as f32);
    let deep = |&(x, y): &(u32, u32)| depths[(y * mask.width() + x) as usize] > inset;
    let mut pixels: Vec<(u32, u32)> = mask.pixels().filter(deep).collect();
    if pixels.is_empty() {
        pixels = mask.pixels().collect();
    }
    let (x, y) = pixels[random.below(pixels.len())];
    [x as f32 + 0.5, y as f32 + 0.5]
}

/// The numbers of one click: mean IoU over all true masks, the worst photo, seconds to the first and the last answer, and the best
/// of the answer and its alternatives.
fn of_click(
    session: &Session,
    settings: &Settings,
    prompts: &PhotoPrompts,
    masks: &Path,
    alternatives: bool,
) -> Result<BTreeMap<String, f64>, PageError> {
    let mut numbers = BTreeMap::new();
    let mut best = 0.0f64;
    let mut answers = 1;
    let mut at = 0;
    while at < answers {
        let mut segment = settings.segment.clone();
        segment.alternative = at;
        let began = Instant::now();
        let mut first: Option<(AnswerStep, f64)> = None;
        let pending = session.ask(&std::slice::from_ref(prompts).into(), &segment, &Stopper::new());
        let answer = pending.map_err(failed)?.wait(|step, _| {
            first.get_or_insert((step, began.elapsed().as_secs_f64()));
        });
        let (ious, select_s, others) = match answer {
            Ok(answer) => {
                session.save("click", &answer).map_err(failed)?;
                let scored = score(session.folder(), "click", masks).map_err(failed)?;
                let ious: Vec<f64> = scored.photos.iter().map(|photo| photo.iou).collect();
                let expected = answer.segmented.expected_iou.filter(|_| at == 0);
                numbers.extend(expected.map(|e| ("expected_iou".to_owned(), f64::from(e))));
                (ious, answer.select_s, answer.segmented.alternatives.len())
            }
            // Nothing selected is nothing right.
            Err(RunError::Segment(error)) if error.is_nothing() => (Vec::new(), f64::NAN, 0),
            Err(other) => return Err(failed(other)),
        };
        let mean = if ious.is_empty() { 0.0 } else { ious.iter().sum::<f64>() / ious.len() as f64 };
        best = best.max(mean);
        if at == 0 {
            numbers.insert("iou".into(), mean);
            numbers.insert("worst".into(), ious.into_iter().reduce(f64::min).unwrap_or(0.0));
            let seconds = [("select_s", Some(select_s)), ("first_s", first.map(|(_, s)| s))];
            let known =
                seconds.into_iter().filter_map(|(name, s)| Some((name, s.filter(|s| s.is_finite())?)));
            numbers.extend(known.map(|(name, s)| (name.to_owned(), s)));
            if alternatives {
                answers = others.max(1) as u32;
            }
        }
        at += 1;
    }
    if alternatives {
        numbers.insert("best_iou".into(), best);
    }
    Ok(numbers)
}

/// A row of the table: the mean, quartiles and shares of one object's clicks.
struct ClickRow {
    mean: f64,
    quartiles: [f64; 3],
    found: f64,
    well: f64,
    best: Option<(f64, f64)>,
    first_s: f64,
    select_s: f64,
}

impl ClickRow {
    fn of(records: &[&Record]) -> Option<ClickRow> {
        let all = |name: &str| -> Vec<f64> {
            records.iter().filter_map(|r| r.numbers.get(name).copied()).collect()
        };
        let mut ious = all("iou");
        ious.sort_by(f64::total_cmp);
        let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
        let share =
            |of: &[f64], least: f64| of.iter().filter(|x| **x >= least).count() as f64 / of.len() as f64;
        let quantile = |q: f64| {
            let at = q * (ious.len() - 1) as f64;
            let (low, high) = (at.floor() as usize, at.ceil() as usize);
            ious[low] + (ious[high] - ious[low]) * (at - low as f64)
        };
        let best = all("best_iou");
        (!ious.is_empty()).then(|| ClickRow {
            mean: mean(&ious),
            quartiles: [0.25, 0.5, 0.75].map(quantile),
            found: share(&ious, FOUND),
            well: share(&ious, 0.9),
            best: (!best.is_empty()).then(|| (mean(&best), share(&best, FOUND))),
            first_s: mean(&all("first_s")),
            select_s: mean(&all("select_s")),
        })
    }

    /// Means over rows: each object counts once.
    fn mean(rows: &[ClickRow]) -> Option<ClickRow> {
        let mean =
            |of: fn(&ClickRow) -> f64| Spread::of(&rows.iter().map(of).collect::<Vec<_>>()).map(|s| s.mean);
        let best: Vec<(f64, f64)> = rows.iter().filter_map(|row| row.best).collect();
        let n = best.len() as f64;
        Some(ClickRow {
            mean: mean(|r| r.mean)?,
            quartiles: [mean(|r| r.quartiles[0])?, mean(|r| r.quartiles[1])?, mean(|r| r.quartiles[2])?],
            found: mean(|r| r.found)?,
            well: mean(|r| r.well)?,
            best: (!best.is_empty()).then(|| {
                (best.iter().map(|b| b.0).sum::<f64>() / n, best.iter().map(|b| b.1).sum::<f64>() / n)
            }),
            first_s: mean(|r| r.first_s)?,
            select_s: mean(|r| r.select_s)?,
        })
    }

    fn cells(&self) -> String {
        let [low, middle, high] = self.quartiles;
        let best = self.best.map_or("- | -".into(), |(mean, found)| format!("{mean:.3} | {found:.2}"));
        format!(
            "{:.3} | {low:.2} / {middle:.2} / {high:.2} | {:.2} | {:.2} | {best} | {:.2} | {:.1}",
            self.mean, self.found, self.well, self.first_s, self.select_s
        )
    }
}

/// The page in Markdown.
pub fn markdown(results: &Results) -> String {
    let by = stamp::providers([results]);
    let mut text = format!(
        "# {}\n\nThis page is generated. {}\n\nEach object is clicked at random pixels of random photos, one click at a time, at least {:.0} % of the \
         photo's diagonal inside of its outline. IoU is the mean over all photos with a true mask, the clicked one too. `best of` is the best of the \
         answer and the alternatives that it lists. Runs train on all photos. Seconds are of the resident session, to the first answer that it \
         publishes and to the last.\n",
        stamp::title("Single clicks", &by),
        stamp::stamp(&results.made, &by),
        100.0 * INSET,
    );
    let mut sizes: Vec<f64> = results.records.iter().filter_map(|r| r.at).collect();
    sizes.sort_by(f64::total_cmp);
    sizes.dedup();
    for size in sizes {
        let of_size: Vec<&Record> = results.records.iter().filter(|r| r.at == Some(size)).collect();
        let mut names: Vec<(&str, &str)> = Vec::new();
        for r in &of_size {
            if !names.contains(&(r.scene.as_str(), r.target.as_str())) {
                names.push((&r.scene, &r.target));
            }
        }
        let _ = write!(
            text,
            "\n## {size} px\n\n| scene | object | clicks | mean IoU | quartiles | share >= {FOUND} | share >= .9 | best of: mean | share >= {FOUND} | s to the first answer | to the last |\n\
             |---|---|---:|---:|---|---:|---:|---:|---:|---:|---:|\n"
        );
        let mut rows = Vec::new();
        for (scene, target) in names {
            let clicks: Vec<&Record> =
                of_size.iter().copied().filter(|r| r.scene == scene && r.target == target).collect();
            if let Some(row) = ClickRow::of(&clicks) {
                let _ = writeln!(text, "| {scene} | {target} | {} | {} |", clicks.len(), row.cells());
                rows.push(row);
            }
        }
        if let Some(mean) = ClickRow::mean(&rows) {
            let _ = writeln!(text, "| **mean** | {} objects | | {} |", rows.len(), mean.cells());
        }
    }
    for what in &results.missing {
        let _ = writeln!(text, "\nNot measured: {what}.");
    }
    text
}

/// Writes the page into the folder, and to `page`, if that is given.
///
/// # Errors
/// When a file cannot be written.
pub fn write(out: &Path, page: Option<&Path>, results: &Results) -> Result<PathBuf, PageError> {
    let file = out.join("clicks.md");
    for file in std::iter::once(file.as_path()).chain(page) {
        io(file, files::write_plain(file, markdown(results)).map_err(std::io::Error::other))?;
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_random_click_keeps_a_distance_from_the_outline() {
        let mask = Mask::from_fn(100, 80, |x, y| (20..60).contains(&x) && (10..50).contains(&y));
        let thin = Mask::from_fn(100, 80, |x, _| x == 30);
        let mut random = Random::new(3);
        for _ in 0..200 {
            let [x, y] = random_pixel(&mask, &mut random);
            assert!((21.0..59.0).contains(&x) && (11.0..49.0).contains(&y), "({x}, {y})");
            assert_eq!(random_pixel(&thin, &mut random)[0], 30.5);
        }
    }

    #[test]
    fn the_page_gives_each_object_the_same_weight() {
        let record = |target: &str, prompt: u32, iou: f64| Record {
            protocol: PROTOCOL.into(),
            scene: "square".into(),
            provider: "built-in".into(),
            at: Some(320.0),
            target: target.into(),
            prompt,
            numbers: [
                ("iou".to_owned(), iou),
                ("best_iou".to_owned(), iou.max(0.5)),
                ("select_s".to_owned(), 1.0),
                ("first_s".to_owned(), 0.1),
            ]
            .into(),
            ..Record::default()
        };
        let records =
            vec![record("a", 0, 1.0), record("a", 1, 0.8), record("a", 2, 0.9), record("b", 0, 0.1)];
        let page = markdown(&Results { records, ..Results::default() });
        assert!(
            page.contains(
                "| square | a | 3 | 0.900 | 0.85 / 0.90 / 0.95 | 0.67 | 0.67 | 0.900 | 0.67 | 0.10 | 1.0 |"
            ),
            "{page}"
        );
        assert!(page.contains("| **mean** | 2 objects | | 0.500 |"), "{page}");
        assert!(page.contains("built-in"), "{page}");
    }
}
