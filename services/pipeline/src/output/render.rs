//! Renders a trained scene: views of photos or a path through them, with any appearance and with a selection.

use crate::artifacts::folder::Loaded;
use crate::artifacts::images::ImageFiles;
use crate::output::camera_path::{self, CameraPath, InterpolatedCamera, ObjectSphere, PathCamera};
use crate::output::cover::cover;
use crate::output::foreign_photo::FittedScene;
use crate::output::light::{AppearanceRequest, Lights, find};
use crate::output::video::{self, FRAMES_PER_SECOND};
use crate::output::without::SceneWithout;
use crate::{RunError, RunFolder, Selected, choose_engine, log_loss};
use glam::Vec3;
use segwild_features::FeatureColours;
use segwild_flow::{FileError, Stopper, files};
use segwild_raster::{Channels, Rasterizer, ResidentChannels};
use segwild_scene::{Camera, Image, Pose, Scene, View};
use segwild_trainer::{Model, SceneLight, SceneLighting, render_lit};
use serde::Serialize;
use std::path::{Path, PathBuf};

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
    /// Names of the photos whose views are rendered, or through or among which the path runs; empty: all.
    pub photos: Vec<String>,
    /// The way of the camera.
    pub path: CameraPath,
    /// Number of renders along the path, from 2 to [`MOST_FRAMES`]. `None`: one per photo; [`FRAMES_AROUND`] around an object.
    pub frames: Option<u32>,
    /// Frames in a second of a video.
    pub rate: u32,
    /// The appearance. Without a photo it is the view's own, on a path through photos it changes from photo to photo, and around
    /// an object it is the scene's own. Several appearances are interpolated over the frames.
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
    /// The folder for the renders, or an `.mp4` for all of them; `None`: `RUN/renders`.
    pub out: Option<PathBuf>,
}

impl Default for RenderRequest {
    /// The views of all photos, as trained.
    fn default() -> RenderRequest {
        RenderRequest {
            photos: Vec::new(),
            path: CameraPath::Photos,
            frames: None,
            rate: FRAMES_PER_SECOND,
            appearance: AppearanceRequest::default(),
            object_appearance: None,
            interpolate: None,
            selection: None,
            what: RenderContent::Colour,
            width: None,
            out: None,
        }
    }
}

/// A render that was written.
#[derive(Clone, Debug, Serialize)]
pub struct RenderedFile {
    /// The file.
    pub file: PathBuf,
    /// What it shows.
    pub view: String,
    /// Of a scene without an object: the share of its pixels that show what no photo saw, in [0, 1]. They are marked in an image of
    /// the same name in the folder [`UNSEEN`]. Of a video: the mean over its frames.
    pub unseen: Option<f32>,
}

/// The folder beside renders for what no photo saw.
pub const UNSEEN: &str = "unseen";

/// Frames of a path around an object, unless a request says otherwise.
pub const FRAMES_AROUND: u32 = 120;

/// Most frames of a path: nearly an hour at 30 frames a second. The cameras of all take about 20 MB.
pub const MOST_FRAMES: u32 = 100_000;

/// Writes the requested renders.
///
/// # Errors
/// When the run is not trained yet, the request does not fit the run, the engine fails, a video is requested and ffmpeg is missing
/// or fails, a file cannot be written, or `stopper` stops it.
pub fn render(
    folder: &RunFolder,
    request: &RenderRequest,
    stopper: &Stopper,
) -> Result<Vec<RenderedFile>, RunError> {
    request.check()?;
    let out = request.out.clone().unwrap_or_else(|| folder.path().join("renders"));
    if !video::is_video(&out) {
        return render_into(folder, request, &out, stopper);
    }
    let encoder = video::encoder()?;
    let mut unseen = None;
    files::write_by_folder(&out, |aside| -> Result<(), RunError> {
        let frames = render_into(folder, request, aside, stopper)?;
        let shares: Option<Vec<f32>> = frames.iter().map(|frame| frame.unseen).collect();
        unseen = shares.map(|shares| shares.iter().sum::<f32>() / shares.len().max(1) as f32);
        let written = aside.join(out.file_name().unwrap_or_default());
        video::encode(&encoder, aside, request.rate, &written, stopper)
    })?;
    let view = request.path.to_string();
    Ok(vec![RenderedFile { file: out, view, unseen }])
}

