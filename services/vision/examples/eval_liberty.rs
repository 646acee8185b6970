//! How well the built-in provider sees the `liberty` photos: clicks, boxes, refinement, sky, time.
//!
//! `cargo run -p segwild-vision --example eval_liberty -- [--models DIR] [--edges network] [--out DIR] [--only TEXT]
//! [--long 320]`; photos and truth are read from `$SEGWILD_SHARED/data/liberty` (default `../shared`).

#[allow(dead_code, reason = "the examples share it, none uses all of it")]
mod common;

use common::{ExampleResult, beside, box_of, cpu, mean, most_interior, option, overlay, two_clicks};
use segwild_scene::{Image, Mask, Prompts};
use segwild_vision::{Builtin, Providers, SkyDetector, VisionSettings};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A certainty as a rendered selection might be: the truth with its outline moved by up to `reach` pixels in a way that
/// changes along it, `shift` pixels on the whole, soft, with holes inside and blobs outside.
fn degraded(truth: &Mask, reach: f32, shift: f32, seed: u32) -> Image {
    let (w, h) = (truth.width() as usize, truth.height() as usize);
    let (out, inn) = (truth.distances(), truth.not().distances());
    let mut state = seed.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    let mut random = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let waves: Vec<[f32; 3]> = (0..6)
        .map(|_| [random() * 0.4 - 0.2, random() * 0.4 - 0.2, random() * std::f32::consts::TAU])
        .collect();
    let mut certainty = Image::zeros(w, h, 1);
    for i in 0..w * h {
        let (x, y) = ((i % w) as f32, (i / w) as f32);
        let wave: f32 = waves.iter().map(|k| (k[0] * x + k[1] * y + k[2]).sin()).sum::<f32>() / 2.5;
        let signed = if truth.index(i) { inn[i] - 0.5 } else { 0.5 - out[i] };
        let moved = signed + shift + reach * wave.clamp(-1.0, 1.0);
        certainty.data[i] = 1.0 / (1.0 + (-moved / 2.5).exp());
    }
    let inside: Vec<_> = truth.pixels().collect();
    for k in 0..5 {
        let (cx, cy) = if k < 3 {
            inside.get((random() * inside.len() as f32) as usize).copied().unwrap_or((0, 0))
        } else {
            ((random() * w as f32) as u32, (random() * h as f32) as u32)
        };
        let radius = 5.0 + 6.0 * random();
        for i in 0..w * h {
            let (dx, dy) = ((i % w) as f32 - cx as f32, (i / w) as f32 - cy as f32);
            if dx * dx + dy * dy < radius * radius {
                certainty.data[i] = if k < 3 { 0.15 * certainty.data[i] } else { certainty.data[i].max(0.8) };
            }
        }
    }
    certainty
}

/// The first three principal components of an embedding as an RGB image.
fn image_of(embedding: &segwild_scene::Embedding, width: usize, height: usize) -> Image {
    let (n, c) = (embedding.width * embedding.height, embedding.channels);
    let mut rows: Vec<Vec<f32>> = (0..c).map(|k| embedding.data[k * n..(k + 1) * n].to_vec()).collect();
    for row in &mut rows {
        let mean = row.iter().sum::<f32>() / n as f32;
        row.iter_mut().for_each(|v| *v -= mean);
    }
    let mut out = Image::zeros(embedding.width, embedding.height, 3);
    for axis in 0..3 {
        let mut direction: Vec<f32> = (0..c).map(|k| 1.0 + (k % 7) as f32).collect();
        let mut scores = vec![0.0; n];
        for _ in 0..60 {
            for (i, s) in scores.iter_mut().enumerate() {
                *s = rows.iter().zip(&direction).map(|(r, d)| r[i] * d).sum();
            }
            direction = rows.iter().map(|r| r.iter().zip(&scores).map(|(a, b)| a * b).sum()).collect();
            let norm = direction.iter().map(|d| d * d).sum::<f32>().sqrt().max(1e-20);
            direction.iter_mut().for_each(|d| *d /= norm);
        }
        for (i, s) in scores.iter_mut().enumerate() {
            *s = rows.iter().zip(&direction).map(|(r, d)| r[i] * d).sum();
        }
        let spread = scores.iter().map(|s| s * s).sum::<f32>().sqrt() / (n as f32).sqrt();
        for (i, s) in scores.iter().enumerate() {
            out.data[axis * n + i] = 0.5 + 0.25 * s / spread.max(1e-9);
        }
        for (row, d) in rows.iter_mut().zip(&direction) {
            row.iter_mut().zip(&scores).for_each(|(r, s)| *r -= s * d);
        }
    }
    out.resized(width, height)
}

