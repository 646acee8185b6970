//! `report.html`: one self-contained page with all that a run did.

use super::html::{self, ChartSeries};
use super::objects;
use super::shown::{SHOWN, pass, small_photo, spread};
use crate::artifacts::auto_choice::AutoChoice;
use crate::artifacts::folder::Loaded;
use crate::artifacts::history::{self, Moment};
use crate::artifacts::images::ImageFiles;
use crate::artifacts::seams;
use crate::output::cover::cover;
use crate::output::evaluate::{HeldOut, HeldOutScore, held_out_render};
use crate::output::render::{RenderContent, SceneRenderer};
use crate::transients::{self, TrainFit};
use crate::{AppearanceChoice, BudgetChoice, ObjectList, RunError, RunFolder, choose_engine, log_loss};
use segwild_flow::codec::Decode;
use segwild_flow::ledger::State;
use segwild_flow::{Cache, Key, Ledger, SpanKind, TimelineRecord};
use segwild_objective::AnyAppearance;
use segwild_raster::Rasterizer;
use segwild_scene::{Image, Mask, MaskSet, Skipped};
use segwild_trainer::{RefinedBy, TimeChoice};
use std::collections::BTreeMap;
use std::fmt::Write as _;

/// Writes the report from the run folder. It is called at the end of a run; a selection is only added to the report.
/// Returns the photos that are not shown whole, and why.
///
/// # Errors
/// When the run is not trained yet, or a file cannot be read or written.
pub fn write_report(folder: &RunFolder) -> Result<Vec<Skipped>, RunError> {
    let loaded = folder.load()?;
    let engine = choose_engine(&loaded.settings.run, log_loss)?.engine;
    let mut body = lead(folder, &loaded)?;
    let (rows, left_out) = photos(folder, &loaded, &*engine)?;
    body.push_str(&rows);
    body.push_str(&objects::all(folder, &loaded, &*engine)?);
    body.push_str(&objects::list(folder));
    match appearances(&loaded, &*engine) {
        Ok(appearances) => body.push_str(&appearances),
        Err(error) => {
            body.push_str(&format!("<p>Appearances are not shown: {}</p>", html::escape(&error.to_string())))
        }
    }
    body.push_str(&figures(folder, &loaded)?);
    body.push_str(&fits(folder, &loaded));
    body.push_str(&curves(folder));
    body.push_str(&stages(folder));
    body.push_str(&skipped(folder)?);
    let settings = segwild_flow::files::read_plain(&folder.settings_file()).unwrap_or_default();
    let settings = String::from_utf8_lossy(&settings);
    let _ = write!(
        body,
        "<h2>Settings</h2><details><summary>segwild.toml</summary><pre>{}</pre></details>",
        html::escape(&settings)
    );
    let title = folder.path().file_name().map_or("run".into(), |n| n.to_string_lossy().into_owned());
    folder.write("report.html", html::page(&format!("segwild: {title}"), &body).as_bytes())?;
    Ok(left_out)
}

/// What the images below are of, and which provider made the masks.
fn lead(folder: &RunFolder, loaded: &Loaded) -> Result<String, RunError> {
    let intake = folder.intake()?;
    let by = match intake.provider.as_str() {
        "" => String::new(),
        provider => format!(" Masks and clicks by {}.", html::escape(provider)),
    };
    Ok(format!("<p>{} photos became {} splats.{by}</p>", intake.photos.len(), loaded.model.splats.len()))
}

