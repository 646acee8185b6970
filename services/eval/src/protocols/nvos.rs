//! NVOS (Ren et al. 2022): a scribble on one photo of a forward-facing scene, the true mask of another.

use super::clicks;
use super::error::ProtocolError;
use super::folder::entries;
use super::scene::{EvalQuery, EvalScene, FoundScenes, photo_of, photos, stem};
use segwild_pipeline::{PhotoPrompts, Settings};
use segwild_scene::{Mask, PointPrompt, Prompts};
use std::path::{Path, PathBuf};

/// Which data, and how scribbles are read.
#[derive(Clone, Debug)]
pub struct NvosProtocol {
    /// Folder of the annotations and scenes.
    pub root: PathBuf,
    /// Scenes to measure; all that are annotated if empty.
    pub only: Vec<String>,
    /// Most clicks taken from the scribbles inside the object, and as many from those outside.
    pub clicks: usize,
}

/// How the data must lie.
const LAYOUT: &str = "The annotations are published with NVOS (Neural Volumetric Object Selection), the photos are LLFF's. Put them so:\n\
    ROOT/reference_image/SCENE/PHOTO.JPG          its name says which photo is scribbled on\n\
    ROOT/scribbles/SCENE/pos_*.png, neg_*.png     scribbles inside and outside the object, white on black\n\
    ROOT/masks/SCENE/PHOTO_mask.png               the true mask of another photo\n\
    ROOT/scenes/SCENE/images, sparse/0            the photos and COLMAP's reconstruction, as for `segwild run`; of a scene\n\
    \u{20}                                             SCENE_PART (horns_center) those in ROOT/scenes/SCENE serve as well\n\
    ROOT may also hold the first three below labels/llff/, as in the archive.";

