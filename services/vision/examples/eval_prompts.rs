//! How well the built-in provider answers prompts about photos whose truth is known: a synthetic set, or a folder with
//! `images` and `truth/STEM.png` (one object), as `liberty`.
//!
//! `cargo run -p segwild-synthetic --example make_synthetic -- DIR --seed N` writes a set; then
//! `cargo run -p segwild-vision --example eval_prompts -- DIR [--every 2] [--skip 1] [--long 320] [--models DIR]
//! [--object NAME] [--photo TEXT] [--each] [--out DIR]`. Of photos without truth only the proposals are made.

#[allow(dead_code, reason = "the examples share it, none uses all of it")]
mod common;

use common::{
    ExampleResult, THE_ONE, TruthManifest, TruthObject, beside, box_of, correction, cpu, mean, most_interior,
    option, overlay, provider, two_clicks,
};
use segwild_scene::{Image, Mask, MaskSet, Prompts, ScoredMask};
use segwild_vision::{Builtin, MaskProposer, PromptSegmenter};
use std::path::{Path, PathBuf};

/// Granularities that are requested.
const LEVELS: [f32; 5] = [0.0, 0.25, 0.5, 0.75, 1.0];
/// Least share of the photo that an object must cover to be queried.
const LEAST: f64 = 0.005;
/// Clicks in all where wrong pixels are corrected one at a time.
const CORRECTED: usize = 8;
/// IoUs whose number of clicks is counted (NoC, as the papers on interactive segmentation call it).
const TARGETS: [f64; 3] = [0.8, 0.85, 0.9];

/// IoUs of one object in one photo.
#[derive(Clone, Debug, Default)]
struct PromptScores {
    /// Best that superpixels could give.
    limit: f64,
    /// CPU seconds of a prompt once the photo is known.
    seconds: f64,
    none: f64,
    levels: Vec<f64>,
    distinct: usize,
    nested: bool,
    two: f64,
    boxed: f64,
    boxed_and_clicked: f64,
    corrected: Vec<f64>,
}

/// IoU of the union of the superpixels that lie mostly in the truth.
fn limit(see: &Builtin, image: &Image, truth: &Mask) -> ExampleResult<f64> {
    let regions = see.regions(image, None)?;
    let mut share = std::collections::BTreeMap::<u32, (usize, usize)>::new();
    for (i, &r) in regions.iter().enumerate() {
        let s = share.entry(r).or_default();
        *s = (s.0 + usize::from(truth.index(i)), s.1 + 1);
    }
    let w = truth.width();
    let best = Mask::from_fn(w, truth.height(), |x, y| {
        let (inside, all) = share[&regions[(y * w + x) as usize]];
        2 * inside > all
    });
    Ok(best.iou(truth))
}

/// Queries one object with every kind of prompt; the masks are those of `PromptScores`, in its order.
fn ask(see: &Builtin, image: &Image, truth: &Mask) -> ExampleResult<(PromptScores, Vec<Mask>)> {
    let Some((x, y)) = most_interior(truth) else { return Ok(Default::default()) };
    let (mut row, mut masks) = (PromptScores::default(), Vec::new());
    row.limit = limit(see, image, truth)?;
    let none = see.segment(image, &Prompts::click(x, y))?.mask;
    row.none = none.iou(truth);
    let mut levels: Vec<Mask> = Vec::new();
    for g in LEVELS {
        let prompts = Prompts { granularity: Some(g), ..Prompts::click(x, y) };
        levels.push(see.segment(image, &prompts)?.mask);
    }
    row.levels = levels.iter().map(|m| m.iou(truth)).collect();
    row.nested = levels.windows(2).all(|p| p[0].minus(&p[1]).is_empty());
    row.distinct = 1 + levels.windows(2).filter(|p| p[0] != p[1]).count();
    let two = see.segment(image, &Prompts { points: two_clicks(truth), ..Prompts::default() })?.mask;
    row.two = two.iou(truth);
    let boxes = vec![box_of(truth)];
    let boxed = see.segment(image, &Prompts { boxes: boxes.clone(), ..Prompts::default() })?.mask;
    row.boxed = boxed.iou(truth);
    let both = see.segment(image, &Prompts { boxes, ..Prompts::click(x, y) })?.mask;
    row.boxed_and_clicked = both.iou(truth);
    let (mut prompts, mut answer) = (Prompts::click(x, y), none.clone());
    row.corrected.push(row.none);
    while row.corrected.len() < CORRECTED {
        prompts.points.extend(correction(&answer, truth));
        let start = cpu();
        answer = see.segment(image, &prompts)?.mask;
        row.seconds += (cpu() - start) / (CORRECTED - 1) as f64;
        row.corrected.push(answer.iou(truth));
    }
    masks.push(none);
    masks.extend(levels);
    masks.extend([two, boxed, both, answer]);
    Ok((row, masks))
}