/// The figures of the run: what it was made of, and the scores of photos that were held out.
fn figures(folder: &RunFolder, loaded: &Loaded) -> Result<String, RunError> {
    let intake = folder.intake()?;
    let mut rows = vec![vec!["what".to_owned(), "how much".to_owned()]];
    let mut row = |name: &str, value: String| rows.push(vec![name.to_owned(), value]);
    row("scene", intake.scene.display().to_string());
    row(
        "photos",
        format!(
            "{} ({} held out, {} skipped)",
            intake.photos.len(),
            intake.held_out.len(),
            intake.skipped.len()
        ),
    );
    if intake.undescribed > 0 && !made(folder, "masks")?.is_empty() {
        let trained = loaded.model.trained_on.len();
        let described = trained.saturating_sub(intake.undescribed);
        let of = format!("{described} of {trained} photos, those that show most from most directions");
        row("masks and descriptors of", of);
    }
    row("points", intake.points.to_string());
    if !intake.provider.is_empty() {
        row("masks and clicks by", intake.provider.clone());
    }
    row("splats", loaded.model.splats.len().to_string());
    row("steps", loaded.model.stats.step.to_string());
    // A choice in the folder may be of an earlier run: it counts only where the settings leave the model open.
    let chosen = folder
        .read_json::<AppearanceChoice>(AppearanceChoice::FILE)
        .ok()
        .filter(|_| AppearanceChoice::is_open(&loaded.settings));
    row(
        "appearance model",
        chosen.map_or_else(
            || loaded.model.appearance.as_appearance().name().to_owned(),
            |c| format!("chosen {}", c.why),
        ),
    );
    let spent = folder
        .read_json::<BudgetChoice>(BudgetChoice::FILE)
        .ok()
        .filter(|_| BudgetChoice::is_open(&loaded.settings));
    if let Some(spent) = spent {
        row("budget", format!("chosen {}", spent.why));
    }
    let bought = folder
        .read_json::<TimeChoice>(TimeChoice::FILE)
        .ok()
        .filter(|_| TimeChoice::is_open(&loaded.settings));
    if let Some(bought) = bought {
        row("time", bought.why);
    }
    if let Some(fit) = TrainFit::of(folder) {
        row("training photos", fit.in_words());
    }
    if let Some(check) = seams::of(folder) {
        row("blocks", check.in_words());
    }
    if let Some(field) = &loaded.field {
        let kept = 100.0 * field.pca.explained_variance();
        row("features", format!("{} channels, {kept:.1} % of the embedding's variance", field.channels()));
    }
    let mut text = format!("<h2>Figures</h2>{}", html::table(&rows));
    if let Ok(held) = folder.read_json::<HeldOut>("evaluation.json")
        && !intake.held_out.is_empty()
    {
        let _ = write!(text, "<h2>Held-out photos</h2><p>{}</p>", html::escape(&held.protocol));
        let head = [
            "photo",
            "PSNR (dB)",
            "SSIM",
            "PSNR without what contradicts the scene (dB)",
            "share of that (%)",
        ];
        let mut rows = vec![head.map(str::to_owned).to_vec()];
        let row = |name: &str, psnr: f32, ssim: f32, kept: f32, left_out: f32| {
            let share = format!("{:.1}", 100.0 * left_out);
            vec![name.to_owned(), format!("{psnr:.2}"), format!("{ssim:.3}"), format!("{kept:.2}"), share]
        };
        rows.extend(held.photos.iter().map(|p| row(&p.photo, p.psnr, p.ssim, p.kept_psnr, p.left_out)));
        rows.push(row("mean", held.psnr, held.ssim, held.kept_psnr, held.left_out));
        // A column of its own, where there are weights of it.
        if let Some((name, mean)) = held.named_lpips() {
            let cell = |lpips: Option<f32>| lpips.map_or("-".to_owned(), |lpips| format!("{lpips:.3}"));
            let scores = held.photos.iter().map(|p| cell(p.lpips)).chain([cell(Some(mean))]);
            for (row, score) in rows.iter_mut().zip([name].into_iter().chain(scores)) {
                row.insert(3, score);
            }
        }
        text.push_str(&html::table(&rows));
        for score in held.photos.iter().take(loaded.settings.run.report_photos as usize) {
            text.push_str(&held_out_beside_render(folder, loaded, score));
        }
    }
    Ok(text)
}

