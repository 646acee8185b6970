//! Shared by the measurements: simulated clicks, images, means.

use segwild_scene::{BoxPrompt, Image, Mask, PointPrompt};
use segwild_vision::{Builtin, EdgeNetwork, Runtime};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An outcome of an example.
pub type ExampleResult<T> = Result<T, Box<dyn std::error::Error>>;

/// The value after a flag.
pub fn option(name: &str) -> Option<String> {
    let mut args = std::env::args();
    args.find(|a| a == name)?;
    args.next()
}

/// The built-in provider, with the edge network of the folder after `--models` if there is one.
pub fn provider() -> ExampleResult<Builtin> {
    let Some(models) = option("--models") else { return Ok(Builtin::new()) };
    let file = Path::new(&models).join("edges_bsds.onnx");
    Ok(Builtin::with_edges(Arc::new(EdgeNetwork::load(&Runtime::find("")?, &file, 1)?)))
}

/// The pixel of the mask farthest from everything else.
pub fn most_interior(mask: &Mask) -> Option<(f32, f32)> {
    let distances = mask.not().distances();
    let (w, h) = (mask.width(), mask.height());
    let mut best = (0.0f32, None);
    for (x, y) in mask.pixels() {
        let frame = (x + 1).min(y + 1).min(w - x).min(h - y) as f32;
        let d = distances[(y * w + x) as usize].min(frame);
        if d > best.0 {
            best = (d, Some((x as f32 + 0.5, y as f32 + 0.5)));
        }
    }
    best.1
}

/// The click that a person would add: in the middle of the largest mistake.
pub fn correction(answer: &Mask, truth: &Mask) -> Option<PointPrompt> {
    let (missed, extra) = (truth.minus(answer), answer.minus(truth));
    let deepest = |m: &Mask| {
        let (x, y) = most_interior(m)?;
        Some((m.not().distances()[y as usize * m.width() as usize + x as usize], x, y))
    };
    match (deepest(&missed), deepest(&extra)) {
        (Some(a), b) if b.is_none_or(|b| a.0 >= b.0) => Some(PointPrompt { x: a.1, y: a.2, inside: true }),
        (_, Some(b)) => Some(PointPrompt { x: b.1, y: b.2, inside: false }),
        _ => None,
    }
}

/// The most interior points of the upper 60 % and the lower 40 % of the mask's rows.
pub fn two_clicks(truth: &Mask) -> Vec<PointPrompt> {
    let rows: Vec<u32> = truth.pixels().map(|p| p.1).collect();
    let (Some(&top), Some(&low)) = (rows.iter().min(), rows.iter().max()) else { return Vec::new() };
    let middle = top + ((low - top + 1) as f32 * 0.6) as u32;
    let part = |upper: bool| {
        Mask::from_fn(truth.width(), truth.height(), |x, y| truth.get(x, y) && (y < middle) == upper)
    };
    [true, false]
        .iter()
        .filter_map(|&upper| most_interior(&part(upper)))
        .map(|(x, y)| PointPrompt { x, y, inside: true })
        .collect()
}

/// The smallest box around a mask.
pub fn box_of(truth: &Mask) -> BoxPrompt {
    let (mut x0, mut y0, mut x1, mut y1) = (f32::MAX, f32::MAX, 0.0f32, 0.0f32);
    for (x, y) in truth.pixels() {
        (x0, y0) = (x0.min(x as f32), y0.min(y as f32));
        (x1, y1) = (x1.max(x as f32 + 1.0), y1.max(y as f32 + 1.0));
    }
    BoxPrompt { x0, y0, x1, y1 }
}

