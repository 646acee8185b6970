//! Learns the weights of a candidate's traits (`src/builtin/weights.rs`) from photos whose true masks are known.
//!
//! `cargo run -p segwild-vision --example train_prompts -- [--rounds 3] [--from zero] [--models DIR] FOLDER[:EVERY:SKIP[:WEIGHT]]...`
//!
//! A folder is one of those of `eval_prompts`, or a scene without `truth` whose objects are outlined in
//! `examples/outlines/NAME.json` (photo, then object, then corners in its pixels; all objects of a photo are answers to
//! one click: "the dome" is right with its drum and without). Of every EVERY photos the one at SKIP is learned from, and
//! the one half of EVERY later is tested on; a folder of WEIGHT 0 is only tested on.
//!
//! A round simulates a person's prompts on all photos: a box, a click somewhere in the object, a click in its middle, and then
//! corrections in the middle of the largest mistake; and once two clicks, one at each end of the object. Every interpretation
//! of each click is kept with its IoU. The weights are then fitted to all rounds so far ([`fit_weights`]): the answers with the
//! weights of one round decide which mistakes are corrected in the next one.

#[allow(dead_code, reason = "the examples share it, none uses all of it")]
mod common;

use common::{ExampleResult, box_of, correction, mean, most_interior, option, photos_with_truth};
use segwild_scene::{Image, Mask, Prompts};
use segwild_vision::{Builtin, EdgeNetwork, PromptQuery, PromptStep, Runtime, TraitWeights};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

/// Long side that photos are learned at.
const LONG: f32 = 320.0;
/// Least share of the photo that an object must cover to be queried.
const LEAST: f64 = 0.005;
/// Clicks that an object gets at most.
const CLICKS: usize = 6;
/// Memory for what is known of the photos.
const MEMORY: usize = 2 << 30;
/// Steps of Adam, its learning rate at the start, and the weight decay.
const STEPS: usize = 1500;
const LEARNING_RATE: f64 = 0.03;
const DECAY: f64 = 2e-4;

/// One training case: the interpretations of a prompt, and the IoU of each.
struct TrainingCase {
    step: PromptStep,
    weight: f64,
    traits: Vec<Vec<f32>>,
    ious: Vec<f64>,
}

/// A photo and its objects, each with every mask that is right.
struct TrainingPhoto {
    image: Image,
    objects: Vec<Vec<Mask>>,
    weight: f64,
    learned: bool,
    scene: usize,
}

/// IoU with the nearest of the true masks.
fn best_iou(truths: &[Mask], prediction: &Mask) -> f64 {
    truths.iter().map(|truth| truth.iou(prediction)).fold(0.0, f64::max)
}

/// IoU of each interpretation with the nearest of the true masks.
fn interpretation_ious(query: &PromptQuery, truths: &[Mask]) -> Vec<f64> {
    let count = query.superpixels.iter().max().map_or(0, |m| *m as usize + 1);
    let mut best = vec![0.0f64; query.interpretations.len()];
    for truth in truths {
        let truth = truth.resized(query.size.0 as u32, query.size.1 as u32);
        let mut pixels = vec![(0.0, 0.0); count];
        for (i, &s) in query.superpixels.iter().enumerate() {
            let of = &mut pixels[s as usize];
            *of = (of.0 + f64::from(u8::from(truth.index(i))), of.1 + 1.0);
        }
        for (best, interpretation) in best.iter_mut().zip(&query.interpretations) {
            let inside = pixels.iter().zip(&interpretation.inside).filter(|p| *p.1);
            let (both, area) = inside.fold((0.0, 0.0), |sum, (p, _)| (sum.0 + p.0, sum.1 + p.1));
            *best = best.max(both / (area + truth.count() as f64 - both).max(1.0));
        }
    }
    best
}

/// The true mask with the highest IoU: mistakes are measured against it.
fn best_truth<'a>(truths: &'a [Mask], prediction: &Mask) -> Option<&'a Mask> {
    truths.iter().max_by(|a, b| a.iou(prediction).total_cmp(&b.iou(prediction)))
}

/// A click well inside, but not in the middle.
fn off_centre_click(mask: &Mask, number: usize) -> Option<(f32, f32)> {
    let depth = mask.not().distances();
    let at = |x: u32, y: u32| depth[(y * mask.width() + x) as usize];
    let most = mask.pixels().map(|(x, y)| at(x, y)).fold(0.0, f32::max);
    let inner: Vec<(u32, u32)> = mask.pixels().filter(|&(x, y)| at(x, y) >= 0.25 * most).collect();
    let (x, y) = *inner.get(number.wrapping_mul(7919) % inner.len().max(1))?;
    Some((x as f32 + 0.5, y as f32 + 0.5))
}