/// How the scene fits each photo that it was trained on, what of it was taken for transients, and why; those with most
/// transients first.
fn fits(folder: &RunFolder, loaded: &Loaded) -> String {
    let by_mask = TrainFit::by_mask(folder);
    let model = &loaded.model;
    let names: Vec<&str> = loaded.scene.views.iter().map(|v| v.name.as_str()).collect();
    let files = ImageFiles::of(names.iter().copied());
    let fit = |view: usize| by_mask.get(files.name(view)).map(|fit| (view, *fit));
    let mut fits: Vec<_> = (0..names.len()).filter_map(fit).collect();
    if fits.is_empty() {
        return String::new();
    }
    fits.sort_by(|a, b| b.1.transient.total_cmp(&a.1.transient).then(a.0.cmp(&b.0)));
    let head = [
        "photo",
        "PSNR over every pixel but the sky (dB)",
        "taken for transients (%)",
        "why",
        "pixels of what it alone shows (%)",
        "pose",
    ];
    let mut rows = vec![head.map(str::to_owned).to_vec()];
    let seen_once = ObjectList::read(folder).and_then(|list| list.seen_once);
    for (view, fit) in fits {
        let evidence = model.transient_evidence[view].map_or_else(
            || "no training was made without this photo".to_owned(),
            |share| format!("{:.1} % contradicts trainings made without this photo", 100.0 * share),
        );
        let why = match model.transient_shares[view] {
            0.0 => format!("photos of one light, no transients: {evidence}"),
            _ => format!("transients are possible: {evidence}"),
        };
        let (psnr, share) = (format!("{:.2}", fit.psnr), format!("{:.1}", 100.0 * fit.transient));
        let pose = model.refined_poses[view].map_or_else(
            || "as given".to_owned(),
            |refined| {
                let by = match refined.by {
                    RefinedBy::Points => "by its points",
                    RefinedBy::Photo => "by aligning it to the scene",
                };
                format!("refined {by}: {:.2} % of its long side", 100.0 * refined.motion)
            },
        );
        let alone = seen_once.as_ref().and_then(|once| once.photos.get(names[view]));
        let alone = alone.map_or_else(|| "-".to_owned(), |share| format!("{:.1}", 100.0 * *share));
        rows.push(vec![names[view].to_owned(), psnr, share, why, alone, pose]);
    }
    format!(
        "<h2>Photos trained on</h2><details><summary>{} photos, those with most transients first</summary>{}</details>",
        rows.len() - 1,
        html::table(&rows)
    )
}

/// A held-out photo beside its render; nothing where one of the two cannot be read.
fn held_out_beside_render(folder: &RunFolder, loaded: &Loaded, score: &HeldOutScore) -> String {
    let view = loaded.scene.views.iter().position(|v| v.name == score.photo);
    let photo = view.and_then(|view| small_photo(loaded, view).ok());
    let render = held_out_render(folder, &score.photo).ok().and_then(|file| Image::read(&file).ok());
    let (Some(photo), Some(render)) = (photo, render) else { return String::new() };
    let (w, h) = (photo.image.width, photo.image.height);
    format!(
        "<div class=\"row\">{}{}</div>",
        html::figure(&photo.image, &format!("{} (held out)", score.photo)),
        html::figure(&render.resized(w, h), &format!("render, {:.2} dB", score.psnr))
    )
}

/// Number of appearances that one view is shown with.
const APPEARANCES: usize = 6;

