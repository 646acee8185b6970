//! From clicks in a photo to an object in 3D, written in formats that other tools open.

use crate::accelerator::leased;
use crate::code::{self, Code};
use crate::folder::Loaded;
use crate::images::ImageFiles;
use crate::intact::{self, Intact};
use crate::light::{self, find};
use crate::object_masks::ObjectMasks;
use crate::objects::TreeSource;
use crate::prompts::check_all;
use crate::settings::AT_ONCE;
use crate::{
    PhotoPrompts, Replay, RunError, RunFolder, choose_engine, log_loss, report, skies, traces, transients,
};
use rayon::prelude::*;
use segwild_flow::{
    ActorOptions, FileError, Ledger, Limits, Phase, Stopper, System, SystemOptions, codec, fault, files,
    mailbox,
};
use segwild_scene::ply::Export;
use segwild_scene::{Image, Mask, Scene, ScoredMask, Splats, View};
use segwild_segmenter::{
    Alternative, FirstAnswer, MaskMode, PhotoVerdict, PosedView, SegmentActor, SegmentError, SegmentReply,
    SegmentSettings, SegmentTask, Segmented, SelectedObject, SpikeCut, SplatGeometry,
};
use segwild_vision::Providers;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use wincode::{SchemaRead, SchemaWrite};

/// Kind of the record in `selection.bin`.
const SELECTION: &str = "selection";

/// `selection.bin`: a selection that can be rendered again.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Selected {
    /// Per splat of the scene, whether it belongs to the object, after the cut.
    pub labels: Vec<bool>,
    /// Splats that the cut changes, and what they become.
    pub changed: Vec<Shortened>,
}

/// A splat after the spike cut.
#[derive(Clone, Copy, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct Shortened {
    /// Which splat of the scene.
    pub splat: u32,
    /// Its centre.
    pub mean: [f32; 3],
    /// Logarithms of its standard deviations.
    pub log_scales: [f32; 3],
    /// Its rotation (w, x, y, z).
    pub rotation: [f32; 4],
}

impl Selected {
    fn new(labels: &[bool], cut: &SpikeCut) -> Selected {
        let mut labels = labels.to_vec();
        cut.trim(&mut labels);
        let after = |&(splat, _, SplatGeometry { mean, log_scales, rotation }): &(
            u32,
            SplatGeometry,
            SplatGeometry,
        )| { Shortened { splat, mean, log_scales, rotation } };
        Selected { labels, changed: cut.changed.iter().map(after).collect() }
    }

    /// Refuses a record that no cut can have written: it may come from another program.
    fn check(&self) -> Result<(), String> {
        let n = self.labels.len();
        let sound = |s: &Shortened| {
            let numbers = || s.mean.iter().chain(&s.log_scales).chain(&s.rotation);
            (s.splat as usize) < n && numbers().all(|x| x.is_finite())
        };
        match self.changed.iter().find(|s| !sound(s)) {
            _ if self.changed.len() > n => {
                Err(format!("it is damaged: {} splats of {n} are shortened", self.changed.len()))
            }
            Some(s) => Err(format!("it is damaged: the shape of splat {} of {n} is none", s.splat)),
            None => Ok(()),
        }
    }

    /// The scene with the cut applied.
    pub fn cut_scene(&self, splats: &Splats) -> Splats {
        let mut splats = splats.clone();
        for s in &self.changed {
            let i = s.splat as usize;
            (splats.means[i], splats.log_scales[i], splats.rotations[i]) = (s.mean, s.log_scales, s.rotation);
        }
        splats
    }

    /// Reads a run's selection by name. `splats` is the number of splats of the trained scene.
    ///
    /// # Errors
    /// When there is no such selection, it is damaged, or the scene has been trained again since.
    pub fn read(folder: &RunFolder, name: &str, splats: usize) -> Result<Selected, RunError> {
        folder.has_selection(name)?;
        let path = folder.selection(name);
        Intact::of(folder, name)?.check(&path.join("selection.bin"))?;
        let selected: Selected =
            folder.read_record(&format!("selections/{name}/selection.bin"), SELECTION)?;
        if selected.labels.len() != splats {
            let reason =
                "the scene has been trained again since; segment again (`--prompts` replays the clicks)";
            return Err(RunError::Folder { path, reason: reason.into() });
        }
        selected.check().map_err(|reason| RunError::Folder { path: path.join("selection.bin"), reason })?;
        Ok(selected)
    }
}

