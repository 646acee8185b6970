//! Renders a trained scene: views of photos or a path through them, with any appearance and with a selection.

use crate::artifacts::folder::Loaded;
use crate::artifacts::images::ImageFiles;
use crate::output::light::{AppearanceRequest, find};
use crate::{RunError, RunFolder, Selected, choose_engine, log_loss};
use glam::{Mat3, Quat, Vec3};
use segwild_features::FeatureColours;
use segwild_raster::{Channels, Kept, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Scene};
use segwild_trainer::{Model, SceneLight, SceneLighting, render_lit};
use serde::Serialize;
use std::path::PathBuf;

/// How a selection is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Tinted, in the scene.
    Highlight,
    /// Alone.
    Only,
    /// The scene without it.
    Without,
    /// In the scene, as it is.
    Scene,
}

/// What a render shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RenderContent {
    /// The scene's colours.
    Colour,
    /// Depth, near bright.
    Depth,
    /// How much of each pixel is covered.
    Alpha,
    /// The feature field's main components as colours.
    Features,
}

/// A request for renders.
#[derive(Clone, Debug)]
pub struct RenderRequest {
    /// Names of the photos whose views are rendered, or through which the path runs; empty: all.
    pub photos: Vec<String>,
    /// Number of renders along a path through the photos; `None`: one per photo.
    pub frames: Option<u32>,
    /// The appearance. Without a photo it is the view's own, and on a path it changes from photo to photo. Several
    /// appearances are interpolated over the frames.
    pub appearance: AppearanceRequest,
    /// Another appearance for the selected object.
    pub object_appearance: Option<AppearanceRequest>,
    /// Where to interpolate, if two or more appearances and no frames are given: 0 is the first, 1 the last.
    pub interpolate: Option<f32>,
    /// A selection and how to render it.
    pub selection: Option<(String, Mode)>,
    /// What the renders show.
    pub what: RenderContent,
    /// Long side in pixels; `None`: as trained.
    pub width: Option<u32>,
    /// The folder for the renders; `None`: `RUN/renders`.
    pub out: Option<PathBuf>,
}

/// A render that was written.
#[derive(Clone, Debug, Serialize)]
pub struct RenderedFile {
    /// The file.
    pub file: PathBuf,
    /// What it shows.
    pub view: String,
}

/// Writes the requested renders.
///
/// # Errors
/// When the run is not trained yet, the request does not fit the run, the engine fails, or a file cannot be written.
pub fn render(folder: &RunFolder, request: &RenderRequest) -> Result<Vec<RenderedFile>, RunError> {
    let loaded = folder.load()?;
    let engine = choose_engine(&loaded.settings.run, log_loss)?.engine;
    let chosen: Vec<usize> = match request.photos.is_empty() {
        true => (0..loaded.scene.views.len()).collect(),
        false => request.photos.iter().map(|n| find(&loaded.scene, n)).collect::<Result<_, _>>()?,
    };
    check_appearances(request)?;
    let selected = match &request.selection {
        Some((name, mode)) => Some((Selected::read(folder, name, loaded.model.splats.len())?, *mode)),
        None => None,
    };
    let size = request.width.unwrap_or(loaded.settings.scene.size);
    let jobs = match request.frames {
        None => chosen.iter().map(|&v| RenderJob::of_view(&loaded.scene, v, size)).collect(),
        // One view, and a sequence of appearances.
        Some(frames) if chosen.len() == 1 => {
            let still = |f| RenderJob {
                name: frame_name(f),
                file: Some(frame_name(f) + ".png"),
                ..RenderJob::of_view(&loaded.scene, chosen[0], size)
            };
            (0..frames).map(still).collect()
        }
        Some(frames) => path(&loaded.scene, &chosen, frames, size),
    };
    let out = request.out.clone().unwrap_or_else(|| folder.path().join("renders"));
    std::fs::create_dir_all(&out).map_err(|e| segwild_flow::FileError::new("create", &out, e))?;
    let renderer = SceneRenderer::new(&loaded, selected, request.what, &*engine)?;
    let held = engine.hold(&renderer.model.splats)?;
    let engine = held.as_deref().unwrap_or(&*engine);
    let mut rendered = Vec::new();
    let lights = request.appearance.lights(&loaded.scene, &renderer.model)?;
    let object_lights = match &request.object_appearance {
        Some(appearance) => Some(appearance.lights(&loaded.scene, &renderer.model)?),
        None => None,
    };
    let last = jobs.len().saturating_sub(1).max(1) as f32;
    let files = ImageFiles::of(loaded.scene.views.iter().map(|v| v.name.as_str()));
    for (f, job) in jobs.into_iter().enumerate() {
        let share = request.frames.map_or(request.interpolate.unwrap_or(0.0), |_| f as f32 / last);
        let light = lights.at(share).unwrap_or_else(|| renderer.own(&job, request.appearance.strength));
        let lighting = renderer.lighting(light, object_lights.as_ref().and_then(|lights| lights.at(share)));
        let image = renderer.render(engine, &job.camera, &job.pose, &lighting)?;
        let file = out.join(job.file.as_deref().unwrap_or_else(|| files.name(job.view)));
        image.write_png(&file)?;
        rendered.push(RenderedFile { file, view: job.name });
    }
    Ok(rendered)
}