/// One view with the appearances of several photos, from the darkest to the brightest; nothing where all photos share
/// one.
fn appearances(loaded: &Loaded, engine: &dyn Rasterizer) -> Result<String, RunError> {
    let model = &loaded.model;
    if matches!(model.appearance, AnyAppearance::None(_)) {
        return Ok(String::new());
    }
    let known = (0..model.names.len()).filter(|&v| model.appearance_index(Some(v)) == v);
    let small =
        |view: usize| loaded.scene.views[view].camera.scaled_to(loaded.settings.scene.size.min(SHOWN));
    let renderer = SceneRenderer::new(loaded, None, RenderContent::Colour, engine)?;
    let render = |view: usize, appearance: Option<usize>, side: u32| {
        let camera = small(view).scaled_to(side);
        renderer.render(engine, &camera, &loaded.scene.views[view].pose, &renderer.light(appearance))
    };
    // The view that the scene covers most.
    let Some(first) = known.clone().next() else { return Ok(String::new()) };
    let covered = |view: usize| -> Result<f32, RunError> {
        let camera = small(view).scaled_to(48);
        let projected =
            engine.project(&model.splats, &camera, &loaded.scene.views[view].pose, &model.options())?;
        let alpha = cover(&*projected)?;
        Ok(alpha.data.iter().sum::<f32>() / alpha.pixels() as f32)
    };
    let mut view = (first, 0.0);
    for v in known.clone() {
        let share = covered(v)?;
        if share > view.1 {
            view = (v, share);
        }
    }
    let view = view.0;
    let mut by_light = Vec::new();
    for appearance in known {
        let image = render(view, Some(appearance), 48)?;
        by_light.push((image.data.iter().sum::<f32>(), appearance));
    }
    by_light.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let count = APPEARANCES.min(by_light.len());
    let mut text = format!(
        "<h2>Appearances</h2><p>{} under the appearances of other photos, darkest first. <code>segwild render --photo PHOTO --appearance \
         OTHER</code> renders more of them, <code>segwild bake</code> writes one into a <code>.ply</code>.</p><div class=\"row\">",
        html::escape(&loaded.scene.views[view].name)
    );
    let side = small(view).width.max(small(view).height);
    for k in 0..count {
        let appearance = by_light[k * (by_light.len() - 1) / (count - 1).max(1)].1;
        text.push_str(&html::figure(&render(view, Some(appearance), side)?, &model.names[appearance]));
    }
    text.push_str("</div>");
    Ok(text)
}

/// Per photo, the key of what a stage has made of it.
fn made(folder: &RunFolder, stage: &'static str) -> Result<BTreeMap<String, Key>, RunError> {
    let ledger = Ledger::open_read_only(folder.ledger())?;
    let done = ledger.views(stage)?.into_iter().filter(|row| row.outcome.state == State::Done);
    Ok(done.filter_map(|row| Some((row.view, Key::parse(stage, &row.key)?))).collect())
}

/// Reads what the run has made of a photo. If it cannot be read, `missing` gets the reason.
fn kept<T: Decode>(cache: &Cache, key: Option<&Key>, kind: &str, missing: &mut Option<String>) -> Option<T> {
    match cache.get_typed(key?, kind) {
        Ok(Some(value)) => return Some(value),
        Ok(None) => {
            *missing = Some(format!("its {kind} record has gone or is damaged: the next run makes it again"))
        }
        Err(error) => *missing = Some(error.to_string()),
    }
    None
}