/// Clicks in the middle of both ends of an object, the larger share first: what a person points at who sees two parts.
fn end_clicks(mask: &Mask) -> Option<[(f32, f32); 2]> {
    let bounds = box_of(mask);
    let (wide, high) = (bounds.x1 - bounds.x0, bounds.y1 - bounds.y0);
    let along = |x: f32, y: f32| {
        if high >= wide { (y + 0.5 - bounds.y0) / high } else { (x + 0.5 - bounds.x0) / wide }
    };
    let part = |near: bool| {
        let inside = |x: u32, y: u32| {
            let (x, y) = (x as f32, y as f32);
            let along = along(x, y);
            mask.at(x, y) && if near { along < 0.6 } else { along > 0.65 }
        };
        most_interior(&Mask::from_fn(mask.width(), mask.height(), inside))
    };
    Some([part(true)?, part(false)?])
}

/// Simulates a person's prompts for one object; returns the training cases, and the IoU after one click and after each correction.
fn simulate_prompts(
    provider: &Builtin,
    photo: &TrainingPhoto,
    object: &[Mask],
    number: usize,
) -> ExampleResult<(Vec<TrainingCase>, Vec<f64>)> {
    let mut cases = Vec::new();
    let inner = object.iter().min_by_key(|m| m.count()).ok_or("an object without a mask")?;
    let Some(middle) = most_interior(inner) else { return Ok((cases, Vec::new())) };
    let ask = |prompts: &Prompts, truths: &[Mask], cases: &mut Vec<TrainingCase>| -> ExampleResult<Mask> {
        let (answer, query) = provider.answer(&photo.image, prompts)?;
        if let Some(query) = query {
            cases.push(TrainingCase {
                step: query.step,
                weight: photo.weight,
                ious: interpretation_ious(&query, truths),
                traits: query.interpretations.into_iter().map(|m| m.traits).collect(),
            });
        }
        Ok(answer.mask)
    };
    let outer = object.iter().max_by_key(|m| m.count()).ok_or("an object without a mask")?;
    let boxes = vec![box_of(outer)];
    let whole = std::slice::from_ref(outer);
    ask(&Prompts { boxes: boxes.clone(), ..Prompts::default() }, whole, &mut cases)?;
    ask(&Prompts { boxes, ..Prompts::click(middle.0, middle.1) }, whole, &mut cases)?;
    for click in 0..2 {
        if let Some((x, y)) = off_centre_click(outer, 2 * number + click) {
            let truths: Vec<Mask> = object.iter().filter(|m| m.at(x, y)).cloned().collect();
            ask(&Prompts::click(x, y), &truths, &mut cases)?;
        }
    }
    if let Some([a, b]) = end_clicks(outer) {
        let mut prompts = Prompts::click(a.0, a.1);
        prompts.points.extend(Prompts::click(b.0, b.1).points);
        ask(&prompts, whole, &mut cases)?;
    }
    let mut prompts = Prompts::click(middle.0, middle.1);
    let mut iou_per_click = Vec::new();
    loop {
        let answer = ask(&prompts, object, &mut cases)?;
        iou_per_click.push(best_iou(object, &answer));
        if prompts.points.len() == CLICKS {
            return Ok((cases, iou_per_click));
        }
        match best_truth(object, &answer).and_then(|truth| correction(&answer, truth)) {
            Some(click) => prompts.points.push(click),
            None => return Ok((cases, iou_per_click)),
        }
    }
}

