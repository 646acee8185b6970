//! The paper's own protocol: nine targets in three scenes of Photo Tourism, one reference photo and three true masks
//! each, and PSNR on the held-out photos by left and right halves. The photos and masks are the user's.

use super::clicks;
use super::error::{Missing, ProtocolError};
use super::paper::{PAPER, PaperScene, PaperTarget};
use super::scene::{EvalQuery, EvalScene, FoundScenes, stem};
use segwild_pipeline::{PhotoPrompts, Replay, Settings};
use segwild_scene::{Mask, MaskFileError, MaskFiles, Prompts, Scene};
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
const LAYOUT: &str = "The photos are those of the Image Matching Challenge's Photo Tourism (\"phototourism\", training set); \
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
        let what = format!("a scene named `{odd}`: there are {}", folders().join(", "));
        return Err(missing(what));
    }
    let wanted = |s: &&PaperScene| options.only.is_empty() || options.only.contains(&s.folder);
    let mut found = FoundScenes::default();
    for scene in PAPER.scenes.iter().filter(wanted) {
        match eval_scene(options, scene, settings, seed) {
            Ok((eval_scene, missing)) => {
                found.scenes.push(eval_scene);
                found.missing.extend(missing);
            }
            Err(ProtocolError::Missing(missing)) => found.missing.extend(missing.what),
            Err(other) => return Err(other),
        }
    }
    found.or_refused(LAYOUT)
}

/// The error that one thing is missing.
fn missing(what: String) -> ProtocolError {
    ProtocolError::missing(what, LAYOUT)
}

/// Folders of the scenes.
fn folders() -> Vec<&'static str> {
    PAPER.scenes.iter().map(|s| s.folder.as_str()).collect()
}

/// A scene with its queries, and what is missing of it.
///
/// # Errors
/// [`ProtocolError::Missing`] when it cannot be measured at all, and when a file of prompts cannot be read.
fn eval_scene(
    options: &PhotoTourismProtocol,
    scene: &PaperScene,
    settings: &Settings,
    seed: u64,
) -> Result<(EvalScene, Vec<String>), ProtocolError> {
    let root = options.root.join(&scene.folder);
    if !root.is_dir() {
        return Err(missing(format!("{}: the folder {}", scene.name, root.display())));
    }
    let dense = root.join("dense");
    let path = if dense.is_dir() { dense } else { root.clone() };
    let split = root.join(&scene.split);
    if !split.is_file() {
        return Err(missing(format!("{}: the split, {}", scene.name, split.display())));
    }
    let mut settings = settings.scene.clone();
    settings.split = split.display().to_string();
    let opened =
        Scene::open(&path, &settings).map_err(|error| missing(format!("{}: {error}", scene.name)))?;
    let (mut queries, mut absent) = (Vec::new(), Vec::new());
    for target in &scene.targets {
        match query(&root, target, &opened, options.clicks) {
            Ok(query) => {
                absent.extend(query.missing.iter().map(|m| format!("{}, {}: {m}", scene.name, target.name)));
                queries.push(query);
            }
            Err(ProtocolError::Missing(Missing { what, .. })) => {
                absent.push(format!("{}, {}, is refused: {}", scene.name, target.name, what.join("; ")));
            }
            Err(other) => return Err(other),
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
    Ok((eval_scene, absent))
}

/// A photo or a true mask that a target needs and that is not there.
#[derive(Debug, thiserror::Error)]
enum AbsentFile {
    /// The photo takes no part in the scene.
    #[error("the photo {stem}.jpg: {reason}")]
    Photo { stem: String, reason: String },
    /// There is no true mask of this name.
    #[error("the true mask {}", .0.display())]
    Mask(PathBuf),
    /// It is open which file is the true mask.
    #[error(transparent)]
    MaskFile(#[from] MaskFileError),
}

/// A photo of the scene by its stem, or why it takes no part.
fn photo<'a>(scene: &'a Scene, wanted: &str) -> Result<&'a str, AbsentFile> {
    if let Some(view) = scene.views.iter().find(|v| stem(&v.name) == wanted) {
        return Ok(&view.name);
    }
    let skipped = scene.skipped.iter().find(|s| stem(&s.name) == wanted);
    let reason = skipped.map_or("the reconstruction has no photo of that name", |s| s.reason.as_str());
    Err(AbsentFile::Photo { stem: wanted.into(), reason: reason.into() })
}

/// The true mask of a photo, or what is missing.
fn mask(masks: &MaskFiles, folder: &Path, photo: &str) -> Result<PathBuf, AbsentFile> {
    masks.find(photo)?.ok_or_else(|| AbsentFile::Mask(folder.join(MaskFiles::wanted(photo))))
}

/// The query for a target, from the files that are there.
///
/// # Errors
/// [`ProtocolError::Missing`] when too few are there, and when a file of prompts cannot be read.
fn query(
    root: &Path,
    target: &PaperTarget,
    scene: &Scene,
    clicks: usize,
) -> Result<EvalQuery, ProtocolError> {
    let folder = root.join("truth").join(&target.folder);
    let masks = MaskFiles::new(&folder, scene.views.iter().map(|v| v.name.as_str()));
    let (mut truth, mut absent) = (Vec::new(), Vec::new());
    for wanted in &target.truth {
        match photo(scene, wanted).and_then(|photo| Ok((photo, mask(&masks, &folder, photo)?))) {
            Ok((photo, mask)) => truth.push((photo.to_owned(), mask)),
            Err(why) => absent.push(format!("{why}; it is not scored")),
        }
    }
    let refused = |what| ProtocolError::Missing(Missing { what, layout: LAYOUT.into() });
    let prompts = match prompts(&folder, &masks, target, scene, clicks) {
        Ok(prompts) => prompts,
        Err(ProtocolError::Missing(Missing { mut what, .. })) => {
            what.append(&mut absent);
            return Err(refused(what));
        }
        Err(other) => return Err(other),
    };
    if truth.is_empty() {
        return Err(refused(absent));
    }
    Ok(EvalQuery { target: target.name.clone(), prompt: 0, prompts, truth, missing: absent })
}

/// Clicks on a target's reference photo, or those of its file of prompts.
///
/// # Errors
/// [`ProtocolError::Missing`] when the photo or its mask is not there, and when the file of prompts cannot be read.
fn prompts(
    folder: &Path,
    masks: &MaskFiles,
    target: &PaperTarget,
    scene: &Scene,
    clicks: usize,
) -> Result<Vec<PhotoPrompts>, ProtocolError> {
    let file = folder.join("prompts.json");
    if file.is_file() {
        let prompts = Replay::read(&file)?.prompts;
        let absent = prompts.iter().find_map(|p| photo(scene, stem(&p.photo)).err());
        return match absent {
            Some(why) => Err(missing(format!("{why}; {} clicks in it", file.display()))),
            None => Ok(prompts),
        };
    }
    let photo = photo(scene, &target.reference)
        .map_err(|why| missing(format!("{why}; it is the reference photo")))?
        .to_owned();
    let mask = mask(masks, folder, &photo)
        .map_err(|why| missing(format!("{why}, or prompts.json beside it: it is the reference photo's")))?;
    let clicked =
        Mask::read_png(&mask).map_err(|error| missing(format!("the reference photo's mask: {error}")))?;
    let points = clicks::inside(&clicked, clicks);
    if points.is_empty() {
        return Err(missing(format!("a white pixel in {}, the reference photo's mask", mask.display())));
    }
    Ok(vec![PhotoPrompts { photo, prompts: Prompts { points, ..Prompts::default() } }])
}
