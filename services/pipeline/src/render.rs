//! Pictures of a trained scene: a photo's view, a path through several, under any look, with a selection.

use crate::folder::Loaded;
use crate::images::Pictures;
use crate::light::{AppearanceRequest, find};
use crate::{RunError, RunFolder, Selected, choose_engine, log_loss};
use glam::{Mat3, Quat, Vec3};
use segwild_features::FeatureColours;
use segwild_raster::{Channels, Engine, Kept};
use segwild_scene::{Camera, Image, Pose, Scene};
use segwild_trainer::{Light, Lighting, Model, render_lit};
use serde::Serialize;
use std::path::PathBuf;

/// How a selection is drawn.
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

/// What is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum What {
    /// The scene as it looks.
    Colour,
    /// Depth, near bright.
    Depth,
    /// How much of each pixel is covered.
    Alpha,
    /// The feature field's main components as colours.
    Features,
}

/// What to draw.
#[derive(Clone, Debug)]
pub struct RenderRequest {
    /// Names of the photos whose views are drawn, or between which the path runs; empty: all.
    pub photos: Vec<String>,
    /// Pictures along a path through the photos; `None`: one per photo.
    pub frames: Option<u32>,
    /// The look; without a photo it is the view's own, and on a path it goes from photo to photo. Several looks are gone
    /// through over the frames.
    pub appearance: AppearanceRequest,
    /// Another look for the selected object.
    pub object_appearance: Option<AppearanceRequest>,
    /// Where between the looks, if two or more are given and no frames: 0 is the first, 1 the last.
    pub between: Option<f32>,
    /// A selection and how to draw it.
    pub selection: Option<(String, Mode)>,
    /// What is drawn.
    pub what: What,
    /// Long side in pixels; `None`: as trained.
    pub width: Option<u32>,
    /// Where the pictures go; `None`: `RUN/renders`.
    pub out: Option<PathBuf>,
}

/// A picture that was drawn.
#[derive(Clone, Debug, Serialize)]
pub struct Drawn {
    /// The file.
    pub file: PathBuf,
    /// What it shows.
    pub view: String,
}

/// Draws what is asked for.
pub fn render(folder: &RunFolder, request: &RenderRequest) -> Result<Vec<Drawn>, RunError> {
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
    let shots = match request.frames {
        None => chosen.iter().map(|&v| Shot::of_view(&loaded.scene, v, size)).collect(),
        // One view, and a walk between looks.
        Some(frames) if chosen.len() == 1 => {
            let still = |f| Shot {
                name: frame_name(f),
                file: Some(frame_name(f) + ".png"),
                ..Shot::of_view(&loaded.scene, chosen[0], size)
            };
            (0..frames).map(still).collect()
        }
        Some(frames) => path(&loaded.scene, &chosen, frames, size),
    };
    let out = request.out.clone().unwrap_or_else(|| folder.path().join("renders"));
    std::fs::create_dir_all(&out).map_err(|e| segwild_flow::FileError::new("create", &out, e))?;
    let painter = Painter::new(&loaded, selected, request.what, &*engine)?;
    let held = engine.hold(&painter.model.splats)?;
    let engine = held.as_deref().unwrap_or(&*engine);
    let mut drawn = Vec::new();
    let lights = request.appearance.lights(&loaded.scene, &painter.model)?;
    let object_lights = match &request.object_appearance {
        Some(appearance) => Some(appearance.lights(&loaded.scene, &painter.model)?),
        None => None,
    };
    let last = shots.len().saturating_sub(1).max(1) as f32;
    let pictures = Pictures::of(loaded.scene.views.iter().map(|v| v.name.as_str()));
    for (f, shot) in shots.into_iter().enumerate() {
        let share = request.frames.map_or(request.between.unwrap_or(0.0), |_| f as f32 / last);
        let light = lights.at(share).unwrap_or_else(|| painter.own(&shot, request.appearance.strength));
        let lighting = painter.lighting(light, object_lights.as_ref().and_then(|lights| lights.at(share)));
        let image = painter.paint(engine, &shot.camera, &shot.pose, &lighting)?;
        let file = out.join(shot.file.as_deref().unwrap_or_else(|| pictures.name(shot.view)));
        image.write_png(&file)?;
        drawn.push(Drawn { file, view: shot.name });
    }
    Ok(drawn)
}