/// Refuses appearances that do not fit together or do not fit the request.
fn check_appearances(request: &RenderRequest) -> Result<(), RunError> {
    let appearances = || std::iter::once(&request.appearance).chain(&request.object_appearance);
    let refuse = |text: &str| Err(RunError::Request(text.into()));
    let sequence = appearances().any(|appearance| appearance.photos.len() > 1);
    if request.object_appearance.is_some() && request.selection.is_none() {
        return refuse("an appearance of the object needs --selection NAME");
    }
    if request.object_appearance.as_ref().is_some_and(|appearance| appearance.photos.is_empty()) {
        return refuse("the object's appearance names no photo");
    }
    if sequence && request.frames.is_none() && request.interpolate.is_none() {
        return refuse(
            "two appearances need --frames N, a sequence between them, or --interpolate T, 0 to 1",
        );
    }
    if request.interpolate.is_some()
        && (request.frames.is_some() || appearances().all(AppearanceRequest::is_one))
    {
        return refuse("--interpolate needs two appearances, and no --frames");
    }
    if request.interpolate.is_some_and(|t| !(0.0..=1.0).contains(&t)) {
        return refuse("--interpolate is a share from 0 to 1");
    }
    if request.frames.is_some() && request.photos.len() < 2 && !(request.photos.len() == 1 && sequence) {
        return refuse(
            "a path needs two photos or more: give --photo twice; or one --photo and two appearances to interpolate",
        );
    }
    Ok(())
}

/// One image to render.
struct RenderJob {
    name: String,
    /// The image's file, if it is not that of its photo.
    file: Option<String>,
    camera: Camera,
    pose: Pose,
    /// The view whose appearance it has.
    view: usize,
    /// The view that the path leads to next, and the share of the way to it, 0 to 1.
    towards: (usize, f32),
}

fn frame_name(frame: u32) -> String {
    format!("path-{frame:04}")
}

impl RenderJob {
    fn of_view(scene: &Scene, view: usize, size: u32) -> RenderJob {
        let v = &scene.views[view];
        RenderJob {
            name: v.name.rsplit_once('.').map_or(v.name.as_str(), |(stem, _)| stem).to_owned(),
            file: None,
            camera: v.camera.scaled_to(size),
            pose: v.pose,
            view,
            towards: (view, 0.0),
        }
    }
}