/// The annotated scenes that are there, each with its question, and what is missing.
///
/// # Errors
/// When no scene is left: all that is missing, with what to put where.
pub fn scenes(options: &NvosProtocol, settings: &Settings, seed: u64) -> Result<FoundScenes, ProtocolError> {
    let inner = options.root.join("labels/llff");
    let labels = if inner.is_dir() { inner } else { options.root.clone() };
    let scribbles = labels.join("scribbles");
    let mut missing = Vec::new();
    let mut names: Vec<String> = match entries(&scribbles) {
        Ok(list) => list.iter().filter(|e| e.1).map(|e| file_name(&e.0)).collect(),
        Err(_) => {
            missing.push(format!("the scribbles: {}", scribbles.display()));
            Vec::new()
        }
    };
    if !options.only.is_empty() {
        names.clone_from(&options.only);
    }
    let mut found = FoundScenes { scenes: Vec::new(), missing };
    for name in &names {
        match eval_scene(options, &labels, name, settings, seed) {
            Ok(eval_scene) => found.scenes.push(eval_scene),
            Err(ProtocolError::Missing(m)) => found.missing.extend(m.what),
            Err(ProtocolError::Scene(error)) => found.missing.push(format!("the scene {name}: {error}")),
            Err(other) => return Err(other),
        }
    }
    if found.missing.is_empty() && found.scenes.is_empty() {
        found.missing.push(format!("a scene in {}", scribbles.display()));
    }
    found.or_refused(LAYOUT)
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The only file of a folder that fits.
fn find(folder: &Path, what: &str, fits: impl Fn(&str) -> bool) -> Result<PathBuf, ProtocolError> {
    let missing = || ProtocolError::missing(format!("{what} in {}", folder.display()), LAYOUT);
    let list = entries(folder).map_err(|_| missing())?;
    list.into_iter().map(|e| e.0).find(|path| fits(&file_name(path))).ok_or_else(missing)
}

fn eval_scene(
    options: &NvosProtocol,
    labels: &Path,
    name: &str,
    settings: &Settings,
    seed: u64,
) -> Result<EvalScene, ProtocolError> {
    let scene = [name, name.split('_').next().unwrap_or(name)]
        .iter()
        .flat_map(|n| [n.to_string(), format!("{n}_undistort")])
        .map(|n| options.root.join("scenes").join(n))
        .find(|path| path.is_dir())
        .ok_or_else(|| {
            let wanted = options.root.join("scenes").join(name);
            ProtocolError::missing(format!("the scene {name}: {}", wanted.display()), LAYOUT)
        })?;
    let photos = photos(&scene, settings)?;
    let pick = |file: &Path, ending: &str| {
        let name = file_name(file);
        let wanted = stem(&name).trim_end_matches(ending).to_owned();
        photo_of(&photos, &wanted).cloned().ok_or_else(|| {
            let what = format!("the photo `{wanted}` ({}) in {}", file.display(), scene.display());
            ProtocolError::missing(what, LAYOUT)
        })
    };
    let is_photo = |n: &str| ["jpg", "jpeg", "png"].iter().any(|e| n.to_ascii_lowercase().ends_with(e));
    let reference = find(&labels.join("reference_image").join(name), "the reference photo", is_photo)?;
    let mask = find(&labels.join("masks").join(name), "the true mask", |n| n.ends_with("_mask.png"))?;
    let (clicked, scored) = (pick(&reference, "")?, pick(&mask, "_mask")?);
    let folder = labels.join("scribbles").join(name);
    let mut points = scribbled(&folder, "pos", options.clicks, true)?;
    if points.is_empty() {
        let what = format!("a white pixel in {}/pos_*.png", folder.display());
        return Err(ProtocolError::missing(what, LAYOUT));
    }
    points.extend(scribbled(&folder, "neg", options.clicks, false)?);
    let clicked = on_photo(&scene, &clicked, points, &folder, settings)?;
    let query = EvalQuery {
        target: name.into(),
        prompt: 0,
        prompts: vec![clicked],
        truth: vec![(scored, mask)],
        missing: Vec::new(),
    };
    Ok(EvalScene {
        protocol: "nvos",
        name: name.into(),
        scene,
        seed,
        queries: vec![query],
        split: None,
        held_out: false,
    })
}

/// Clicks along all scribbles of a kind.
fn scribbled(
    folder: &Path,
    kind: &str,
    count: usize,
    inside: bool,
) -> Result<Vec<PointPrompt>, ProtocolError> {
    let mut all: Option<Mask> = None;
    for (file, _) in entries(folder)? {
        let name = file_name(&file);
        if name.starts_with(kind) && name.ends_with(".png") {
            let mask = Mask::read_png(&file)?;
            all = Some(match all {
                Some(sum) if (sum.width(), sum.height()) == (mask.width(), mask.height()) => sum.or(&mask),
                Some(sum) => sum.or(&mask.resized(sum.width(), sum.height())),
                None => mask,
            });
        }
    }
    Ok(all.map_or_else(Vec::new, |scribble| clicks::scribble(&scribble, count, inside)))
}

/// Clicks in pixels of the scribble's image as clicks in pixels of the scene's photo, which may be of another size.
fn on_photo(
    scene: &Path,
    photo: &str,
    points: Vec<PointPrompt>,
    scribbles: &Path,
    settings: &Settings,
) -> Result<PhotoPrompts, ProtocolError> {
    let file = find(scribbles, "a scribble", |n| n.starts_with("pos") && n.ends_with(".png"))?;
    let scribble = Mask::read_png(&file)?;
    let scene = segwild_scene::Scene::open(scene, &settings.scene)?;
    let camera = scene.views.iter().find(|v| v.name == photo).map(|v| v.camera);
    let (w, h) = camera.map_or((scribble.width(), scribble.height()), |c| (c.width, c.height));
    let prompts = Prompts { points, ..Prompts::default() };
    let scaled = prompts.scaled(w as f32 / scribble.width() as f32, h as f32 / scribble.height() as f32);
    Ok(PhotoPrompts { photo: photo.into(), prompts: scaled })
}