/// Writes the renders into a folder.
fn render_into(
    folder: &RunFolder,
    request: &RenderRequest,
    out: &Path,
    stopper: &Stopper,
) -> Result<Vec<RenderedFile>, RunError> {
    let loaded = folder.load()?;
    let engine = choose_engine(&loaded.settings.run, log_loss)?.engine;
    let chosen: Vec<usize> = match request.photos.is_empty() {
        true => (0..loaded.scene.views.len()).collect(),
        false => request.photos.iter().map(|n| find(&loaded.scene, n)).collect::<Result<_, _>>()?,
    };
    let selected = match &request.selection {
        Some((name, mode)) => Some((Selected::read(folder, name, loaded.model.splats.len())?, *mode)),
        None => None,
    };
    let size = request.width.unwrap_or(loaded.settings.scene.size);
    let jobs = request.jobs(&loaded, &chosen, selected.as_ref().map(|(selected, _)| selected), size)?;
    std::fs::create_dir_all(out).map_err(|e| FileError::new("create", out, e))?;
    let without = match &selected {
        Some((selected, Mode::Without)) => {
            let cut = selected.cut_scene(&loaded.model.splats);
            let (splats, trained) = ((&cut, loaded.model.options()), loaded.settings.scene.size);
            Some(SceneWithout::of_run(&*engine, folder, &loaded.scene, splats, &selected.labels, trained)?)
        }
        _ => None,
    };
    let renderer = SceneRenderer::with(&loaded, selected, without.as_ref(), request.what, &*engine)?;
    let plain = &*engine;
    let resident = engine.upload_splats(&renderer.model.splats)?;
    let engine = resident.as_deref().unwrap_or(&*engine);
    let mut rendered = Vec::new();
    let lights = FittedScene::of(&loaded, plain).lights(&request.appearance, &renderer.model)?;
    let object_lights = match &request.object_appearance {
        Some(appearance) => Some(appearance.lights(&loaded.scene, &renderer.model)?),
        None => None,
    };
    let sequence = request.frames.is_some() || request.path != CameraPath::Photos;
    let last = jobs.len().saturating_sub(1).max(1) as f32;
    for (f, job) in jobs.into_iter().enumerate() {
        RunError::unless_running(stopper)?;
        let share = if sequence { f as f32 / last } else { request.interpolate.unwrap_or(0.0) };
        let light = lights.at(share).unwrap_or_else(|| renderer.own(&job, request.appearance.strength));
        let object_light = object_lights.as_ref().and_then(|lights: &Lights| lights.at(share));
        let lighting = renderer.lighting(light, object_light);
        let image = renderer.render(engine, &job.at.camera, &job.at.pose, &lighting)?;
        let file = out.join(&job.file);
        image.write_png(&file)?;
        let unseen = match &without {
            Some(without) => {
                let PathCamera { camera, pose } = &job.at;
                let mask = without.unseen(plain, camera, pose, &renderer.cover(engine, camera, pose)?)?;
                if !mask.is_empty() {
                    let folder = out.join(UNSEEN);
                    std::fs::create_dir_all(&folder).map_err(|e| FileError::new("create", &folder, e))?;
                    mask.write_png(&folder.join(&job.file).with_extension("png"))?;
                }
                Some(mask.count() as f32 / image.pixels() as f32)
            }
            None => None,
        };
        rendered.push(RenderedFile { file, view: job.name, unseen });
    }
    Ok(rendered)
}

impl RenderRequest {
    /// Refuses what does not fit together.
    fn check(&self) -> Result<(), RunError> {
        let refuse = |text: &str| Err(RunError::Request(text.into()));
        if let Some(frames) = self.frames.filter(|frames| !(2..=MOST_FRAMES).contains(frames)) {
            return refuse(&format!("a path has 2 to {MOST_FRAMES} frames, and {frames} are requested"));
        }
        if let Some(out) = self.out.as_deref().filter(|out| video::is_other(out) && !out.is_dir()) {
            return refuse(&format!("{}: a video is .mp4, and images go into a folder", out.display()));
        }
        let around = self.path != CameraPath::Photos;
        if around && self.selection.is_none() {
            return refuse("a path around an object needs --selection NAME");
        }
        if !around && self.frames.is_none() && self.out.as_deref().is_some_and(video::is_video) {
            return refuse("a video through photos needs --frames N");
        }
        check_appearances(self)
    }