/// The result of `segment`.
#[derive(Clone, Debug, Serialize)]
pub struct SegmentOutcome {
    /// The selection's folder.
    pub folder: PathBuf,
    /// The provider of the masks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// Splats of the object.
    pub splats: usize,
    /// Splats shortened by the spike cut.
    pub cut: usize,
    /// Splats dropped by it.
    pub dropped: usize,
    /// Splats of something else that reached into the object: the piece inside is now part of it.
    pub joined: usize,
    /// Photos on which the object shows.
    pub photos: usize,
    /// Photos whose own boundaries took part.
    pub agreeing: usize,
    /// Photos whose own boundaries disagreed with the selection.
    pub disagreeing: usize,
    /// IoU of the selection with the masks of the prompts, in the prompted photos.
    pub agreement: f32,
    /// Whether only the prompted photos decided, because the others would have moved the selection to something else.
    pub alone: bool,
    /// What the prompts may mean; the setting `alternative` selects one. Empty where the scene tree took no part.
    pub alternatives: Vec<Alternative>,
    /// Warnings about the prompts and the selection, a sentence each.
    pub notes: Vec<String>,
    /// Seconds from the prompts to the selection, the scene being loaded.
    pub select_s: f64,
    /// Seconds in all.
    pub wall_s: f64,
}

/// Refuses a name that cannot be the name of a folder and of files. Checked before anything is computed.
fn check_name(name: &str) -> Result<(), RunError> {
    let odd = |c: char| !(c.is_ascii_alphanumeric() || "-_.".contains(c));
    let wrong = match files::name::usable(name) {
        Err(why) => why,
        Ok(()) if name.contains(odd) => "it has other signs",
        Ok(()) => return Ok(()),
    };
    // The name may be of any length.
    let start: String = name.chars().take(60).collect();
    let more = if start.len() < name.len() { ".." } else { "" };
    let start = files::name::one_line(&start);
    Err(RunError::Request(format!(
        "`{start}{more}` cannot name a selection, for {wrong}: use letters, digits, dashes and underscores"
    )))
}

/// A warning needs more disagreeing photos than this.
const OPPOSED: usize = 4;
/// Agreement ([`SegmentOutcome::agreement`]) under which a selection is doubtful.
const FAITHFUL: f32 = 0.5;

impl SegmentOutcome {
    /// Warnings about the selection itself, a sentence each.
    fn selection_warnings(&self) -> Vec<String> {
        let mut words = Vec::new();
        if self.alone {
            words
                .push("the other photos took it for something else: the prompted photos alone decide".into());
        } else if self.agreement < FAITHFUL {
            words.push(format!(
                "of what the prompts mean and what was selected in the prompted photos, only {:.0} % is both: look at \
                 prompted/ and masks/, and click once more where they differ",
                100.0 * self.agreement
            ));
        }
        if self.disagreeing > OPPOSED.max(self.agreeing) {
            words.push(format!(
                "{} photos disagree with the selection and {} agree: their masks, or the camera poses, do not fit",
                self.disagreeing, self.agreeing
            ));
        }
        words
    }
}

/// The key of the training that the run's scene is of; `None` where no ledger names it: clicks do without a tree then.
fn trained_by(folder: &RunFolder) -> Option<String> {
    let stages = Ledger::open_read_only(folder.ledger()).and_then(|ledger| ledger.stages()).ok()?;
    stages.into_iter().find(|stage| stage.name == "geometry").map(|stage| stage.key)
}

