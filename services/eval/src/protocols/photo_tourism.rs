//! The paper's own protocol: nine targets in three scenes of Photo Tourism, one reference photo and three true masks
//! each, and PSNR on the held-out photos by left and right halves. The photos and masks are the user's.

use super::clicks;
use super::error::{Missing, ProtocolError};
use super::paper::{PAPER, PaperScene, PaperTarget};
use super::scene::{EvalQuery, EvalScene, FoundScenes, stem};
use segwild_pipeline::{PhotoPrompts, Replay, Settings};
use segwild_scene::{Mask, MaskFiles, Prompts, Scene};
use std::path::{Path, PathBuf};

/// Which data, and how it is clicked.
#[derive(Clone, Debug)]
pub struct PhotoTourismProtocol {
    /// Folder of the three scenes.
    pub root: PathBuf,
    /// Scenes to measure, by folder; all that are there if empty.
    pub only: Vec<String>,
    /// Clicks on each reference photo, by [`clicks::inside`], where there is no file of prompts.
    pub clicks: usize,
}

/// How the data must lie.
pub const LAYOUT: &str = "The photos are those of the Image Matching Challenge's Photo Tourism (\"phototourism\", training set); \
    the masks are drawn by hand, for the paper's are not published. Put them so:\n\
    ROOT/brandenburg_gate/dense/images/*.jpg, dense/sparse/*.bin   as in the archive (ROOT/SCENE/images and sparse/0 will do)\n\
    ROOT/brandenburg_gate/brandenburg.tsv                          NeRF-W's split: which photos take part, which are held out\n\
    ROOT/brandenburg_gate/truth/lintel/PHOTO.png                   white where the target is, at the photo's size: for the three\n\
    \u{20}                                                              photos that are scored, and for the reference photo, which is\n\
    \u{20}                                                              clicked deep inside its mask\n\
    ROOT/brandenburg_gate/truth/lintel/prompts.json                instead of the reference photo's mask: clicks and boxes, in\n\
    \u{20}                                                              the form of a selection's prompts.json\n\
    and the same for trevi_fountain (trevi.tsv) and taj_mahal (taj_mahal.tsv). `--scenes` measures some of them.";

/// The scenes that are there, with their queries, and what is missing. A target is refused when
/// its reference photo or all photos that score it are missing; the others go on.
///
/// # Errors
/// When there is no scene of a name, or no target of any scene is left: all that is missing, with what to put where.
pub fn scenes(
    options: &PhotoTourismProtocol,
    settings: &Settings,
    seed: u64,
) -> Result<FoundScenes, ProtocolError> {
    if let Some(odd) = options.only.iter().find(|o| PAPER.scenes.iter().all(|s| s.folder != **o)) {
        let what = vec![format!("a scene named `{odd}`: there are {}", folders().join(", "))];
        return Err(ProtocolError::Missing(Missing { what, layout: LAYOUT.into() }));
    }
    let wanted = |s: &&PaperScene| options.only.is_empty() || options.only.contains(&s.folder);
    let mut found = FoundScenes::default();
    for scene in PAPER.scenes.iter().filter(wanted) {
        match eval_scene(options, scene, settings, seed)? {
            Ok((eval_scene, missing)) => {
                found.scenes.push(eval_scene);
                found.missing.extend(missing);
            }
            Err(missing) => found.missing.push(missing),
        }
    }
    found.or_refused(LAYOUT)
}

/// Folders of the scenes.
fn folders() -> Vec<&'static str> {
    PAPER.scenes.iter().map(|s| s.folder.as_str()).collect()
}

/// A scene with its queries, and what is missing of it; or why it cannot be measured at all.
fn eval_scene(
    options: &PhotoTourismProtocol,
    scene: &PaperScene,
    settings: &Settings,
    seed: u64,
) -> Result<Result<(EvalScene, Vec<String>), String>, ProtocolError> {
    let root = options.root.join(&scene.folder);
    if !root.is_dir() {
        return Ok(Err(format!("{}: the folder {}", scene.name, root.display())));
    }
    let dense = root.join("dense");
    let path = if dense.is_dir() { dense } else { root.clone() };
    let split = root.join(&scene.split);
    if !split.is_file() {
        return Ok(Err(format!("{}: the split, {}", scene.name, split.display())));
    }
    let mut settings = settings.scene.clone();
    settings.split = split.display().to_string();
    let opened = match Scene::open(&path, &settings) {
        Ok(opened) => opened,
        Err(error) => return Ok(Err(format!("{}: {error}", scene.name))),
    };
    let (mut queries, mut missing) = (Vec::new(), Vec::new());
    for target in &scene.targets {
        match query(&root, target, &opened, options.clicks)? {
            Ok(query) => {
                missing.extend(query.missing.iter().map(|m| format!("{}, {}: {m}", scene.name, target.name)));
                queries.push(query);
            }
            Err(why) => {
                missing.push(format!("{}, {}, is refused: {}", scene.name, target.name, why.join("; ")))
            }
        }
    }
    let eval_scene = EvalScene {
        protocol: "photo-tourism",
        name: scene.name.clone(),
        scene: path,
        split: Some(split),
        seed,
        queries,
        held_out: true,
    };
    Ok(Ok((eval_scene, missing)))
}