    /// What is to be rendered.
    fn jobs(
        &self,
        loaded: &Loaded,
        chosen: &[usize],
        selected: Option<&Selected>,
        size: u32,
    ) -> Result<Vec<RenderJob>, RunError> {
        let scene = &loaded.scene;
        let frame = |(at, own): (PathCamera, OwnLight), f: usize| {
            let name = format!("path-{f:04}");
            RenderJob { file: format!("{name}.png"), name, at, own }
        };
        let frames = |cameras: Vec<(PathCamera, OwnLight)>| {
            cameras.into_iter().zip(0..).map(|(camera, f)| frame(camera, f)).collect()
        };
        let cameras: Vec<PathCamera> = chosen.iter().map(|&view| camera_of(scene, view)).collect();
        let around = |path: fn(&[PathCamera], Vec3, &ObjectSphere, u32, u32) -> Vec<PathCamera>| {
            let object = selected.map_or(Vec::new(), Selected::splats);
            let sphere = ObjectSphere::of(&loaded.model.splats, &object).ok_or_else(|| {
                RunError::Request("the selection is empty: there is nothing to go around".into())
            })?;
            let up = camera_path::scene_up(scene.views.iter().map(|view| &view.pose));
            let path = path(&cameras, up, &sphere, self.frames.unwrap_or(FRAMES_AROUND), size);
            Ok::<_, RunError>(frames(path.into_iter().map(|camera| (camera, OwnLight::Scene)).collect()))
        };
        Ok(match (self.path, self.frames) {
            (CameraPath::Turntable, _) => around(camera_path::turntable)?,
            (CameraPath::Orbit, _) => around(camera_path::orbit)?,
            (CameraPath::Photos, None) => {
                let files = ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()));
                let job = |(&view, &PathCamera { camera, pose }): (&usize, &PathCamera)| {
                    let name = scene.views[view].name.as_str();
                    RenderJob {
                        name: name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_owned(),
                        file: files.name(view).to_owned(),
                        at: PathCamera { camera: camera.scaled_to(size), pose },
                        own: OwnLight::Photo(view),
                    }
                };
                chosen.iter().zip(&cameras).map(job).collect()
            }
            // One view, and a sequence of appearances.
            (CameraPath::Photos, Some(count)) if chosen.len() == 1 => {
                let PathCamera { camera, pose } = cameras[0];
                let still = PathCamera { camera: camera.scaled_to(size), pose };
                frames(vec![(still, OwnLight::Photo(chosen[0])); count as usize])
            }
            (CameraPath::Photos, Some(count)) => {
                let light = |at: &InterpolatedCamera| {
                    OwnLight::Interpolated(chosen[at.first], chosen[at.first + 1], at.share)
                };
                let path = camera_path::through_photos(&cameras, count, size);
                frames(path.iter().map(|at| (at.at, light(at))).collect())
            }
        })
    }
}

/// A photo's own camera.
fn camera_of(scene: &Scene, view: usize) -> PathCamera {
    let View { camera, pose, .. } = &scene.views[view];
    PathCamera { camera: *camera, pose: *pose }
}

/// Refuses appearances that do not fit together or do not fit the request.
fn check_appearances(request: &RenderRequest) -> Result<(), RunError> {
    let appearances = || std::iter::once(&request.appearance).chain(&request.object_appearance);
    let refuse = |text: &str| Err(RunError::Request(text.into()));
    let sequence = appearances().any(|appearance| appearance.count() > 1);
    if request.object_appearance.is_some() && request.selection.is_none() {
        return refuse("an appearance of the object needs --selection NAME");
    }
    if request.object_appearance.as_ref().is_some_and(|appearance| appearance.photos.is_empty()) {
        return refuse("the object's appearance names no photo");
    }
    let through = request.path == CameraPath::Photos;
    if sequence && through && request.frames.is_none() && request.interpolate.is_none() {
        return refuse(
            "two appearances need --frames N, a sequence between them, or --interpolate T, 0 to 1",
        );
    }
    if request.interpolate.is_some()
        && (request.frames.is_some() || !through || appearances().all(|appearance| appearance.count() == 1))
    {
        return refuse("--interpolate needs two appearances, and no --frames");
    }
    if request.interpolate.is_some_and(|t| !(0.0..=1.0).contains(&t)) {
        return refuse("--interpolate is a share from 0 to 1");
    }
    if through
        && request.frames.is_some()
        && request.photos.len() < 2
        && !(request.photos.len() == 1 && sequence)
    {
        return refuse(
            "a path needs two photos or more: give --photo twice; or one --photo and two appearances to interpolate",
        );
    }
    Ok(())
}