/// A smooth path through the views: centres along a Catmull-Rom spline, rotations slerped, intrinsics of the first
/// with the focal length blended.
fn path(scene: &Scene, through: &[usize], frames: u32, size: u32) -> Vec<RenderJob> {
    let key = |k: isize| &scene.views[through[k.clamp(0, through.len() as isize - 1) as usize]];
    let rotation = |pose: &Pose| Quat::from_mat3(&pose.rotation.transpose());
    let first = key(0).camera.scaled_to(size);
    (0..frames)
        .map(|f| {
            let at = f as f32 / (frames - 1) as f32 * (through.len() - 1) as f32;
            let k = (at as usize).min(through.len() - 2) as isize;
            let t = at - k as f32;
            let c = |i: isize| key(k + i).pose.centre();
            let centre = catmull_rom(c(-1), c(0), c(1), c(2), t);
            let turn = rotation(&key(k).pose).slerp(rotation(&key(k + 1).pose), t);
            let rotation = Mat3::from_quat(turn).transpose();
            let relative = |i: isize| key(k + i).camera.fy / key(k + i).camera.height as f32;
            let focal = (relative(0) * (1.0 - t) + relative(1) * t) * first.height as f32;
            let camera = Camera {
                fx: focal,
                fy: focal,
                cx: first.width as f32 / 2.0,
                cy: first.height as f32 / 2.0,
                ..first
            };
            let pose = Pose { rotation, translation: -(rotation * centre) };
            let (view, next) = (through[k as usize], through[k as usize + 1]);
            let file = Some(frame_name(f) + ".png");
            RenderJob { name: frame_name(f), file, camera, pose, view, towards: (next, t) }
        })
        .collect()
}

fn catmull_rom(a: Vec3, b: Vec3, c: Vec3, d: Vec3, t: f32) -> Vec3 {
    0.5 * ((2.0 * b)
        + (c - a) * t
        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
        + (3.0 * b - a - 3.0 * c + d) * t * t * t)
}

/// No channels: blending them gives alpha alone.
pub(crate) const NOTHING: Channels = Channels { count: 0, values: &[] };

/// Colour that highlights a selection.
const TINT: [f32; 3] = [1.0, 0.35, 0.1];

/// Share of a highlighted pixel's colour that is the highlight's.
pub(crate) const HIGHLIGHT: f32 = 0.45;

/// Renders one scene, with one selection and one kind of content.
pub(crate) struct SceneRenderer<'a> {
    model: Model,
    /// Per splat, whether it is of the selection.
    whose: Option<Vec<bool>>,
    /// 1 for the splats of the selection, where that is highlighted.
    highlight: Option<Kept<'static>>,
    only: bool,
    what: RenderContent,
    features: Option<(Kept<'a>, FeatureColours)>,
}