/// A photo of the scene by its stem, or why it takes no part.
fn photo<'a>(scene: &'a Scene, wanted: &str) -> Result<&'a str, String> {
    if let Some(view) = scene.views.iter().find(|v| stem(&v.name) == wanted) {
        return Ok(&view.name);
    }
    let skipped = scene.skipped.iter().find(|s| stem(&s.name) == wanted);
    let why = skipped.map_or("the reconstruction has no photo of that name", |s| s.reason.as_str());
    Err(format!("the photo {wanted}.jpg: {why}"))
}

/// The true mask of a photo, or what is missing.
fn mask(masks: &MaskFiles, folder: &Path, photo: &str) -> Result<PathBuf, String> {
    let named = || format!("the true mask {}", folder.join(MaskFiles::wanted(photo)).display());
    masks.find(photo).map_err(|e| e.to_string())?.ok_or_else(named)
}

/// The query for a target, from the files that are there; or why there is none.
fn query(
    root: &Path,
    target: &PaperTarget,
    scene: &Scene,
    clicks: usize,
) -> Result<Result<EvalQuery, Vec<String>>, ProtocolError> {
    let folder = root.join("truth").join(&target.folder);
    let masks = MaskFiles::new(&folder, scene.views.iter().map(|v| v.name.as_str()));
    let (mut truth, mut missing) = (Vec::new(), Vec::new());
    for wanted in &target.truth {
        match photo(scene, wanted).and_then(|photo| Ok((photo, mask(&masks, &folder, photo)?))) {
            Ok((photo, mask)) => truth.push((photo.to_owned(), mask)),
            Err(why) => missing.push(format!("{why}; it is not scored")),
        }
    }
    let prompts = match prompts(&folder, &masks, target, scene, clicks)? {
        Ok(prompts) => prompts,
        Err(why) => {
            missing.insert(0, why);
            return Ok(Err(missing));
        }
    };
    if truth.is_empty() {
        return Ok(Err(missing));
    }
    Ok(Ok(EvalQuery { target: target.name.clone(), prompt: 0, prompts, truth, missing }))
}

/// Clicks on a target's reference photo, or those of its file of prompts; or what is missing for them.
fn prompts(
    folder: &Path,
    masks: &MaskFiles,
    target: &PaperTarget,
    scene: &Scene,
    clicks: usize,
) -> Result<Result<Vec<PhotoPrompts>, String>, ProtocolError> {
    let file = folder.join("prompts.json");
    if file.is_file() {
        let prompts = Replay::read(&file)?.prompts;
        let absent = prompts.iter().find_map(|p| photo(scene, stem(&p.photo)).err());
        return Ok(match absent {
            Some(why) => Err(format!("{why}; {} clicks in it", file.display())),
            None => Ok(prompts),
        });
    }
    let photo = match photo(scene, &target.reference) {
        Ok(photo) => photo.to_owned(),
        Err(why) => return Ok(Err(format!("{why}; it is the reference photo"))),
    };
    let mask = match mask(masks, folder, &photo) {
        Ok(mask) => mask,
        Err(why) => return Ok(Err(format!("{why}, or prompts.json beside it: it is the reference photo's"))),
    };
    let clicked = match Mask::read_png(&mask) {
        Ok(clicked) => clicked,
        Err(error) => return Ok(Err(format!("the reference photo's mask: {error}"))),
    };
    let points = clicks::inside(&clicked, clicks);
    if points.is_empty() {
        return Ok(Err(format!("a white pixel in {}, the reference photo's mask", mask.display())));
    }
    Ok(Ok(vec![PhotoPrompts { photo, prompts: Prompts { points, ..Prompts::default() } }]))
}