/// Fits weights, from `start`: Adam maximises the IoU of a case's interpretations, weighted by the softmax of their scores,
/// less a quadratic penalty on the weights.
fn fit_weights(cases: &[&TrainingCase], start: &[f32]) -> Vec<f32> {
    let count = start.len();
    // Traits differ in size: each is divided by its standard deviation.
    let mut spread = vec![(0.0f64, 0.0f64, 0.0f64); count];
    for traits in cases.iter().flat_map(|q| &q.traits) {
        for (s, &t) in spread.iter_mut().zip(traits) {
            *s = (s.0 + 1.0, s.1 + f64::from(t), s.2 + f64::from(t).powi(2));
        }
    }
    let scale: Vec<f64> = spread.iter().map(|s| ((s.2 - s.1 * s.1 / s.0) / s.0).sqrt().max(1e-3)).collect();
    let mut weights: Vec<f64> = start.iter().zip(&scale).map(|(w, s)| f64::from(*w) * s).collect();
    let (mut first, mut second) = (vec![0.0; count], vec![0.0; count]);
    let total: f64 = cases.iter().map(|q| q.weight).sum();
    for step in 1..=STEPS {
        let mut gradient = vec![0.0; count];
        for q in cases {
            let scores: Vec<f64> = q
                .traits
                .iter()
                .map(|t| t.iter().zip(&weights).zip(&scale).map(|((t, w), s)| f64::from(*t) / s * w).sum())
                .collect();
            let top = scores.iter().copied().fold(f64::MIN, f64::max);
            let exps: Vec<f64> = scores.iter().map(|s| (s - top).exp()).collect();
            let sum: f64 = exps.iter().sum();
            let expected: f64 = exps.iter().zip(&q.ious).map(|(p, i)| p / sum * i).sum();
            for ((p, i), traits) in exps.iter().zip(&q.ious).zip(&q.traits) {
                let by_score = q.weight / total * p / sum * (i - expected);
                if by_score.abs() > 1e-9 {
                    gradient
                        .iter_mut()
                        .zip(traits)
                        .zip(&scale)
                        .for_each(|((g, t), s)| *g += by_score * f64::from(*t) / s);
                }
            }
        }
        let learning_rate = LEARNING_RATE * (1.0 - 0.9 * step as f64 / STEPS as f64);
        for k in 0..count {
            let g = gradient[k] - DECAY * weights[k];
            first[k] = 0.9 * first[k] + 0.1 * g;
            second[k] = 0.999 * second[k] + 0.001 * g * g;
            let (m, v) =
                (first[k] / (1.0 - 0.9f64.powi(step as i32)), second[k] / (1.0 - 0.999f64.powi(step as i32)));
            weights[k] += learning_rate * m / (v.sqrt() + 1e-9);
        }
    }
    weights.iter().zip(&scale).map(|(w, s)| (w / s) as f32).collect()
}

/// Corners of every object in every photo.
type Outlines = BTreeMap<String, BTreeMap<String, Vec<[f32; 2]>>>;

/// The photos of one folder, and its name.
fn photos(argument: &str, scene: usize) -> ExampleResult<(String, Vec<TrainingPhoto>)> {
    let mut parts = argument.split(':');
    let folder = Path::new(parts.next().unwrap_or_default());
    let every: usize = parts.next().map_or(Ok(1), str::parse)?;
    let skip: usize = parts.next().map_or(Ok(0), str::parse)?;
    let weight: f64 = parts.next().map_or(Ok(1.0), str::parse)?;
    let name = folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("examples/outlines/{name}.json"));
    let outlines: Option<Outlines> = match std::fs::read_to_string(&file) {
        Ok(text) if !folder.join("truth").is_dir() => Some(serde_json::from_str(&text)?),
        _ => None,
    };
    let mut out = Vec::new();
    for known in photos_with_truth(folder, LONG)? {
        let (image, masks) = known.read()?;
        let (w, h) = (image.width as u32, image.height as u32);
        let objects: Vec<Vec<Mask>> = match &outlines {
            None => masks.into_iter().map(|m| vec![m.1]).collect(),
            Some(outlines) => {
                let stem =
                    known.file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
                let full = Image::read(&known.file)?;
                let scale = [w as f32 / full.width as f32, h as f32 / full.height as f32];
                let outlined =
                    outlines.get(&stem).map(|o| o.values().map(|c| filled(c, scale, w, h)).collect());
                outlined.into_iter().collect()
            }
        };
        let large = |m: &Mask| m.count() as f64 >= LEAST * f64::from(w * h);
        let objects: Vec<Vec<Mask>> = objects.into_iter().filter(|o| o.iter().any(large)).collect();
        if !objects.is_empty() {
            out.push(TrainingPhoto { image, objects, weight, learned: weight > 0.0, scene });
        }
    }
    let fold_of = |n: usize| (n + every - skip % every.max(1)) % every.max(1);
    let mut number = 0..;
    out.retain_mut(|photo| {
        let fold = number.next().map_or(0, fold_of);
        photo.learned &= fold == 0;
        fold == 0 || fold == every / 2
    });
    // Every folder weighs the same, however many objects it shows.
    let learned_objects: usize = out.iter().filter(|p| p.learned).map(|p| p.objects.len()).sum();
    out.iter_mut().for_each(|p| p.weight /= learned_objects.max(1) as f64);
    Ok((name, out))
}

/// The pixels within a ring of corners.
fn filled(corners: &[[f32; 2]], scale: [f32; 2], w: u32, h: u32) -> Mask {
    Mask::from_fn(w, h, |x, y| {
        let (px, py) = ((x as f32 + 0.5) / scale[0], (y as f32 + 0.5) / scale[1]);
        let mut inside = false;
        for (a, b) in corners.iter().zip(corners.iter().cycle().skip(1)) {
            if (a[1] > py) != (b[1] > py) && px < a[0] + (py - a[1]) / (b[1] - a[1]) * (b[0] - a[0]) {
                inside = !inside;
            }
        }
        inside
    })
}