/// Selects the object of the prompts and writes it to the run's `selections/NAME`. Without `providers` it uses those of
/// [`crate::providers_for`], with the networks that the environment names.
///
/// # Errors
/// When the name or the prompts cannot be used, nothing is selected, a file cannot be written, or `stopper` stops it.
pub fn segment(
    folder: &RunFolder,
    name: &str,
    prompts: &[PhotoPrompts],
    settings: &SegmentSettings,
    providers: Option<&Providers>,
    stopper: &Stopper,
) -> Result<SegmentOutcome, RunError> {
    let began = Instant::now();
    check_name(name)?;
    let loaded = folder.load()?;
    let Loaded { settings: made_with, scene, model, field } = loaded;
    let size = made_with.scene.size;
    let own;
    let providers = match providers {
        Some(providers) => providers,
        None => {
            own = code::providers_for(folder, &Code::given(&[]))?;
            &own
        }
    };
    let providers = leased(providers);
    let views: Vec<PosedView> = scene
        .views
        .iter()
        .map(|v| PosedView { name: v.name.clone(), camera: v.camera.scaled_to(size), pose: v.pose })
        .collect();
    check_all(prompts)?;
    let files = ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()));
    files.fit(&folder.selection(name))?;
    let mut queries = Vec::new();
    for p in prompts {
        let view = find(&scene, &p.photo)?;
        let (full, small) = (&scene.views[view].camera, &views[view].camera);
        let (sx, sy) = (small.width as f32 / full.width as f32, small.height as f32 / full.height as f32);
        for point in &p.prompts.points {
            if !full.contains(glam::Vec2::new(point.x, point.y)) {
                let (photo, x, y) = (p.photo.clone(), point.x, point.y);
                return Err(SegmentError::OutsideFrame {
                    photo,
                    x,
                    y,
                    width: full.width,
                    height: full.height,
                }
                .into());
            }
        }
        let inner = scene.views[view].prompts_from_taken(&p.prompts).map_err(|[x, y]| {
            RunError::Request(format!(
                "photo {}: ({x}, {y}) lies where the lens bends the photo out of the undistorted one that is worked with; click \
                 nearer to the middle",
                p.photo
            ))
        })?;
        queries.push((view, inner.scaled(sx, sy)));
    }
    if queries.is_empty() {
        return Err(SegmentError::NoPrompt.into());
    }
    // The colours for other programs. Computed first, so that an unknown photo is reported at once.
    let in_colour = light::shown(&scene, &model, &settings.object_appearance)?;
    let engine = choose_engine(&made_with.run, log_loss)?.engine;
    let features = match field {
        Some(field) => {
            let mut features = segwild_segmenter::SplatFeatures::new(field.channels, field.values)?;
            features.bring(&*engine)?;
            Some(Arc::new(features))
        }
        None => None,
    };
    let tree = match trained_by(folder) {
        Some(geometry) if settings.first_answer == FirstAnswer::Tree => {
            let segmenter = &*providers.segmenter;
            let source = TreeSource { scene: &scene, model: &model, geometry: &geometry, size, segmenter };
            source.tree(&folder.cache()?, &|| stopper.phase() != Phase::Running)?.map(Arc::new)
        }
        _ => None,
    };
    let scene = Arc::new(scene);
    let photos = {
        let scene = scene.clone();
        Arc::new(move |view: usize| -> Result<Image, String> {
            Ok(scene.views[view].load(size).map_err(|e| e.to_string())?.image)
        })
    };
    let skies = Arc::new(skies::of_run(folder, &scene, size, providers.sky.clone())?);
    let transients = Arc::new(transients::of_run(folder, &scene));
    let barred: Vec<bool> = scene.views.iter().map(|v| v.test).collect();
    let system = System::new(SystemOptions {
        stopper: stopper.clone(),
        threads: made_with.run.threads as usize,
        ..SystemOptions::default()
    })?;
    let (tasks, inbox) = mailbox::<SegmentTask>("segmenter", Limits::default());
    let (reply, answers) = mailbox::<SegmentReply>("answers", Limits::default());
    let selected_at = Instant::now();
    {
        let (engine, splats, views) =
            (engine.clone(), Arc::new(model.splats.clone()), Arc::new(views.clone()));
        let (options, segmenter, barred) = (model.options(), providers.segmenter.clone(), Arc::new(barred));
        system.spawn(inbox, ActorOptions { attempts: 1, ..ActorOptions::default() }, move || {
            Ok(SegmentActor {
                engine: engine.clone(),
                options,
                splats: splats.clone(),
                views: views.clone(),
                barred: barred.clone(),
                features: features.clone(),
                photos: photos.clone(),
                skies: skies.clone(),
                transients: transients.clone(),
                segmenter: segmenter.clone(),
                tree: tree.clone(),
                graph: None,
            })
        })?;
    }
    let failed = |reason: String| RunError::Stage { stage: "segment", reason };
    tasks
        .blocking_send_urgent(SegmentTask { prompts: queries, settings: settings.clone(), reply })
        .map_err(|e| failed(e.to_string()))?;
    drop(tasks);
    let answer = answers.blocking_recv();
    let report = system.join();
    if stopper.phase() != Phase::Running {
        return Err(RunError::Interrupted);
    }
    traces::of_selection(folder, name, &report)?;
    let Some(SegmentReply(answer)) = answer else {
        let why: Vec<String> = report.failures().map(|(actor, error)| format!("{actor}: {error}")).collect();
        return Err(failed(if why.is_empty() {
            "the segmenter gave no answer".into()
        } else {
            why.join("; ")
        }));
    };
    let segmented = answer.map_err(|e| in_photo_pixels(e, &scene, size))?;
    let select_s = selected_at.elapsed().as_secs_f64();

    // Written aside and then renamed, so that a selection is there as a whole or not at all.
    files::remove_litter(&folder.path().join("selections"));
    let target = folder.selection(name);
    let Segmented { selection, cut, masks, alternatives } = *segmented;
    let selected = Selected::new(&selection.labels, &cut);
    let object = SelectedObject::new(&in_colour, &selection.labels, &cut);
    let count = |verdict: PhotoVerdict| selection.visits.iter().filter(|v| v.verdict == verdict).count();
    let mut outcome = SegmentOutcome {
        folder: target.clone(),
        provider: providers.name.clone(),
        splats: object.splats.len(),
        cut: cut.changed.len() - cut.joined.len(),
        dropped: cut.dropped.len(),
        joined: cut.joined.len(),
        photos: 0,
        agreement: selection.agreement,
        alone: selection.alone,
        alternatives,
        notes: prompt_warnings(folder, &scene, prompts, &masks),
        agreeing: count(PhotoVerdict::Accepted),
        disagreeing: count(PhotoVerdict::Disagrees),
        select_s,
        wall_s: 0.0,
    };
    outcome.notes.extend(outcome.selection_warnings());
    outcome.notes.extend(transients::damaged(folder, &scene));
    outcome.notes.extend(code::changes(&code::of_clicks(code::recorded(folder)), &providers.networks));
    files::write_folder(&target, |aside| -> Result<(), RunError> {
        let dir = |sub: &str| -> Result<PathBuf, RunError> {
            let path = aside.join(sub);
            std::fs::create_dir_all(&path).map_err(|e| FileError::new("create", &path, e))?;
            Ok(path)
        };
        let pass = || fault::point("selection.file").map_err(|e| FileError::new("write", &target, e));
        let json = |name: &str, value: serde_json::Result<Vec<u8>>| -> Result<(), RunError> {
            let path = aside.join(name);
            let bytes = value.map_err(|e| RunError::Folder { path: path.clone(), reason: e.to_string() })?;
            Ok(files::write_atomic(&path, &bytes)?)
        };
        let names = files.names();
        let (mask_dir, amodal_dir, prompt_dir) = (dir("masks")?, dir("amodal")?, dir("prompted")?);
        let replay = Replay { prompts: prompts.to_vec(), settings: Some(settings.clone()) };
        json("prompts.json", serde_json::to_vec_pretty(&replay))?;
        let path = aside.join("selection.bin");
        let bytes = codec::encode(SELECTION, &selected)
            .map_err(|source| RunError::Record { path: path.clone(), source })?;
        files::write_atomic(&path, &bytes)?;
        pass()?;
        let export = light::export(&scene, &model);
        export.write(&aside.join("object.ply"), &object.splats)?;
        let labels: Vec<u8> = selected.labels.iter().map(|&l| u8::from(l)).collect();
        let labelled = Export { extra: &[("label", &labels)], ..export };
        labelled.write(&aside.join("labels.ply"), &selected.cut_scene(&in_colour))?;
        pass()?;
        for (view, mask) in &masks {
            let full = &scene.views[*view].camera;
            let mask = mask.mask.resized(full.width, full.height);
            scene.views[*view].mask_to_taken(mask).write_png(&prompt_dir.join(&names[*view]))?;
        }
        let cut_splats = selected.cut_scene(&model.splats);
        let in_sight =
            ObjectMasks::new(&*engine, &cut_splats, &selected.labels, model.options(), MaskMode::Visible)?;
        let keep: Vec<usize> = (0..cut_splats.len()).filter(|&i| selected.labels[i]).collect();
        let alone = cut_splats.select(&keep);
        let whole = vec![true; keep.len()];
        let alone = ObjectMasks::new(&*engine, &alone, &whole, model.options(), MaskMode::Amodal)?;
        // Rendered one after the other, since an engine may be one device; written several at once, since photos are
        // large.
        let views: Vec<(&View, &String)> = scene.views.iter().zip(names).collect();
        for some in views.chunks(rayon::current_num_threads().min(AT_ONCE)) {
            let draw = |(view, _): &(&View, &String)| -> Result<[Image; 2], RunError> {
                let of = |source: &ObjectMasks| source.share(&view.camera, &view.pose, size);
                Ok([of(&in_sight)?, of(&alone)?])
            };
            let shares = some.iter().map(draw).collect::<Result<Vec<_>, _>>()?;
            let write = |((view, name), [visible, amodal]): (&(&View, &String), &[Image; 2])| {
                let visible = view.mask_to_taken(in_sight.mask(visible, &view.camera));
                visible.write_png(&mask_dir.join(name))?;
                let amodal = view.mask_to_taken(alone.mask(amodal, &view.camera));
                amodal.write_png(&amodal_dir.join(name))?;
                Ok(!visible.is_empty())
            };
            let shown = some.par_iter().zip(&shares).map(write).collect::<Result<Vec<bool>, RunError>>()?;
            for shown in shown {
                outcome.photos += usize::from(shown);
                pass()?;
            }
        }
        intact::write_list(aside)?;
        outcome.wall_s = began.elapsed().as_secs_f64();
        json("summary.json", serde_json::to_vec_pretty(&outcome))
    })?;
    report::add_object(folder, name)?;
    Ok(outcome)
}