/// Refuses looks that do not fit together or to what is drawn.
fn check_appearances(request: &RenderRequest) -> Result<(), RunError> {
    let appearances = || std::iter::once(&request.appearance).chain(&request.object_appearance);
    let refuse = |text: &str| Err(RunError::Request(text.into()));
    let ways = appearances().any(|appearance| appearance.photos.len() > 1);
    if request.object_appearance.is_some() && request.selection.is_none() {
        return refuse("an object's own look needs --selection NAME");
    }
    if request.object_appearance.as_ref().is_some_and(|appearance| appearance.photos.is_empty()) {
        return refuse("the object's look names no photo");
    }
    if ways && request.frames.is_none() && request.between.is_none() {
        return refuse("two looks need --frames N, a walk between them, or --between T, 0 to 1");
    }
    if request.between.is_some() && (request.frames.is_some() || appearances().all(AppearanceRequest::is_one))
    {
        return refuse("--between needs two looks, and no --frames");
    }
    if request.between.is_some_and(|t| !(0.0..=1.0).contains(&t)) {
        return refuse("--between is a share from 0 to 1");
    }
    if request.frames.is_some() && request.photos.len() < 2 && !(request.photos.len() == 1 && ways) {
        return refuse(
            "a path needs two photos or more: give --photo twice; or one --photo and two looks to go between",
        );
    }
    Ok(())
}

/// One picture to take.
struct Shot {
    name: String,
    /// The picture's file, if it is not that of its photo.
    file: Option<String>,
    camera: Camera,
    pose: Pose,
    /// The view whose look it has.
    view: usize,
    /// On the way to another view: which, and how far.
    towards: (usize, f32),
}

fn frame_name(frame: u32) -> String {
    format!("path-{frame:04}")
}

impl Shot {
    fn of_view(scene: &Scene, view: usize, size: u32) -> Shot {
        let v = &scene.views[view];
        Shot {
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
fn path(scene: &Scene, through: &[usize], frames: u32, size: u32) -> Vec<Shot> {
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
            Shot { name: frame_name(f), file, camera, pose, view, towards: (next, t) }
        })
        .collect()
}

fn catmull_rom(a: Vec3, b: Vec3, c: Vec3, d: Vec3, t: f32) -> Vec3 {
    0.5 * ((2.0 * b)
        + (c - a) * t
        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
        + (3.0 * b - a - 3.0 * c + d) * t * t * t)
}

/// No channels: what is left is alpha.
pub(crate) const NOTHING: Channels = Channels { count: 0, values: &[] };

/// Colour that highlights a selection.
const TINT: [f32; 3] = [1.0, 0.35, 0.1];

/// Draws one kind of picture of one scene.
pub(crate) struct Painter<'a> {
    model: Model,
    /// Per splat, whether it is of the selection.
    whose: Option<Vec<bool>>,
    /// 1 for the splats of the selection, where that is highlighted.
    highlight: Option<Kept<'static>>,
    only: bool,
    what: What,
    features: Option<(Kept<'a>, FeatureColours)>,
}

impl<'a> Painter<'a> {
    /// What every picture blends is brought to where `engine` computes.
    pub(crate) fn new(
        loaded: &'a Loaded,
        selected: Option<(Selected, Mode)>,
        what: What,
        engine: &dyn Engine,
    ) -> Result<Painter<'a>, RunError> {
        let mut model = loaded.model.clone();
        let (mut whose, mut highlight, mut only) = (None, None, false);
        if let Some((selected, mode)) = selected {
            model.splats = selected.cut_scene(&model.splats);
            let mut labels = selected.labels;
            if let Mode::Only | Mode::Without = mode {
                if what == What::Features {
                    let text = "features are drawn for the whole scene: leave --mode or use --mode highlight";
                    return Err(RunError::Request(text.into()));
                }
                only = mode == Mode::Only;
                let keep: Vec<usize> = (0..labels.len()).filter(|&i| labels[i] == only).collect();
                model.select(&keep);
                labels = vec![only; keep.len()];
            }
            if mode == Mode::Highlight && what == What::Colour {
                let indicator: Vec<f32> = labels.iter().map(|&w| f32::from(u8::from(w))).collect();
                let mut indicator = Kept::new(1, indicator);
                indicator.bring(engine)?;
                highlight = Some(indicator);
            }
            whose = Some(labels);
        }
        let features = match (what, &loaded.field) {
            (What::Features, Some(field)) => {
                let mut kept = field.kept();
                kept.bring(engine)?;
                Some((kept, FeatureColours::of(field)?))
            }
            (What::Features, None) => {
                return Err(RunError::Request(
                    "this run has no feature field yet: finish `segwild run` first".into(),
                ));
            }
            _ => None,
        };
        Ok(Painter { model, whose, highlight, only, what, features })
    }