fn show(step: PromptStep, weights: &[f32]) {
    println!("    {}: [", format!("{step:?}").to_lowercase());
    for row in weights.chunks(9) {
        println!("        {},", row.iter().map(|w| format!("{w:.4}")).collect::<Vec<_>>().join(", "));
    }
    println!("    ],");
}

/// The folders of the command line: what is neither a flag nor its value.
fn folders() -> Vec<String> {
    let flags = ["--rounds", "--from", "--models"];
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let is_flag = |k: usize| arguments.get(k).is_some_and(|a| flags.contains(&a.as_str()));
    let folders = arguments.iter().enumerate().filter(|(k, _)| !is_flag(*k) && (*k == 0 || !is_flag(k - 1)));
    folders.map(|(_, folder)| folder.clone()).collect()
}

/// A photo with the training cases and the IoU per click of one of its objects.
type SimulatedObject<'a> = (&'a TrainingPhoto, (Vec<TrainingCase>, Vec<f64>));

/// Simulates the prompts for all objects, by two threads: first the photos of even number, then the others.
fn simulate_all<'a>(provider: &Builtin, all: &'a [TrainingPhoto]) -> ExampleResult<Vec<SimulatedObject<'a>>> {
    let halves: Vec<Result<Vec<_>, String>> = std::thread::scope(|scope| {
        let half = |h: usize| {
            scope.spawn(move || {
                let mine = all.iter().enumerate().skip(h).step_by(2);
                mine.flat_map(|(n, photo)| photo.objects.iter().map(move |o| (n, photo, o)))
                    .map(|(n, photo, o)| {
                        Ok((photo, simulate_prompts(provider, photo, o, n).map_err(|e| e.to_string())?))
                    })
                    .collect()
            })
        };
        [half(0), half(1)].map(|h| h.join().unwrap_or_else(|_| Err("a thread panicked".into()))).into()
    });
    let halves = halves.into_iter().collect::<Result<Vec<_>, String>>()?;
    Ok(halves.into_iter().flatten().collect())
}

/// Prints the mean IoU after each click, per scene, of the objects learned from and of the others.
fn report(round: usize, names: &[String], ious: &BTreeMap<(usize, bool), Vec<Vec<f64>>>) {
    for ((scene, learned), rows) in ious {
        let after = |k: usize| {
            let last = |r: &Vec<f64>| r.get(k).or(r.last()).copied().unwrap_or(0.0);
            format!("{:.3}", mean(&rows.iter().map(last).collect::<Vec<_>>()))
        };
        let text: Vec<String> = (0..CLICKS).map(after).collect();
        let kind = if *learned { "learned" } else { "unseen" };
        println!("round {round}: {} {kind} ({}): {}", names[*scene], rows.len(), text.join(" "));
    }
}

fn main() -> ExampleResult<()> {
    let rounds: usize = option("--rounds").map_or(Ok(3), |t| t.parse())?;
    let edges = match option("--models") {
        Some(models) => {
            let file = Path::new(&models).join("edges_bsds.onnx");
            Some(Arc::new(EdgeNetwork::load(&Runtime::find("")?, &file, 1)?))
        }
        None => None,
    };
    let (mut names, mut all) = (Vec::new(), Vec::new());
    for folder in folders() {
        let (name, photos) = photos(&folder, names.len())?;
        names.push(name);
        all.extend(photos);
    }
    let mut weights = if edges.is_some() { TraitWeights::network() } else { TraitWeights::builtin() };
    let steps = [PromptStep::First, PromptStep::Add, PromptStep::Remove, PromptStep::Boxed];
    if option("--from").as_deref() == Some("zero") {
        steps.iter().for_each(|s| weights.of_mut(*s).fill(0.0));
    }
    let mut cases: Vec<TrainingCase> = Vec::new();
    for round in 0..=rounds {
        let provider = match &edges {
            Some(edges) => Builtin::with_edges(edges.clone()),
            None => Builtin::new(),
        }
        .within(MEMORY)
        .weighing(weights.clone());
        let mut ious: BTreeMap<(usize, bool), Vec<Vec<f64>>> = BTreeMap::new();
        for (photo, (new_cases, iou_per_click)) in simulate_all(&provider, &all)? {
            if photo.learned {
                cases.extend(new_cases);
            }
            ious.entry((photo.scene, photo.learned)).or_default().push(iou_per_click);
        }
        report(round, &names, &ious);
        if round < rounds {
            for step in steps {
                let of: Vec<&TrainingCase> =
                    cases.iter().filter(|q| q.step == step && q.traits.len() > 1).collect();
                if !of.is_empty() {
                    let start = weights.of(step).to_vec();
                    weights.of_mut(step).copy_from_slice(&fit_weights(&of, &start));
                }
            }
        }
    }
    steps.iter().for_each(|s| show(*s, weights.of(*s)));
    Ok(())
}
