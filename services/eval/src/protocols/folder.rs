//! Any scene with true masks beside it: `SCENE/truth/PHOTO.png` of one object, or `SCENE/truth/OBJECT/PHOTO.png` of
//! several.

use super::clicks;
use super::error::ProtocolError;
use super::scene::{EvalQuery, EvalScene, FoundScenes, photos, stem};
use segwild_pipeline::{PhotoPrompts, Settings};
use segwild_scene::{Mask, MaskFiles, Prompts, Random, SceneError};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Rows at which the parts of an object meet, by the stem of a photo: a click goes into each part.
pub type Parts = BTreeMap<String, Vec<u32>>;

/// Which photos are clicked, and where.
#[derive(Clone, Debug)]
pub struct FolderProtocol {
    /// The scene.
    pub scene: PathBuf,
    /// Stems of the photos to click; sampled if empty.
    pub references: Vec<String>,
    /// So many are sampled for each object by the seed of the training, from those that show it well.
    pub draw: usize,
    /// Clicks per photo, by [`clicks::inside`].
    pub clicks: usize,
    /// Where the parts of the object meet; in the photos that it lists, each part gets one click, by [`clicks::parts`].
    pub parts: Parts,
}

/// A photo shows an object well when it covers at least one pixel in this many.
const WELL: usize = 50;

/// What lies in a synthetic scene's `truth` and is no mask of an object.
const NO_OBJECT: [&str; 6] = ["clean", "sky", "transient", "instance", "part", "depth"];

const LAYOUT: &str = "Put the true masks where the photos are:\n\
    SCENE/images/a.jpg, b.jpg, ..   the photos, with sparse/0/ or transforms.json, as for `segwild run`\n\
    SCENE/truth/a.png, b.png, ..    white where the object is, one file per photo, named as the photo\n\
    SCENE/truth/OBJECT/a.png, ..    the same, a folder per object, if there are several";

/// Reads a file of [`Parts`].
///
/// # Errors
/// When it cannot be read or is something else.
pub fn read_parts(file: &Path) -> Result<Parts, ProtocolError> {
    let text = segwild_scene::text::read(file)?;
    serde_json::from_str(&text).map_err(|e| ProtocolError::File {
        file: file.display().to_string(),
        reason: format!("expected rows by photo, as in {{\"IMG_01\": [240]}}: {e}"),
    })
}

/// The scene and its questions, every object from several photos; and what is missing: reference photos that have no true
/// mask of an object, true masks that cannot be read.
///
/// # Errors
/// When the scene or its truth is not there, or no reference photo of any object.
pub fn scenes(
    options: &FolderProtocol,
    settings: &Settings,
    seed: u64,
) -> Result<FoundScenes, ProtocolError> {
    let photos = photos(&options.scene, settings)?;
    let objects = objects(&options.scene, &photos)?;
    let (mut queries, mut missing) = (Vec::new(), Vec::new());
    for (at, (target, truth)) in objects.into_iter().enumerate() {
        let mut random = Random::stream(seed, at as u64);
        for (prompt, (photo, mask)) in
            references(options, &target, &truth, &mut random, &mut missing).into_iter().enumerate()
        {
            let points = match options.parts.get(stem(&photo)) {
                Some(rows) => clicks::parts(&mask, rows),
                None => clicks::inside(&mask, options.clicks),
            };
            let prompts = Prompts { points, ..Prompts::default() };
            queries.push(EvalQuery {
                target: target.clone(),
                prompt: prompt as u32,
                prompts: vec![PhotoPrompts { photo, prompts }],
                truth: truth.clone(),
                missing: Vec::new(),
            });
        }
    }
    let name = std::path::absolute(&options.scene).unwrap_or_else(|_| options.scene.clone());
    let name = name.file_name().map_or_else(|| "scene".into(), |n| n.to_string_lossy().into_owned());
    let eval_scene = EvalScene {
        protocol: "folder",
        name,
        scene: options.scene.clone(),
        seed,
        queries,
        split: None,
        held_out: false,
    };
    if missing.is_empty() {
        return Ok(eval_scene.into());
    }
    FoundScenes { scenes: vec![eval_scene], missing }.or_refused(LAYOUT)
}