/// A photo with one mask tinted and another's outline drawn.
pub fn overlay(image: &Image, tint: &Mask, outline: Option<&Mask>) -> Image {
    let mut out = image.clone();
    let (w, h) = (image.width, image.height);
    for i in 0..w * h {
        let (x, y) = ((i % w) as u32, (i / w) as u32);
        if tint.index(i) {
            out.data[i] = 0.5 * out.data[i] + 0.5;
            out.data[w * h + i] *= 0.6;
            out.data[2 * w * h + i] *= 0.6;
        }
        let edge =
            |m: &Mask| m.get(x, y) && !(m.get(x + 1, y) && m.get(x, y + 1) && m.get(x.wrapping_sub(1), y));
        if outline.is_some_and(edge) {
            for c in 0..3 {
                out.data[c * w * h + i] = if c == 1 { 1.0 } else { 0.0 };
            }
        }
    }
    out
}

/// Images side by side.
pub fn beside(images: &[Image]) -> Image {
    let (w, h) = (images.iter().map(|i| i.width).sum(), images.iter().map(|i| i.height).max().unwrap_or(1));
    let mut out = Image::zeros(w, h, 3);
    let mut x0 = 0;
    for image in images {
        for c in 0..3 {
            let plane = image.plane(if image.channels == 1 { 0 } else { c });
            for y in 0..image.height {
                let to = (c * h + y) * w + x0;
                out.data[to..to + image.width]
                    .copy_from_slice(&plane[y * image.width..(y + 1) * image.width]);
            }
        }
        x0 += image.width;
    }
    out
}

/// The mean; 0 of nothing.
pub fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// CPU seconds of this thread so far.
pub fn cpu() -> f64 {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    text.split(' ').next().and_then(|t| t.parse::<f64>().ok()).unwrap_or(0.0) * 1e-9
}

/// Name of the object of a set that has but one.
pub const THE_ONE: &str = "the one";

/// What a synthetic set says about itself.
#[derive(serde::Deserialize)]
pub struct TruthManifest {
    /// What is in it.
    pub objects: Vec<TruthObject>,
}

/// One thing of a set.
#[derive(Clone, serde::Deserialize)]
pub struct TruthObject {
    /// Its folder under `truth`.
    pub name: String,
    /// `object`, `surface` or such.
    pub kind: String,
}

/// A photo and where its true masks are.
pub struct PhotoWithTruth {
    /// The photo's file.
    pub file: PathBuf,
    /// Long side it is read at.
    pub long: f32,
    /// Objects and their masks' files.
    pub truths: Vec<(TruthObject, PathBuf)>,
}

impl PhotoWithTruth {
    /// The photo and its masks, at that size.
    pub fn read(&self) -> ExampleResult<(Image, Vec<(String, Mask)>)> {
        let full = Image::read(&self.file)?;
        let scale = (self.long / full.width.max(full.height) as f32).min(1.0);
        let size = |n: usize| ((n as f32 * scale).round() as usize).max(1);
        let image = full.resized(size(full.width), size(full.height));
        let mut masks = Vec::new();
        for (object, file) in self.truths.iter().filter(|t| t.0.kind == "object") {
            let mask = Mask::read_png(file)?.resized(image.width as u32, image.height as u32);
            masks.push((object.name.clone(), mask));
        }
        Ok((image, masks))
    }
}

/// The photos of a synthetic set, or of a folder with `images` and `truth/STEM.png`.
pub fn photos_with_truth(folder: &Path, long: f32) -> ExampleResult<Vec<PhotoWithTruth>> {
    let objects = match std::fs::read_to_string(folder.join("truth.json")) {
        Ok(text) => serde_json::from_str::<TruthManifest>(&text)?.objects,
        Err(_) => vec![TruthObject { name: THE_ONE.into(), kind: "object".into() }],
    };
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder.join("images"))?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    files.sort();
    let with_truths = |file: PathBuf| {
        let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let answers = folder.join("truth");
        let truths = objects.iter().map(|o| {
            let dir = if o.name == THE_ONE { answers.clone() } else { answers.join(&o.name) };
            (o.clone(), dir.join(format!("{stem}.png")))
        });
        PhotoWithTruth { truths: truths.filter(|t| t.1.is_file()).collect(), file, long }
    };
    Ok(files.into_iter().map(with_truths).collect())
}