/// A row per photo: the photo, renders and masks. Returns also the photos that are not shown whole, and why.
fn photos(
    folder: &RunFolder,
    loaded: &Loaded,
    engine: &dyn Rasterizer,
) -> Result<(String, Vec<Skipped>), RunError> {
    let cache = folder.cache()?;
    let (masks, skies) = (made(folder, "masks")?, made(folder, "sky")?);
    let mut text = String::from("<h2>Photos</h2>");
    let colour = SceneRenderer::new(loaded, None, RenderContent::Colour, engine)?;
    let depth = SceneRenderer::new(loaded, None, RenderContent::Depth, engine)?;
    let features = match &loaded.field {
        Some(_) => Some(SceneRenderer::new(loaded, None, RenderContent::Features, engine)?),
        None => None,
    };
    let row = |view: usize| -> Result<(String, Option<String>), RunError> {
        let v = &loaded.scene.views[view];
        let (mut text, mut missing) = (String::new(), None);
        let photo = small_photo(loaded, view)?;
        let camera = photo.camera;
        let held = if v.test { " (held out)" } else { "" };
        pass(folder)?;
        text.push_str("<div class=\"row\">");
        text.push_str(&html::figure(&photo.image, &format!("{}{held}", v.name)));
        text.push_str(&html::figure(
            &colour.render(engine, &camera, &v.pose, &colour.light(Some(view)))?,
            "render, own appearance",
        ));
        text.push_str(&html::figure(
            &colour.render(engine, &camera, &v.pose, &colour.light(None))?,
            "render, the scene's appearance",
        ));
        text.push_str(&html::figure(&depth.render(engine, &camera, &v.pose, &depth.light(None))?, "depth"));
        if let Some(features) = &features {
            text.push_str(&html::figure(
                &features.render(engine, &camera, &v.pose, &features.light(None))?,
                "features",
            ));
        }
        if let Some(set) = kept::<MaskSet>(&cache, masks.get(&v.name), "masks", &mut missing) {
            text.push_str(&html::figure(&mask_overlay(&set), &format!("{} masks", set.masks.len())));
        }
        if let Some(sky) = kept::<Mask>(&cache, skies.get(&v.name), "sky", &mut missing)
            && !sky.is_empty()
        {
            let mut overlay = photo.image.clone();
            let sky = sky.resized(camera.width, camera.height);
            let n = overlay.pixels();
            for (x, y) in sky.pixels() {
                let i = (y * camera.width + x) as usize;
                overlay.data[i] *= 0.4;
                overlay.data[n + i] *= 0.4;
                overlay.data[2 * n + i] = 0.6 + 0.4 * overlay.data[2 * n + i];
            }
            text.push_str(&html::figure(&overlay, "sky"));
        }
        if let Some(transients) = transients_overlay(folder, loaded, view, &photo.image) {
            text.push_str(&html::figure(&transients, "transients, left out"));
        }
        text.push_str("</div>");
        Ok((text, missing))
    };
    let mut left_out = Vec::new();
    for view in spread(loaded, loaded.settings.run.report_photos as usize) {
        // A second try gets past a passing fault.
        match row(view).or_else(|_| row(view)) {
            Ok((images, missing)) => {
                text.push_str(&images);
                let name = loaded.scene.views[view].name.clone();
                left_out.extend(missing.map(|reason| Skipped { name, reason }));
            }
            Err(error) => {
                let (name, reason) = (loaded.scene.views[view].name.clone(), error.to_string());
                let _ = write!(
                    text,
                    "<p>{} could not be rendered: {}</p>",
                    html::escape(&name),
                    html::escape(&reason)
                );
                left_out.push(Skipped { name, reason });
            }
        }
    }
    Ok((text, left_out))
}

/// A photo with its transients in red; `None` where it has none, or no mask image.
fn transients_overlay(folder: &RunFolder, loaded: &Loaded, view: usize, photo: &Image) -> Option<Image> {
    let mask = transients::of_run(folder, &loaded.scene)(view).filter(|mask| !mask.is_empty())?;
    let mask = mask.resized(photo.width as u32, photo.height as u32);
    let (mut overlay, n) = (photo.clone(), photo.pixels());
    for (x, y) in mask.pixels() {
        let i = y as usize * photo.width + x as usize;
        overlay.data[i] = 0.6 + 0.4 * overlay.data[i];
        overlay.data[n + i] *= 0.4;
        overlay.data[2 * n + i] *= 0.4;
    }
    Some(overlay)
}

/// Masks in different colours, small ones over large ones.
fn mask_overlay(set: &MaskSet) -> Image {
    let mut order: Vec<usize> = (0..set.masks.len()).collect();
    order.sort_by_key(|&k| std::cmp::Reverse(set.masks[k].mask.count()));
    let mut image = Image::filled(set.width as usize, set.height as usize, 3, 0.12);
    let n = image.pixels();
    for (rank, &k) in order.iter().enumerate() {
        // Steps of the golden angle give neighbours in size colours far apart.
        let hue = (rank as f32 * 0.618_034).fract() * std::f32::consts::TAU;
        for (x, y) in set.masks[k].mask.pixels() {
            let i = y as usize * image.width + x as usize;
            for c in 0..3 {
                image.data[c * n + i] = 0.55 + 0.4 * (hue + c as f32 * std::f32::consts::TAU / 3.0).cos();
            }
        }
    }
    image
}

