//! Where the affinity query loses an object: embeddings in the clicked photo, embeddings across photos, or the feature field.
//!
//! `cargo run -p segwild-eval --example affinity -- RUN TRUTH [PHOTOS]`; TRUTH holds the object's mask of some photos, named as they are.
//! Each of PHOTOS (8) photos is clicked at the pixel deepest inside the object. A row gives the mean over the clicks of the IoU at the
//! paper's thresholds and at the best one, which needs the truth, and that threshold. 2D rows count cells of the embeddings, 3D rows
//! count the light of splats.

use segwild_pipeline::{RunFolder, Settings};
use segwild_raster::{Channels, CpuEngine, Rasterizer};
use segwild_scene::{Embedding, Image, Mask};
use segwild_segmenter::SplatFeatures;
use segwild_vision::Providers;
use std::path::Path;

/// Similarities, whether each belongs to the object, and what each counts.
type Scored = Vec<(f32, bool, f32)>;

/// Thresholds of the paper's Table 2.
const PUBLISHED: [f32; 3] = [0.3, 0.5, 0.7];

fn iou(scored: &Scored, tau: f32) -> f64 {
    let sum = |counts: &dyn Fn(bool, bool) -> bool| {
        let all = scored.iter().filter(|(s, inside, _)| counts(*s >= tau, *inside));
        all.map(|(_, _, weight)| f64::from(*weight)).sum::<f64>()
    };
    sum(&|a, b| a && b) / sum(&|a, b| a || b).max(1e-9)
}

#[derive(Default)]
struct Row {
    published: [f64; 3],
    best: f64,
    tau: f64,
    count: f64,
}

impl Row {
    fn add(&mut self, scored: &Scored) {
        let best = (-20..=100)
            .map(|k| (iou(scored, k as f32 / 100.0), k))
            .fold((0.0, 0), |a, b| if b.0 > a.0 { b } else { a });
        for (sum, tau) in self.published.iter_mut().zip(PUBLISHED) {
            *sum += iou(scored, tau);
        }
        self.best += best.0;
        self.tau += f64::from(best.1) / 100.0;
        self.count += 1.0;
    }

    fn print(&self, name: &str) {
        let [a, b, c] = self.published.map(|v| v / self.count);
        let (best, tau) = (self.best / self.count, self.tau / self.count);
        println!("{name:44} tau .3 {a:.3}  .5 {b:.3}  .7 {c:.3}  best {best:.3} at {tau:.2}");
    }
}