/// One image to render.
struct RenderJob {
    name: String,
    /// The image's file.
    file: String,
    at: PathCamera,
    own: OwnLight,
}

/// The light of an image for which no appearance is requested.
#[derive(Clone, Copy, Debug)]
enum OwnLight {
    /// The scene's own.
    Scene,
    /// A photo's.
    Photo(usize),
    /// Interpolated: a share of the way from the first to the second, 0 to 1.
    Interpolated(usize, usize, f32),
}

/// Colour that highlights a selection.
const TINT: [f32; 3] = [1.0, 0.35, 0.1];

/// Share of a highlighted pixel's colour that is the highlight's.
pub(crate) const HIGHLIGHT: f32 = 0.45;

/// Renders one scene, with one selection and one kind of content.
pub(crate) struct SceneRenderer {
    model: Model,
    /// Per splat, whether it is of the selection.
    whose: Option<Vec<bool>>,
    /// 1 for the splats of the selection, where that is highlighted.
    highlight: Option<ResidentChannels<'static>>,
    only: bool,
    what: RenderContent,
    features: Option<(ResidentChannels<'static>, FeatureColours)>,
}

impl SceneRenderer {
    /// Uploads what every render blends to the engine's device.
    pub(crate) fn new(
        loaded: &Loaded,
        selected: Option<(Selected, Mode)>,
        what: RenderContent,
        engine: &dyn Rasterizer,
    ) -> Result<SceneRenderer, RunError> {
        Self::with(loaded, selected, None, what, engine)
    }

    /// The same; `without` is what is known of the scene without the selection, for [`Mode::Without`].
    fn with(
        loaded: &Loaded,
        selected: Option<(Selected, Mode)>,
        without: Option<&SceneWithout>,
        what: RenderContent,
        engine: &dyn Rasterizer,
    ) -> Result<SceneRenderer, RunError> {
        let mut model = loaded.model.clone();
        let (mut whose, mut highlight, mut only) = (None, None, false);
        if let Some((selected, mode)) = selected {
            model.splats = selected.cut_scene(&model.splats).into();
            let mut labels = selected.labels;
            if let Mode::Only | Mode::Without = mode {
                if what == RenderContent::Features {
                    let text =
                        "features are rendered for the whole scene: leave --mode or use --mode highlight";
                    return Err(RunError::Request(text.into()));
                }
                only = mode == Mode::Only;
                let others = || (0..labels.len()).filter(|&i| labels[i] == only).collect();
                let keep: Vec<usize> = without.map_or_else(others, |without| without.keep.clone());
                model.select(&keep);
                labels = vec![only; keep.len()];
            }
            if mode == Mode::Highlight && what == RenderContent::Colour {
                let indicator: Vec<f32> = labels.iter().map(|&w| f32::from(u8::from(w))).collect();
                let mut indicator = ResidentChannels::new(1, indicator);
                indicator.upload(engine)?;
                highlight = Some(indicator);
            }
            whose = Some(labels);
        }
        let features = match (what, &loaded.field) {
            (RenderContent::Features, Some(field)) => {
                let mut channels = field.resident_channels();
                channels.upload(engine)?;
                Some((channels, FeatureColours::of(field)?))
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

    /// The light of a job for which no appearance is requested.
    fn own(&self, job: &RenderJob, strength: f32) -> SceneLight {
        let light = |view| self.model.light(Some(view));
        let own = match job.own {
            OwnLight::Scene => return self.model.light(None),
            OwnLight::Photo(view) => light(view),
            OwnLight::Interpolated(from, to, share) => light(from).towards(&light(to), share),
        };
        self.model.strengthened(&own, strength)
    }

    /// How much of each pixel its splats cover.
    fn cover(&self, engine: &dyn Rasterizer, camera: &Camera, pose: &Pose) -> Result<Image, RunError> {
        let projected = engine.project(&self.model.splats, camera, pose, &self.model.options())?;
        cover(&*projected)
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
                let alpha = cover(&*project()?)?;
                let background = lighting.scene.background().paint(camera, pose);
                over_white(&mut image, &alpha, &background);
            }
            if let Some(indicator) = &self.highlight {
                let share = project()?.blend_resident(indicator)?.image;
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
                Ok(colours.paint(&projected.blend_resident(field)?))
            }
            (RenderContent::Alpha, _) => cover(&*projected),
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