fn curves(folder: &RunFolder) -> String {
    let moments = history::read(folder);
    let line = |name: &str, pick: fn(&Moment) -> f64| ChartSeries {
        name: name.to_owned(),
        points: moments.iter().map(|m| (f64::from(m.step), pick(m))).collect(),
    };
    let mut text = String::from("<h2>Training</h2>");
    text.push_str(&html::chart("loss", "step", "", &[line("loss", |m| m.loss.into())]));
    text.push_str(&html::chart(
        "PSNR on the photo of the step",
        "step",
        "dB",
        &[line("PSNR", |m| m.psnr.into())],
    ));
    text.push_str(&html::chart("splats", "step", "", &[line("splats", |m| m.splats as f64)]));
    text.push_str(&html::chart(
        "left out as transient",
        "step",
        "share",
        &[line("share", |m| m.left_out.into())],
    ));
    text
}

/// Timings per stage from the ledger, and the timeline of the actors.
fn stages(folder: &RunFolder) -> String {
    let mut text = String::from("<h2>Stages</h2>");
    if let Ok(ledger) = Ledger::open_read_only(folder.ledger())
        && let Ok(stages) = ledger.stages()
    {
        let mut rows = vec![vec![
            "stage".to_owned(),
            "state".into(),
            "seconds".into(),
            "views made".into(),
            "started".into(),
        ]];
        for s in stages {
            let seconds = s.started.zip(s.ended).map_or("-".to_owned(), |(a, b)| format!("{:.1}", b - a));
            let made =
                ledger.views(&s.name).map_or(0, |v| v.iter().filter(|v| v.outcome.seconds.is_some()).count());
            let state = serde_json::to_string(&s.state).unwrap_or_default().replace('"', "");
            // The report is written while its own row is still open.
            if s.name == "report" {
                continue;
            }
            rows.push(vec![s.name, state, seconds, made.to_string(), format!("{} x", s.runs)]);
        }
        text.push_str(&html::table(&rows));
    }
    if let Ok(report) = folder.read_json::<Recorded>("timeline.json") {
        text.push_str(&timeline(report));
    }
    text
}

/// What the report needs of `timeline.json`, which may be long.
#[derive(serde::Deserialize)]
struct Recorded {
    actors: Vec<RecordedActor>,
    timeline: TimelineRecord,
}

#[derive(serde::Deserialize)]
struct RecordedActor {
    name: String,
    busy_s: f64,
    waiting_s: f64,
    blocked_s: f64,
    messages: u64,
}

fn timeline(report: Recorded) -> String {
    let mut rows = vec![vec![
        "actor".to_owned(),
        "busy (s)".into(),
        "waiting (s)".into(),
        "blocked (s)".into(),
        "messages".into(),
    ]];
    for actor in report.actors {
        let seconds = |s: f64| format!("{s:.1}");
        rows.push(vec![
            actor.name,
            seconds(actor.busy_s),
            seconds(actor.waiting_s),
            seconds(actor.blocked_s),
            actor.messages.to_string(),
        ]);
    }
    let spans: Vec<html::Bar> = report
        .timeline
        .spans
        .into_iter()
        .filter(|s| matches!(s.kind, SpanKind::Busy | SpanKind::Blocked))
        .map(|s| html::Bar {
            row: s.actor,
            label: s.label,
            start: s.start,
            end: s.end,
            waits: s.kind == SpanKind::Blocked,
        })
        .collect();
    format!(
        "<h2>Who did what when</h2><p>Coloured: working. Grey: held back by another, named under the pointer. Empty: \
         waiting for input. <code>trace.json</code> shows the same in Perfetto.</p>{}{}",
        html::timeline(&spans),
        html::table(&rows)
    )
}

fn skipped(folder: &RunFolder) -> Result<String, RunError> {
    let intake = folder.intake()?;
    if intake.skipped.is_empty() {
        return Ok("<h2>Skipped photos</h2><p>None.</p>".into());
    }
    let mut rows = vec![vec!["photo".to_owned(), "why".to_owned()]];
    rows.extend(intake.skipped.into_iter().map(|s| vec![s.name, s.reason]));
    Ok(format!("<h2>Skipped photos</h2>{}", html::table(&rows)))
}