/// Clicks in one photo, carried to every photo by the cosine of descriptors alone (mean-centred over all photos).
fn across(photos: &[(segwild_scene::Embedding, Vec<bool>, Vec<usize>)]) {
    let Some(channels) = photos.first().map(|p| p.0.channels) else { return };
    let mut centre = vec![0.0f64; channels];
    let cells: usize = photos.iter().map(|p| p.1.len()).sum();
    for (e, truth, _) in photos {
        let n = truth.len();
        for (c, sum) in centre.iter_mut().enumerate() {
            *sum += e.data[c * n..(c + 1) * n].iter().map(|v| f64::from(*v)).sum::<f64>() / cells as f64;
        }
    }
    let unit = |e: &segwild_scene::Embedding, n: usize, i: usize| -> Vec<f32> {
        let v: Vec<f32> = (0..channels).map(|c| e.data[c * n + i] - centre[c] as f32).collect();
        let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-9);
        v.iter().map(|x| x / norm).collect()
    };
    let taus = [0.2f32, 0.3, 0.4, 0.5, 0.6, 0.7];
    let (mut same, mut other) = (vec![Vec::new(); taus.len()], vec![Vec::new(); taus.len()]);
    let units: Vec<Vec<Vec<f32>>> =
        photos.iter().map(|(e, t, _)| (0..t.len()).map(|i| unit(e, t.len(), i)).collect()).collect();
    for (i, (_, _, clicks)) in photos.iter().enumerate() {
        for (j, (_, truth, _)) in photos.iter().enumerate().filter(|(j, _)| *j == i || (i * 7 + j) % 5 == 0) {
            let s: Vec<f32> = units[j]
                .iter()
                .map(|u| {
                    clicks
                        .iter()
                        .map(|&c| units[i][c].iter().zip(u).map(|(a, b)| a * b).sum::<f32>())
                        .fold(-1.0, f32::max)
                })
                .collect();
            for (k, tau) in taus.iter().enumerate() {
                let both = s.iter().zip(truth).filter(|(s, t)| **s > *tau && **t).count();
                let either = s.iter().zip(truth).filter(|(s, t)| **s > *tau || **t).count();
                let iou = both as f64 / either.max(1) as f64;
                if i == j { same[k].push(iou) } else { other[k].push(iou) }
            }
        }
    }
    let text = |v: &[Vec<f64>]| v.iter().map(|v| format!("{:.3}", mean(v))).collect::<Vec<_>>().join(" ");
    println!(
        "(e) {channels} channels, cosine over tau 0.2..0.7: same photo {}; other photos {}",
        text(&same),
        text(&other)
    );
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(0.0)
}