    /// The light of a view, or on the way from one to the next.
    fn own(&self, shot: &Shot, strength: f32) -> Light {
        let (next, t) = shot.towards;
        let light = |view| self.model.light(Some(view));
        let own = if t == 0.0 { light(shot.view) } else { light(shot.view).towards(&light(next), t) };
        self.model.strengthened(&own, strength)
    }

    /// The scene in one light, the selection in another if there is one.
    fn lighting(&self, scene: Light, object: Option<Light>) -> Lighting {
        Lighting { scene, object: self.whose.clone().zip(object) }
    }

    /// The light of a view's photo; the scene's own if none is named.
    pub(crate) fn light(&self, view: Option<usize>) -> Lighting {
        self.model.light(view).into()
    }

    /// One picture, in [0, 1].
    pub(crate) fn paint(
        &self,
        engine: &dyn Engine,
        camera: &Camera,
        pose: &Pose,
        lighting: &Lighting,
    ) -> Result<Image, RunError> {
        let options = self.model.options();
        let splats = &self.model.splats;
        if self.what == What::Colour {
            let mut image = render_lit(&self.model, engine, camera, pose, lighting)?;
            let project = || engine.project(splats, camera, pose, &options);
            let n = image.pixels();
            if self.only {
                // Over white, so that the object is seen as the object it is.
                let alpha = project()?.blend(&NOTHING)?.alpha;
                let behind = lighting.scene.background().paint(camera, pose);
                for c in 0..3 {
                    for i in 0..n {
                        let over = 1.0 - alpha.data[i];
                        let v = &mut image.data[c * n + i];
                        *v = (*v + over * (1.0 - behind.data[c * n + i])).clamp(0.0, 1.0);
                    }
                }
            }
            if let Some(indicator) = &self.highlight {
                let share = project()?.blend_kept(indicator)?.image;
                for c in 0..3 {
                    for i in 0..n {
                        let s = 0.45 * share.data[i].clamp(0.0, 1.0);
                        let v = &mut image.data[c * n + i];
                        *v = *v * (1.0 - s) + TINT[c] * s;
                    }
                }
            }
            return Ok(image);
        }
        let projected = engine.project(splats, camera, pose, &options)?;
        match (self.what, &self.features) {
            (What::Features, Some((field, colours))) => Ok(colours.paint(&projected.blend_kept(field)?)),
            (What::Alpha, _) => Ok(projected.blend(&NOTHING)?.alpha),
            _ => {
                let frame = projected.blend(&Channels { count: 1, values: projected.depths() })?;
                Ok(bright_when_near(&frame.image, &frame.alpha))
            }
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