impl<'a> SceneRenderer<'a> {
    /// Uploads what every render blends to the engine's device.
    pub(crate) fn new(
        loaded: &'a Loaded,
        selected: Option<(Selected, Mode)>,
        what: RenderContent,
        engine: &dyn Rasterizer,
    ) -> Result<SceneRenderer<'a>, RunError> {
        let mut model = loaded.model.clone();
        let (mut whose, mut highlight, mut only) = (None, None, false);
        if let Some((selected, mode)) = selected {
            model.splats = selected.cut_scene(&model.splats);
            let mut labels = selected.labels;
            if let Mode::Only | Mode::Without = mode {
                if what == RenderContent::Features {
                    let text =
                        "features are rendered for the whole scene: leave --mode or use --mode highlight";
                    return Err(RunError::Request(text.into()));
                }
                only = mode == Mode::Only;
                let keep: Vec<usize> = (0..labels.len()).filter(|&i| labels[i] == only).collect();
                model.select(&keep);
                labels = vec![only; keep.len()];
            }
            if mode == Mode::Highlight && what == RenderContent::Colour {
                let indicator: Vec<f32> = labels.iter().map(|&w| f32::from(u8::from(w))).collect();
                let mut indicator = Kept::new(1, indicator);
                indicator.bring(engine)?;
                highlight = Some(indicator);
            }
            whose = Some(labels);
        }
        let features = match (what, &loaded.field) {
            (RenderContent::Features, Some(field)) => {
                let mut kept = field.kept();
                kept.bring(engine)?;
                Some((kept, FeatureColours::of(field)?))
            }
            (RenderContent::Features, None) => {
                return Err(RunError::Request(
                    "this run has no feature field yet: finish `segwild run` first".into(),
                ));
            }
            _ => None,
        };
        Ok(SceneRenderer { model, whose, highlight, only, what, features })
    }

    /// The light of a job: its view's, or interpolated towards the next view's.
    fn own(&self, job: &RenderJob, strength: f32) -> SceneLight {
        let (next, t) = job.towards;
        let light = |view| self.model.light(Some(view));
        let own = if t == 0.0 { light(job.view) } else { light(job.view).towards(&light(next), t) };
        self.model.strengthened(&own, strength)
    }

    /// The scene in one light, the selection in another if there is one.
    fn lighting(&self, scene: SceneLight, object: Option<SceneLight>) -> SceneLighting {
        SceneLighting { scene, objects: self.whose.clone().zip(object).into_iter().collect() }
    }

    /// The light of a view's photo; the scene's own if none is named.
    pub(crate) fn light(&self, view: Option<usize>) -> SceneLighting {
        self.model.light(view).into()
    }

    /// Renders one image, with values in 0 to 1.
    pub(crate) fn render(
        &self,
        engine: &dyn Rasterizer,
        camera: &Camera,
        pose: &Pose,
        lighting: &SceneLighting,
    ) -> Result<Image, RunError> {
        let options = self.model.options();
        let splats = &self.model.splats;
        if self.what == RenderContent::Colour {
            let mut image = render_lit(&self.model, engine, camera, pose, lighting)?;
            let project = || engine.project(splats, camera, pose, &options);
            if self.only {
                let alpha = project()?.blend(&NOTHING)?.alpha;
                let background = lighting.scene.background().paint(camera, pose);
                over_white(&mut image, &alpha, &background);
            }
            if let Some(indicator) = &self.highlight {
                let share = project()?.blend_kept(indicator)?.image;
                let n = image.pixels();
                for c in 0..3 {
                    for i in 0..n {
                        let s = HIGHLIGHT * share.data[i].clamp(0.0, 1.0);
                        let v = &mut image.data[c * n + i];
                        *v = *v * (1.0 - s) + TINT[c] * s;
                    }
                }
            }
            return Ok(image);
        }
        let projected = engine.project(splats, camera, pose, &options)?;
        match (self.what, &self.features) {
            (RenderContent::Features, Some((field, colours))) => {
                Ok(colours.paint(&projected.blend_kept(field)?))
            }
            (RenderContent::Alpha, _) => Ok(projected.blend(&NOTHING)?.alpha),
            _ => {
                let frame = projected.blend(&Channels { count: 1, values: projected.depths() })?;
                Ok(bright_when_near(&frame.image, &frame.alpha))
            }
        }
    }
}

/// Puts white where the background is, so that an object stands alone.
pub(crate) fn over_white(image: &mut Image, alpha: &Image, background: &Image) {
    let n = image.pixels();
    for c in 0..3 {
        for i in 0..n {
            let over = 1.0 - alpha.data[i];
            let v = &mut image.data[c * n + i];
            *v = (*v + over * (1.0 - background.data[c * n + i])).clamp(0.0, 1.0);
        }
    }
}

/// Inverse depth between its 1 and 99 % quantiles; black where nothing is.
fn bright_when_near(depth: &Image, alpha: &Image) -> Image {
    let covered = |i: usize| alpha.data[i] > 0.5 && depth.data[i] > 0.0;
    let inverse = |i: usize| alpha.data[i] / depth.data[i];
    let mut all: Vec<f32> = (0..depth.pixels()).filter(|&i| covered(i)).map(inverse).collect();
    all.sort_by(f32::total_cmp);
    let mut out = Image::zeros(depth.width, depth.height, 1);
    if all.is_empty() {
        return out;
    }
    let at = |q: f32| all[((all.len() - 1) as f32 * q) as usize];
    let (low, high) = (at(0.01), at(0.99));
    for i in (0..depth.pixels()).filter(|&i| covered(i)) {
        let v = if high > low { (inverse(i) - low) / (high - low) } else { 1.0 };
        out.data[i] = 0.1 + 0.9 * v.clamp(0.0, 1.0);
    }
    out
}