fn main() -> ExampleResult<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let shared = std::env::var_os("SEGWILD_SHARED").map_or_else(|| root.join("../shared"), PathBuf::from);
    let folder = shared.join("data/liberty");
    let long: usize = option("--long").map_or(Ok(320), |t| t.parse())?;
    let only = option("--only").unwrap_or_default();
    let quiet = std::env::args().any(|a| a == "--quiet");
    let out = option("--out").map(PathBuf::from);
    let mut settings = VisionSettings::default();
    if let Some(models) = option("--models") {
        settings.models = models;
    }
    if option("--edges").is_some_and(|e| e == "builtin") {
        settings.edges = segwild_vision::EdgeChoice::Builtin;
    }
    let providers = Providers::from_settings(&settings)?;
    providers.notes.iter().for_each(|n| println!("{n}"));
    let builtin = Builtin::new();
    let mut skies: Vec<(String, Arc<dyn SkyDetector>)> = vec![("builtin".into(), Arc::new(Builtin::new()))];
    if !settings.models.is_empty() {
        for sky in [segwild_vision::SkyChoice::Network, segwild_vision::SkyChoice::Deeplab] {
            let these = Providers::from_settings(&VisionSettings { sky, ..settings.clone() })?;
            skies.push((sky.to_string(), these.sky));
        }
    }
    let levels: Vec<f32> = (1..=20).map(|k| k as f32 / 20.0).collect();
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder.join("images"))?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    files.sort();
    let (mut best, mut two, mut boxed, mut three) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut per_level = vec![Vec::new(); levels.len()];
    let mut one_none = Vec::new();
    let (mut oracle, mut leaves, mut described) = (Vec::new(), Vec::new(), Vec::new());
    let mut refined: Vec<(Vec<f64>, Vec<f64>)> = vec![Default::default(); 4];
    let mut times = [Vec::new(), Vec::new(), Vec::new()];
    let mut sky_bad = vec![Vec::new(); skies.len()];
    let mut sky_agree = vec![Vec::new(); skies.len()];
    println!("{:<32} spx best@level one two box prop3 | before>after refine x4 | sky on truth", "photo");
    for (index, file) in files.iter().enumerate() {
        let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        if !stem.contains(&only) {
            continue;
        }
        let full = Image::read(file)?;
        let scale = long as f32 / full.width.max(full.height) as f32;
        let size = |n: usize| ((n as f32 * scale).round() as usize).max(1);
        let image = full.resized(size(full.width), size(full.height));
        let (w, h) = (image.width as u32, image.height as u32);
        let truth = Mask::read_png(&folder.join("truth").join(format!("{stem}.png")))?.resized(w, h);
        let start = cpu();
        let embedding = providers.embedder.embed(&image)?;
        times[0].push(cpu() - start);
        // The best that any union of superpixels could do.
        let regions = builtin.regions(&image, None)?;
        let mut votes = vec![[0usize; 2]; regions.iter().max().map_or(0, |m| *m as usize + 1)];
        regions.iter().enumerate().for_each(|(i, &r)| votes[r as usize][usize::from(truth.index(i))] += 1);
        let ideal = Mask::from_fn(w, h, |x, y| {
            let vote = votes[regions[(y * w + x) as usize] as usize];
            vote[1] > vote[0]
        });
        oracle.push(ideal.iou(&truth));
        leaves.push(votes.len() as f64);
        let cell_truth: Vec<bool> = {
            let t = Image {
                width: image.width,
                height: image.height,
                channels: 1,
                data: (0..image.pixels()).map(|i| f32::from(u8::from(truth.index(i)))).collect(),
            };
            t.resized(embedding.width, embedding.height).data.iter().map(|v| *v > 0.5).collect()
        };
        let clicked: Vec<usize> = two_clicks(&truth)
            .iter()
            .map(|p| {
                let (cx, cy) = (
                    p.x as usize * embedding.width / image.width,
                    p.y as usize * embedding.height / image.height,
                );
                cy * embedding.width + cx
            })
            .collect();
        described.push((embedding.clone(), cell_truth, clicked));
        let Some((x, y)) = most_interior(&truth) else { continue };
        let mut here = (0.0, 0.0f32);
        for (k, &level) in levels.iter().enumerate() {
            let prompts = Prompts { granularity: Some(level), ..Prompts::click(x, y) };
            let iou = providers.segmenter.segment(&image, &prompts)?.mask.iou(&truth);
            per_level[k].push(iou);
            if iou > here.0 {
                here = (iou, level);
            }
        }
        best.push(here.0);
        let one = providers.segmenter.segment(&image, &Prompts::click(x, y))?;
        one_none.push(one.mask.iou(&truth));
        let start = cpu();
        let prompts = Prompts { points: two_clicks(&truth), ..Prompts::default() };
        let pair = providers.segmenter.segment(&image, &prompts)?;
        times[1].push(cpu() - start);
        two.push(pair.mask.iou(&truth));
        let prompts = Prompts { boxes: vec![box_of(&truth)], ..Prompts::default() };
        let boxed_mask = providers.segmenter.segment(&image, &prompts)?;
        boxed.push(boxed_mask.mask.iou(&truth));
        let proposals = providers.proposer.propose(&image, &[[x, y]])?;
        three.push(proposals.iter().map(|p| p.mask.iou(&truth)).fold(0.0, f64::max));
        let mut text = String::new();
        let mut last = Mask::empty(w, h);
        let mut rough = last.clone();
        for (k, (reach, shift)) in [(5.0, 0.0), (1.5, 6.0), (1.5, -6.0), (0.0, 0.0)].into_iter().enumerate() {
            let certainty = degraded(&truth, reach, shift, (index * 4 + k) as u32 + 1);
            let start = cpu();
            let snapped = providers.segmenter.refine(&image, &certainty)?;
            times[2].push(cpu() - start);
            let before = Mask::over(w, h, &certainty.data, 0.5);
            refined[k].0.push(before.iou(&truth));
            refined[k].1.push(snapped.mask.iou(&truth));
            text += &format!(" {:.3}>{:.3}", before.iou(&truth), snapped.mask.iou(&truth));
            if k == 0 {
                last = snapped.mask;
                rough = before;
            }
        }
        text += " |";
        let mut masks = Vec::new();
        for (k, (_, sky)) in skies.iter().enumerate() {
            let mask = sky.sky(&image)?;
            let bad = mask.overlap(&truth) as f64 / truth.count() as f64;
            sky_bad[k].push(bad);
            text += &format!(" {:.3} ({:.2})", bad, mask.count() as f64 / f64::from(w * h));
            if let Some(reference) = masks.last() {
                sky_agree[k].push(mask.iou(reference));
            }
            masks.push(mask);
        }
        if !quiet {
            println!(
                "{stem:<32} {:.3}@{:.2} {:.3} {:.3} {:.3} {:.3} |{text}",
                here.0,
                here.1,
                one_none.last().unwrap_or(&0.0),
                two.last().unwrap_or(&0.0),
                boxed.last().unwrap_or(&0.0),
                three.last().unwrap_or(&0.0)
            );
        }
        if let Some(out) = &out {
            std::fs::create_dir_all(out)?;
            let lines = builtin.boundaries(&image)?;
            let level = |g: f32| {
                let prompts = Prompts { granularity: Some(g), ..Prompts::click(x, y) };
                providers.segmenter.segment(&image, &prompts).map(|m| overlay(&image, &m.mask, Some(&truth)))
            };
            let row = beside(&[
                overlay(&image, &pair.mask, Some(&truth)),
                overlay(&image, &one.mask, Some(&truth)),
                level(here.1)?,
                overlay(&image, &rough, Some(&truth)),
                overlay(&image, &last, Some(&truth)),
                overlay(&image, &masks[0], None),
                lines,
                image_of(&embedding, image.width, image.height),
            ]);
            row.write_png(&out.join(format!("{stem}.png")))?;
        }
    }
    let fixed = per_level
        .iter()
        .enumerate()
        .map(|(k, v)| (mean(v), levels[k]))
        .fold((0.0, 0.0), |a, b| if b.0 > a.0 { b } else { a });
    println!("(a) one click: best level per photo: mean {:.3} median {:.3}", mean(&best), median(&best));
    println!(
        "(a) one click: best fixed level {:.2}: mean {:.3}; level chosen: {:.3}; best of the proposals {:.3}",
        fixed.1,
        fixed.0,
        mean(&one_none),
        mean(&three)
    );
    let curve: Vec<String> = per_level.iter().map(|v| format!("{:.2}", mean(v))).collect();
    println!("    by level: {}", curve.join(" "));
    println!(
        "(b) two clicks, level chosen: mean {:.3} median {:.3}; a box: mean {:.3}",
        mean(&two),
        median(&two),
        mean(&boxed)
    );
    for (name, (before, after)) in ["wavy", "wide", "narrow", "soft"].iter().zip(&refined) {
        println!("(c) refine, {name}: {:.3} -> {:.3}", mean(before), mean(after));
    }
    println!(
        "(d) CPU-s a photo: analysis and embedding {:.3}, a prompt {:.4}, a refinement {:.4}",
        mean(&times[0]),
        mean(&times[1]),
        mean(&times[2])
    );
    println!("    superpixels {:.0}, best union of them {:.3}", mean(&leaves), mean(&oracle));
    across(&described);
    for ((name, _), (bad, agree)) in skies.iter().zip(sky_bad.iter().zip(&sky_agree)) {
        println!(
            "    sky by {name}: share of the truth called sky: mean {:.4}, worst {:.3}; IoU with the one before {:.3}",
            mean(bad),
            bad.iter().copied().fold(0.0, f64::max),
            mean(agree)
        );
    }
    Ok(())
}
