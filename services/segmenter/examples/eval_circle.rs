//! Prompts in one photo against the truth on all others: `eval_circle SCENE SPLATS.ply [--size 320]
//! [--photo NAME]... [--oracle true] [--SETTING VALUE]...` with the settings of the group `segment` as flags.
//!
//! The scene's folder holds `truth/STEM.png`. Two clicks are made per reference photo, in the upper and the lower
//! part of the object; `--oracle true` prompts with the true mask instead of the 2D segmenter's, which shows what
//! the carrying alone loses. Prints, per reference photo, the IoU of every other photo's visible mask.

use segwild_raster::{CpuEngine, ProjectOptions};
use segwild_scene::settings::Group;
use segwild_scene::{Image, Mask, PointPrompt, Prompts, Scene, SceneSettings, ply};
use segwild_segmenter::{
    NeighbourGraph, PhotoVerdict, PosedView, PromptedView, Request, SegmentSettings, cut, cut_scene, select,
    visible_mask,
};
use segwild_vision::{PromptSegmenter, Providers, VisionSettings};
use std::error::Error;
use std::path::PathBuf;

/// The pixel farthest from the outside among those of a mask that lie in a range of rows.
fn click(truth: &Mask, from: f32, to: f32) -> Option<PointPrompt> {
    let (top, low) = (truth.pixels().next()?.1 as f32, truth.pixels().last()?.1 as f32 + 1.0);
    let inside = |y: u32| (y as f32) >= top + from * (low - top) && (y as f32) < top + to * (low - top);
    let band = Mask::from_fn(truth.width(), truth.height(), |x, y| truth.get(x, y) && inside(y));
    let far = band.not().distances();
    let (x, y) = band.pixels().max_by(|a, b| {
        let at = |p: &(u32, u32)| far[(p.1 * band.width() + p.0) as usize];
        at(a).total_cmp(&at(b))
    })?;
    Some(PointPrompt { x: x as f32 + 0.5, y: y as f32 + 0.5, inside: true })
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let usage = "usage: eval_circle SCENE SPLATS.ply [--size N] [--photo NAME]... [--oracle true] [--SETTING VALUE]...";
    let (folder, splats) =
        (PathBuf::from(args.next().ok_or(usage)?), PathBuf::from(args.next().ok_or(usage)?));
    let (mut size, mut oracle, mut names) = (320, false, Vec::new());
    let mut settings = SegmentSettings::default();
    let mut vision = VisionSettings::default();
    while let Some(flag) = args.next() {
        let name = flag.trim_start_matches("--").replace('-', "_");
        let value = args.next().ok_or_else(|| format!("{flag} needs a value"))?;
        match name.as_str() {
            "size" => size = value.parse()?,
            "photo" => names.push(value),
            "oracle" => oracle = value == "true",
            _ if vision.get(&name).is_some() => vision.set(&name, &value)?,
            _ => settings.set(&name, &value)?,
        }
    }
    let scene = Scene::open(&folder, &SceneSettings { size, ..SceneSettings::default() })?;
    let splats = ply::read(&splats)?;
    let mut photos = Vec::new();
    let mut views = Vec::new();
    let mut truths = Vec::new();
    for view in &scene.views {
        let photo = view.load(size)?;
        let stem = PathBuf::from(&view.name).with_extension("png");
        let truth = Mask::read_png(&folder.join("truth").join(stem))?;
        truths.push(truth.resized(photo.camera.width, photo.camera.height));
        views.push(PosedView { name: view.name.clone(), camera: photo.camera, pose: view.pose });
        photos.push(photo.image);
    }
    let providers = Providers::from_settings(&vision)?;
    let segmenter: &dyn PromptSegmenter = &*providers.segmenter;
    let (engine, options) = (CpuEngine::new(), ProjectOptions::default());
    let graph = NeighbourGraph::new(&splats, settings.neighbours);
    let references: Vec<usize> = if names.is_empty() {
        (0..scene.views.len()).step_by(scene.views.len().div_ceil(6)).collect()
    } else {
        names.iter().filter_map(|n| scene.view_named(n)).collect()
    };
    println!("{} splats, {} photos", splats.len(), views.len());
    for first in references {
        let started = std::time::Instant::now();
        let points: Vec<PointPrompt> = [click(&truths[first], 0.0, 0.6), click(&truths[first], 0.6, 1.0)]
            .into_iter()
            .flatten()
            .collect();
        let prompts = Prompts { points: points.clone(), ..Prompts::default() };
        let mask = match oracle {
            true => truths[first].clone(),
            false => segmenter.segment(&photos[first], &prompts)?.mask,
        };
        let prompted = [PromptedView {
            view: first,
            mask: &mask,
            open: None,
            points: &points,
            refused: false,
            boxes: &[],
        }];
        let request = Request {
            rasterizer: &engine,
            backend: &engine,
            options,
            splats: &splats,
            views: &views,
            prompts: &prompted,
            prior: None,
            features: None,
            hits: None,
            graph: Some(&graph),
            affinities: None,
            frozen: None,
            shown: None,
            seen_once: None,
            skies: None,
            transients: None,
            steps: None,
            settings: &settings,
        };
        let refine = |view: usize, certainty: &Image| {
            let refined = segmenter.refine(&photos[view], certainty).ok()?;
            Some((refined.mask, refined.predicted_iou.clamp(0.0, 1.0)))
        };
        let selection = match select(&request, Some(&refine)) {
            Ok(selection) => selection,
            Err(error) => {
                println!("{}: {error}", views[first].name);
                continue;
            }
        };
        let edit = cut(&request, &selection)?;
        let (after, labels) = cut_scene(&splats, &selection.labels, &edit);
        let (mut ious, mut before, mut lines) = (Vec::new(), Vec::new(), Vec::new());
        for v in (0..views.len()).filter(|v| *v != first) {
            let (camera, pose) = (&views[v].camera, &views[v].pose);
            let iou = visible_mask(&engine, &after, &labels, &options, camera, pose)?.iou(&truths[v]);
            before.push(
                visible_mask(&engine, &splats, &selection.labels, &options, camera, pose)?.iou(&truths[v]),
            );
            ious.push(iou);
            let visit = selection.visits.iter().find(|x| x.view == v);
            let refined = visit.and_then(|x| x.mask.as_ref()).map(|m| m.iou(&truths[v]));
            let agreement = visit.map_or(0.0, |x| x.agreement);
            lines.push(format!(
                "    {:50} IoU {iou:.3}  refined {}  agreement {agreement:.2} {:?}",
                views[v].name,
                refined.map_or("  -  ".into(), |r| format!("{r:.3}")),
                visit.map_or(PhotoVerdict::NotVisible, |x| x.verdict),
            ));
        }
        let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
        println!(
            "{}: mean IoU {:.3} (uncut {:.3}), prompted mask {:.3}, {} splats, {} cut, {} dropped, {:.1} s",
            views[first].name,
            mean(&ious),
            mean(&before),
            mask.iou(&truths[first]),
            selection.labels.iter().filter(|l| **l).count(),
            edit.changed.len(),
            edit.dropped.len(),
            started.elapsed().as_secs_f64()
        );
        lines.iter().for_each(|line| println!("{line}"));
    }
    Ok(())
}