/// Proposals at a grid of points, as many masks as an automatic run would see.
fn proposals(see: &Builtin, image: &Image) -> ExampleResult<Vec<ScoredMask>> {
    let (columns, rows) = (9, 7);
    let points: Vec<[f32; 2]> = (0..columns * rows)
        .map(|i| {
            [
                (i % columns) as f32 * image.width as f32 / columns as f32
                    + 0.5 * image.width as f32 / columns as f32,
                (i / columns) as f32 * image.height as f32 / rows as f32
                    + 0.5 * image.height as f32 / rows as f32,
            ]
        })
        .collect();
    Ok(see.propose(image, &points)?)
}

/// Whether a proposal passes the usual thresholds (method, section 5).
fn passes(mask: &ScoredMask) -> bool {
    mask.predicted_iou >= 0.88 && mask.stability >= 0.95
}

/// The scores of one photo.
#[derive(Default)]
struct PhotoScores {
    rows: Vec<(String, PromptScores)>,
    /// Passing and all proposals.
    counts: (usize, usize),
    /// Best IoU with any object's truth, of proposals that pass and that do not.
    quality: (Vec<f64>, Vec<f64>),
    /// Best IoU of the passing proposals per object.
    found: Vec<f64>,
}

fn evaluate(
    see: &Builtin,
    folder: &Path,
    file: &Path,
    objects: &[TruthObject],
    out: Option<&Path>,
) -> ExampleResult<PhotoScores> {
    let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let full = Image::read(file)?;
    let long: f32 = option("--long").map_or(Ok(320.0), |t| t.parse())?;
    let scale = (long / full.width.max(full.height) as f32).min(1.0);
    let size = |n: usize| ((n as f32 * scale).round() as usize).max(1);
    let image = full.resized(size(full.width), size(full.height));
    let (w, h) = (image.width as u32, image.height as u32);
    let mut photo = PhotoScores::default();
    let mut truths = Vec::new();
    for object in objects {
        let answers = folder.join("truth");
        let path = match object.name.as_str() {
            THE_ONE => answers.join(format!("{stem}.png")),
            name => answers.join(name).join(format!("{stem}.png")),
        };
        if !path.is_file() {
            continue;
        }
        let truth = Mask::read_png(&path)?.resized(w, h);
        if (truth.count() as f64) < LEAST * f64::from(w * h) {
            continue;
        }
        if object.kind == "object" && option("--object").is_none_or(|o| o == object.name) {
            let (row, masks) = ask(see, &image, &truth)?;
            if let Some(out) = out {
                let images: Vec<Image> = masks.iter().map(|m| overlay(&image, m, Some(&truth))).collect();
                beside(&images).write_png(&out.join(format!("{stem}_{}.png", object.name)))?;
            }
            photo.rows.push((format!("{stem} {}", object.name), row));
        }
        truths.push(truth);
    }
    let proposed = proposals(see, &image)?;
    let passing =
        MaskSet { width: w, height: h, masks: proposed.iter().filter(|m| passes(m)).cloned().collect() };
    photo.counts = (passing.masks.len(), proposed.len());
    for mask in &proposed {
        let best = truths.iter().map(|t| t.iou(&mask.mask)).fold(0.0, f64::max);
        if passes(mask) { photo.quality.0.push(best) } else { photo.quality.1.push(best) }
    }
    photo.found =
        truths.iter().map(|t| passing.masks.iter().map(|m| m.mask.iou(t)).fold(0.0, f64::max)).collect();
    if let Some(out) = out {
        let images: Vec<Image> = passing.masks.iter().map(|m| overlay(&image, &m.mask, None)).collect();
        let rows: Vec<Image> = images.chunks(8).map(beside).collect();
        for (k, row) in rows.iter().enumerate() {
            row.write_png(&out.join(format!("{stem}-proposals-{k}.png")))?;
        }
    }
    Ok(photo)
}