/// The objects and their true masks, by name.
pub type Objects = BTreeMap<String, Vec<(String, PathBuf)>>;

/// The objects of a scene with true masks in `truth/`: one folder per object, or one object whose masks lie there.
///
/// # Errors
/// When there is no true mask that is named as a photo, or a folder cannot be read.
pub fn objects(scene: &Path, photos: &[String]) -> Result<Objects, ProtocolError> {
    let truth = scene.join("truth");
    if !truth.is_dir() {
        return Err(ProtocolError::missing(format!("the true masks: {}", truth.display()), LAYOUT));
    }
    let mut objects = Objects::new();
    objects.insert("object".into(), masks_in(&truth, photos)?);
    for (path, is_folder) in entries(&truth)? {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if is_folder && !NO_OBJECT.contains(&name.as_str()) {
            objects.entry(name).or_default().extend(masks_in(&path, photos)?);
        }
    }
    objects.retain(|_, masks: &mut Vec<_>| !masks.is_empty());
    if objects.is_empty() {
        let what = format!("a mask in {} that is named as a photo of the scene", truth.display());
        return Err(ProtocolError::missing(what, LAYOUT));
    }
    Ok(objects)
}

/// What lies in a folder, sorted, and whether it is a folder.
pub(super) fn entries(folder: &Path) -> Result<Vec<(PathBuf, bool)>, SceneError> {
    let list = std::fs::read_dir(folder).map_err(SceneError::io(folder))?;
    let mut list: Vec<(PathBuf, bool)> = list.flatten().map(|e| (e.path(), e.path().is_dir())).collect();
    list.sort();
    Ok(list)
}

/// The masks in a folder, each with the photo that it is of.
pub(super) fn masks_in(folder: &Path, photos: &[String]) -> Result<Vec<(String, PathBuf)>, ProtocolError> {
    let files = MaskFiles::new(folder, photos.iter().map(String::as_str));
    let mut masks = Vec::new();
    for photo in photos {
        let found = files.find(photo).map_err(|error| {
            let file = folder.display().to_string();
            ProtocolError::File { file, reason: error.to_string() }
        })?;
        masks.extend(found.map(|file| (photo.clone(), file)));
    }
    masks.sort_by(|a, b| a.1.cmp(&b.1));
    Ok(masks)
}

/// A photo with its true mask, or a word among what is missing.
fn masked(
    target: &str,
    (photo, file): &(String, PathBuf),
    missing: &mut Vec<String>,
) -> Option<(String, Mask)> {
    match Mask::read_png(file) {
        Ok(mask) => Some((photo.clone(), mask)),
        Err(error) => {
            missing.push(format!("{target}: {error}"));
            None
        }
    }
}

/// The photos to click for an object, with its true masks there.
fn references(
    options: &FolderProtocol,
    target: &str,
    truth: &[(String, PathBuf)],
    random: &mut Random,
    missing: &mut Vec<String>,
) -> Vec<(String, Mask)> {
    let mut masks = Vec::new();
    if options.references.is_empty() {
        masks.extend(truth.iter().filter_map(|t| masked(target, t, missing)));
        masks.retain(|(_, mask): &(String, Mask)| {
            mask.count() * WELL >= mask.width() as usize * mask.height() as usize
        });
        random.shuffle(&mut masks);
        masks.truncate(options.draw);
    }
    for wanted in &options.references {
        // The stem, or its start: the names that archives give are long.
        let fits = |t: &&(String, PathBuf)| t.0 == *wanted || stem(&t.0).starts_with(wanted.as_str());
        match truth.iter().find(fits) {
            Some(found) => masks.extend(masked(target, found, missing)),
            None => {
                missing.push(format!("{target}: a photo with a true mask whose name starts with `{wanted}`"));
            }
        }
    }
    masks
}
