//! SPIn-NeRF's multi-view masks (Mirzaei et al. 2023): the target's true mask on one photo is where it is clicked, those of
//! all others score it.

use super::clicks;
use super::error::ProtocolError;
use super::folder::{entries, masks_in};
use super::scene::{EvalQuery, EvalScene, FoundScenes, photos};
use segwild_pipeline::{PhotoPrompts, Settings};
use segwild_scene::{Mask, Prompts};
use std::path::{Path, PathBuf};

/// Which data, and how it is clicked.
#[derive(Clone, Debug)]
pub struct SpinNerfProtocol {
    /// Folder of the scenes.
    pub root: PathBuf,
    /// Scenes to measure; all if empty.
    pub only: Vec<String>,
    /// Clicks on the reference photo, by [`clicks::inside`].
    pub clicks: usize,
}

/// How the data must lie.
const LAYOUT: &str = "The masks are published with SPIn-NeRF (\"MVSeg\"), the photos with the data sets that it names. Put them so:\n\
    ROOT/SCENE/images, sparse/0          the photos and COLMAP's reconstruction, as for `segwild run`\n\
    ROOT/SCENE/label/PHOTO.png           the target's mask on each photo, named as the photo; images_4/label/ will do\n\
    The first photo by name that has a mask is clicked, the others are scored.";

/// Where a scene's masks may lie.
const LABELS: [&str; 3] = ["label", "images_4/label", "images/label"];

/// The scenes that are there, each with its question, and what is missing.
///
/// # Errors
/// When no scene is left: all that is missing, with what to put where.
pub fn scenes(
    options: &SpinNerfProtocol,
    settings: &Settings,
    seed: u64,
) -> Result<FoundScenes, ProtocolError> {
    let mut missing = Vec::new();
    let names: Vec<PathBuf> = match entries(&options.root) {
        _ if !options.only.is_empty() => options.only.iter().map(|name| options.root.join(name)).collect(),
        Ok(list) => list.into_iter().filter(|e| e.1).map(|e| e.0).collect(),
        Err(_) => Vec::new(),
    };
    if names.is_empty() {
        missing.push(format!("a scene in {}", options.root.display()));
    }
    let mut found = FoundScenes { scenes: Vec::new(), missing };
    for scene in names {
        match eval_scene(&scene, options.clicks, settings, seed) {
            Ok(eval_scene) => found.scenes.push(eval_scene),
            Err(ProtocolError::Missing(missing)) => found.missing.extend(missing.what),
            Err(other) => return Err(other),
        }
    }
    found.or_refused(LAYOUT)
}

/// A scene with its query.
///
/// # Errors
/// [`ProtocolError::Missing`] when a part of it is missing, and when its masks cannot be listed.
fn eval_scene(
    scene: &Path,
    clicks: usize,
    settings: &Settings,
    seed: u64,
) -> Result<EvalScene, ProtocolError> {
    let missing = |what: String| ProtocolError::missing(what, LAYOUT);
    let name = scene.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if !scene.is_dir() {
        return Err(missing(format!("the scene {}", scene.display())));
    }
    let Some(labels) = LABELS.iter().map(|l| scene.join(l)).find(|l| l.is_dir()) else {
        return Err(missing(format!("the masks of {name}: {}", scene.join(LABELS[0]).display())));
    };
    let photos = photos(scene, settings)
        .map_err(|error| missing(format!("the scene {}: {error}", scene.display())))?;
    let mut truth = masks_in(&labels, &photos)?;
    if truth.len() < 2 {
        let (n, labels) = (truth.len(), labels.display());
        let what = format!("two masks in {labels} that are named as photos of {name}: there are {n}");
        return Err(missing(what));
    }
    let (photo, file) = truth.remove(0);
    let mask =
        Mask::read_png(&file).map_err(|error| missing(format!("the reference photo's mask: {error}")))?;
    let points = clicks::inside(&mask, clicks);
    if points.is_empty() {
        return Err(missing(format!("a white pixel in {}, the reference photo's mask", file.display())));
    }
    let prompts = vec![PhotoPrompts { photo, prompts: Prompts { points, ..Prompts::default() } }];
    let queries = vec![EvalQuery { target: name.clone(), prompt: 0, prompts, truth, missing: Vec::new() }];
    Ok(EvalScene {
        protocol: "spin-nerf",
        name,
        scene: scene.into(),
        seed,
        queries,
        split: None,
        held_out: false,
    })
}