/// A click closer than this to the edge of its mask, in pixels of the working size, may have been meant for the other
/// side.
const EDGE: f32 = 2.0;
/// The warning needs a mask that is somewhere this many times deeper: on a thin object every click is near the edge.
const DEEPER: f32 = 4.0;

/// Warnings about prompts that did select something: clicks on transients, and clicks at the edge of a mask.
fn prompt_warnings(
    folder: &RunFolder,
    scene: &Scene,
    prompts: &[PhotoPrompts],
    masks: &[(usize, ScoredMask)],
) -> Vec<String> {
    let mut words = Vec::new();
    let transients = transients::of_run(folder, scene);
    for p in prompts {
        let Ok(view) = find(scene, &p.photo) else { continue };
        let camera = &scene.views[view].camera;
        let inside = |mask: &Mask, x: f32, y: f32| {
            let scale = |v: f32, of: u32, to: u32| {
                ((v / of.max(1) as f32 * to as f32) as u32).min(to.saturating_sub(1))
            };
            let (u, v) = (scale(x, camera.width, mask.width()), scale(y, camera.height, mask.height()));
            (mask.get(u, v), (v * mask.width() + u) as usize)
        };
        let transient = transients(view);
        let meant = masks.iter().find(|(v, _)| *v == view).map(|(_, m)| &m.mask);
        let depths = meant.map(|m| m.not().distances());
        let deepest = depths.iter().flatten().copied().fold(0.0, f32::max);
        for point in p.prompts.points.iter().filter(|p| p.inside) {
            let (x, y) = (point.x, point.y);
            let Some([u, v]) = scene.views[view].from_taken([x, y]) else { continue };
            if transient.as_ref().is_some_and(|s| inside(s, u, v).0) {
                words.push(format!(
                    "photo {}: the click at ({x}, {y}) lies on a transient; it may select what the transient \
                     occludes: click in a photo without a transient there",
                    p.photo
                ));
            }
            if let (Some(mask), Some(depths)) = (meant, &depths) {
                let (hit, at) = inside(mask, u, v);
                if !hit || (depths[at] < EDGE && deepest > DEEPER * depths[at]) {
                    words.push(format!(
                        "photo {}: the click at ({x}, {y}) lies at the edge of what it was taken to mean (see prompted/): a click \
                         deeper inside is safer",
                        p.photo
                    ));
                }
            }
        }
    }
    words
}

/// The error with its position in the prompts' coordinates: pixels of the photo as taken, at full size.
fn in_photo_pixels(error: SegmentError, scene: &Scene, size: u32) -> SegmentError {
    let full = |photo: &str, x: f32, y: f32| {
        let Some(view) = scene.views.iter().find(|v| v.name == photo) else { return (x, y) };
        let (camera, small) = (view.camera, view.camera.scaled_to(size));
        let round = |v: f32| (v * 10.0).round() / 10.0;
        let inner =
            [x * camera.width as f32 / small.width as f32, y * camera.height as f32 / small.height as f32];
        let [x, y] = view.to_taken(inner).unwrap_or(inner);
        (round(x), round(y))
    };
    match error {
        SegmentError::EmptySpace { photo, x, y, alpha } => {
            let (x, y) = full(&photo, x, y);
            SegmentError::EmptySpace { photo, x, y, alpha: alpha.abs() }
        }
        SegmentError::Background { photo, x, y } => {
            let (x, y) = full(&photo, x, y);
            SegmentError::Background { photo, x, y }
        }
        other => other,
    }
}