/// The unit vector of an embedding's cell.
fn cell(e: &Embedding, at: usize) -> Vec<f32> {
    let mut vector: Vec<f32> = (0..e.channels).map(|c| e.data[c * e.width * e.height + at]).collect();
    let norm = vector.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    vector.iter_mut().for_each(|v| *v /= norm);
    vector
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Similarities of an embedding's cells to a vector.
fn cells(e: &Embedding, truth: &Mask, query: &[f32]) -> Scored {
    let truth = truth.resized(e.width as u32, e.height as u32);
    (0..e.width * e.height).map(|i| (dot(&cell(e, i), query), truth.index(i), 1.0)).collect()
}

/// The pixel deepest inside a mask.
fn deepest(mask: &Mask) -> usize {
    let distances = mask.not().distances();
    (0..distances.len()).max_by(|&a, &b| distances[a].total_cmp(&distances[b])).unwrap_or(0)
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut given = std::env::args().skip(1);
    let run = given.next().ok_or("which run? the first argument is its folder")?;
    let truth = given.next().ok_or("which object? the second argument is the folder of its masks")?;
    let photos: usize = given.next().map_or(Ok(8), |text| text.parse())?;
    let folder = RunFolder::open(Path::new(&run))?;
    let loaded = folder.load()?;
    let settings: &Settings = &loaded.settings;
    let providers = Providers::from_settings(&settings.vision)?;
    let size = settings.scene.size;
    let masks: Vec<(usize, Mask)> = (0..loaded.scene.views.len())
        .filter_map(|v| {
            let view = &loaded.scene.views[v];
            let path = Path::new(&truth).join(&view.name).with_extension("png");
            let mask = Mask::read_png(&path).ok()?;
            (mask.count() > 200).then(|| (v, view.mask_from_taken(mask)))
        })
        .collect();
    if masks.is_empty() {
        return Err(format!("no mask in {truth} is named as a photo of the run").into());
    }
    let embeddings: Vec<Embedding> = masks
        .iter()
        .map(|(v, _)| Ok(providers.embedder.embed(&loaded.scene.views[*v].load(size)?.image)?))
        .collect::<Result<_, Box<dyn std::error::Error>>>()?;
    // What each splat is, by the light that it sends into the true masks.
    let engine = CpuEngine::default();
    let (splats, options) = (&loaded.model.splats, loaded.model.options());
    let mut light = vec![[0.0f32; 2]; splats.len()];
    for (v, mask) in &masks {
        let view = &loaded.scene.views[*v];
        let camera = view.camera.scaled_to(size);
        let mask = mask.resized(camera.width, camera.height);
        let mut pixels = Image::zeros(camera.width as usize, camera.height as usize, 2);
        for i in 0..pixels.pixels() {
            pixels.plane_mut(usize::from(mask.index(i)))[i] = 1.0;
        }
        let seen = engine.project(splats, &camera, &view.pose, &options)?.gather(&pixels)?;
        light.iter_mut().zip(seen.chunks_exact(2)).for_each(|(sum, l)| *sum = [sum[0] + l[0], sum[1] + l[1]]);
    }
    let field = loaded.field.as_ref().ok_or("the run has no features yet")?;
    let features = SplatFeatures::of(field.rows.clone());
    let values = field.values();
    let channels = Channels { count: field.channels(), values: &values };
    let scored = |similarity: &[f32]| -> Scored {
        let of = |(s, [outside, inside]): (&f32, &[f32; 2])| (*s, inside > outside, inside + outside);
        similarity.iter().zip(&light).map(of).collect()
    };
    let object: Vec<usize> = (0..splats.len()).filter(|&i| light[i][1] > light[i][0]).collect();
    let mean = |rows: &mut dyn Iterator<Item = Vec<f32>>| {
        let mut sum = vec![0.0; features.channels()];
        rows.for_each(|row| sum.iter_mut().zip(row).for_each(|(sum, v)| *sum += v));
        sum
    };
    let of_object = mean(&mut object.iter().map(|&i| {
        let row = features.row(i);
        let norm = dot(&row, &row).sqrt().max(1e-12);
        row.iter().map(|v| v / norm * (light[i][0] + light[i][1])).collect()
    }));
    let mut rows: [Row; 6] = Default::default();
    let step = masks.len().div_ceil(photos).max(1);
    for k in (0..masks.len()).step_by(step) {
        let (v, mask) = &masks[k];
        let view = &loaded.scene.views[*v];
        let e = &embeddings[k];
        let click = cell(e, deepest(&mask.resized(e.width as u32, e.height as u32)));
        rows[0].add(&cells(e, mask, &click));
        let others: Vec<Scored> = (0..masks.len())
            .filter(|&j| j != k)
            .map(|j| cells(&embeddings[j], &masks[j].1, &click))
            .collect();
        others.iter().for_each(|scored| rows[1].add(scored));
        // The field at the click, divided by the cover: any scale has the same cosine.
        let camera = view.camera.scaled_to(size);
        let image = engine.project(splats, &camera, &view.pose, &options)?.blend(&channels)?.image;
        let mask = mask.resized(camera.width, camera.height);
        let n = image.pixels();
        let feature =
            |at: usize| -> Vec<f32> { (0..image.channels).map(|c| image.data[c * n + at]).collect() };
        let clicked = feature(deepest(&mask));
        let similarity = features.similarity(&engine, &[clicked], 1.0)?;
        rows[2].add(&scored(&similarity));
        // Eight clicks all over the object's mask: the softmax of the paper.
        let inside: Vec<usize> = (0..n).filter(|&i| mask.index(i)).collect();
        let many: Vec<Vec<f32>> = (0..8).map(|j| feature(inside[(2 * j + 1) * inside.len() / 16])).collect();
        rows[3].add(&scored(&features.similarity(&engine, &many, 1.0)?));
        rows[4].add(&scored(&features.similarity(&engine, &many, 0.1)?));
    }
    rows[5].add(&scored(&features.similarity(&engine, &[of_object], 1.0)?));
    println!(
        "{} photos with masks, {} of {} splats are the object, {}",
        masks.len(),
        object.len(),
        splats.len(),
        providers.name
    );
    rows[0].print("2D: one click, cells of the clicked photo");
    rows[1].print("2D: one click, cells of the other photos");
    rows[2].print("3D: one click");
    rows[3].print("3D: eight clicks, temperature 1");
    rows[4].print("3D: eight clicks, temperature .1");
    rows[5].print("3D: the mean of the true object");
    Ok(())
}