fn main() -> ExampleResult<()> {
    let folder =
        PathBuf::from(std::env::args().nth(1).ok_or("name the folder of a synthetic set or of photos")?);
    let every: usize = option("--every").map_or(Ok(1), |t| t.parse())?;
    let skip: usize = option("--skip").map_or(Ok(0), |t| t.parse())?;
    let only = option("--photo").unwrap_or_default();
    let out = option("--out").map(PathBuf::from);
    if let Some(out) = &out {
        std::fs::create_dir_all(out)?;
    }
    let (objects, photos) = match std::fs::read_to_string(folder.join("truth.json")) {
        Ok(text) => (serde_json::from_str::<TruthManifest>(&text)?.objects, folder.join("images")),
        Err(_) if folder.join("truth").is_dir() => {
            (vec![TruthObject { name: THE_ONE.into(), kind: "object".into() }], folder.join("images"))
        }
        Err(_) => (Vec::new(), folder.clone()),
    };
    let see = provider()?;
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(&photos)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    files.sort();
    files.retain(|f| f.to_string_lossy().contains(&only));
    let files: Vec<PathBuf> = files.into_iter().skip(skip).step_by(every.max(1)).collect();
    let all: Vec<PhotoScores> = std::thread::scope(|scope| {
        let share = |half: usize| {
            let (files, objects, folder, out, see) = (&files, &objects, &folder, &out, &see);
            scope.spawn(move || {
                files
                    .iter()
                    .skip(half)
                    .step_by(2)
                    .map(|f| evaluate(see, folder, f, objects, out.as_deref()).map_err(|e| e.to_string()))
                    .collect::<Result<Vec<_>, String>>()
            })
        };
        let halves = [share(0), share(1)];
        halves.map(|h| h.join().unwrap_or_else(|_| Err("a thread panicked".into())))
    })
    .into_iter()
    .collect::<Result<Vec<_>, String>>()?
    .into_iter()
    .flatten()
    .collect();
    let rows: Vec<&(String, PromptScores)> = all.iter().flat_map(|p| &p.rows).collect();
    if std::env::args().any(|a| a == "--each") {
        let text = |v: &[f64]| v.iter().map(|v| format!("{v:.2}")).collect::<Vec<_>>().join(" ");
        for (name, r) in &rows {
            println!(
                "{name:<26} none {:.2} levels {} ({}) two {:.2} box {:.2} box+click {:.2} corrected {}",
                r.none,
                text(&r.levels),
                r.distinct,
                r.two,
                r.boxed,
                r.boxed_and_clicked,
                text(&r.corrected)
            );
        }
    }
    let over = |f: &dyn Fn(&PromptScores) -> f64| mean(&rows.iter().map(|r| f(&r.1)).collect::<Vec<_>>());
    if !rows.is_empty() {
        let levels: Vec<String> =
            (0..LEVELS.len()).map(|k| format!("{:.3}", over(&|r| r.levels[k]))).collect();
        println!(
            "{} objects; one click: None {:.3}, best of five levels {:.3} (each: {}); distinct levels {:.2}, nested {:.2}",
            rows.len(),
            over(&|r| r.none),
            over(&|r| r.levels.iter().copied().fold(0.0, f64::max)),
            levels.join(" "),
            over(&|r| r.distinct as f64),
            over(&|r| f64::from(u8::from(r.nested))),
        );
        println!(
            "two clicks {:.3}; box {:.3}; box and click {:.3}; best union of superpixels {:.3}; CPU-s a prompt {:.4}",
            over(&|r| r.two),
            over(&|r| r.boxed),
            over(&|r| r.boxed_and_clicked),
            over(&|r| r.limit),
            over(&|r| r.seconds)
        );
        let corrected: Vec<String> =
            (0..CORRECTED).map(|k| format!("{:.3}", over(&|r| r.corrected[k]))).collect();
        println!("corrected click by click {}", corrected.join(" "));
        let clicks = |r: &PromptScores, target: f64| {
            r.corrected.iter().position(|&v| v >= target).map_or(CORRECTED, |k| k + 1) as f64
        };
        let noc: Vec<String> =
            TARGETS.iter().map(|&t| format!("NoC@{:.0} {:.2}", 100.0 * t, over(&|r| clicks(r, t)))).collect();
        let worse = |r: &PromptScores| r.corrected.windows(2).filter(|p| p[1] < p[0] - 0.005).count() as f64;
        let drop = |r: &PromptScores| r.corrected.windows(2).map(|p| (p[0] - p[1]).max(0.0)).sum::<f64>();
        println!(
            "{} (at most {CORRECTED}); added clicks that made it worse: {:.1} %, by {:.3} IoU in all an object",
            noc.join(", "),
            100.0 * over(&worse) / (CORRECTED - 1) as f64,
            over(&drop)
        );
    }
    let counts: Vec<f64> = all.iter().map(|p| p.counts.0 as f64).collect();
    let proposed: Vec<f64> = all.iter().map(|p| p.counts.1 as f64).collect();
    println!(
        "proposals that pass: mean {:.1}, least {:.0}, most {:.0}, of {:.1}",
        mean(&counts),
        counts.iter().copied().fold(f64::MAX, f64::min),
        counts.iter().copied().fold(0.0, f64::max),
        mean(&proposed)
    );
    let gather = |f: &dyn Fn(&PhotoScores) -> &Vec<f64>| {
        mean(&all.iter().flat_map(|p| f(p).clone()).collect::<Vec<_>>())
    };
    println!(
        "best IoU with an object: of passing proposals {:.3}, of others {:.3}; objects' best passing proposal {:.3}",
        gather(&|p| &p.quality.0),
        gather(&|p| &p.quality.1),
        gather(&|p| &p.found)
    );
    Ok(())
}
