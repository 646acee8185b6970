//! Where a scene's reconstruction, its photo folder and its photos are.

use crate::decode::converted;
use crate::draft::Draft;
use crate::endings::is_photo;
use crate::names::{Listing, below, is_inside, key, stem, tidy};
use crate::photo_files::{Claim, LocateError, PHOTO_FOLDERS, no_file, photo_folders, settle};
use crate::{PosedPhotos, SceneError, SceneSettings, Skipped, colmap, draft, transforms};
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Words in the names of images that Blender's scenes hold beside a photo and that are no photos.
const BESIDE: [&str; 3] = ["_depth", "_normal", "_alpha"];

pub(crate) fn setting(setting: &'static str, value: String, reason: &str) -> SceneError {
    SceneError::Setting { setting, value, reason: reason.to_owned() }
}

/// The files of a scene.
pub(crate) struct FoundScene {
    /// The scene's folder.
    pub folder: PathBuf,
    /// Its reconstruction.
    pub draft: Draft,
    /// The folder of its photos.
    pub images: PathBuf,
    /// Photos that the program which made the reconstruction found no poses of, with its reasons; `None` where the photo folder
    /// alone says which photos those are.
    pub unposed: Option<Vec<Skipped>>,
}

impl FoundScene {
    /// The scene of photos whose poses another program computed.
    pub fn posed(posed: PosedPhotos) -> Result<FoundScene, SceneError> {
        let PosedPhotos { scene, photos, model, unposed, notes } = posed;
        let folder = std::path::absolute(&scene).map_err(SceneError::io(&scene))?;
        let images = std::path::absolute(&photos).map_err(SceneError::io(&photos))?;
        let mut draft = draft::from_colmap(&model)?;
        draft.notes.extend(notes);
        Ok(FoundScene { folder, draft, images, unposed: Some(unposed) })
    }
}

/// Finds the files of a scene.
pub(crate) fn find(path: &Path, settings: &SceneSettings) -> Result<FoundScene, SceneError> {
    let metadata = std::fs::metadata(path).map_err(SceneError::io(path))?;
    // Absolute, so that folders above can be named and the photos be found again from elsewhere.
    let path = &std::path::absolute(path).map_err(SceneError::io(path))?;
    let (folder, json) = if metadata.is_dir() {
        (path.to_owned(), transforms::find(path))
    } else {
        (path.parent().unwrap_or(Path::new("")).to_owned(), Some(path.to_owned()))
    };
    let images = folder_setting("images", &settings.images, &folder)?;
    let model = if metadata.is_dir() { colmap::find(&folder) } else { None };
    if let Some(found) = &model
        && (found.near || json.is_none())
    {
        let mut draft = draft::from_colmap(&found.dir)?;
        draft.notes.extend(found.note.clone());
        let beside = json.map(|json| format!("{} is read, and not {}", found.dir.display(), json.display()));
        draft.notes.extend(beside);
        let images = images.map_or_else(|| find_photos(&folder, &draft), Ok)?;
        let own =
            !settings.images.is_empty() || images.starts_with(&folder) || is_usual(&images, &draft.source);
        draft.notes.extend((!own).then(|| {
            format!(
                "the photos are those of {}, which lies outside of {}; to take others, name their folder with `images`",
                images.display(),
                folder.display()
            )
        }));
        return Ok(FoundScene { folder, draft, images, unposed: None });
    }
    let is_json = |json: &PathBuf| json.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if let Some(json) = json.filter(is_json) {
        let mut draft = transforms::read(&json, images.as_deref(), metadata.is_dir())?;
        let beside =
            model.map(|found| format!("{} is read, and not {}", json.display(), found.dir.display()));
        draft.notes.extend(beside);
        // Its photos hold their paths.
        let images = images.unwrap_or_else(|| folder.clone());
        return Ok(FoundScene { folder, draft, images, unposed: None });
    }
    let is_empty = || std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
    let problem = if metadata.is_file() && is_photo(path) {
        "is one photo: give the folder that it is in"
    } else if metadata.is_dir() && is_empty() {
        "is empty: there are no photos in it"
    } else {
        "holds no scene that can be read"
    };
    Err(SceneError::NotAScene {
        path: path.to_owned(),
        problem,
        looked_for: format!(
            "a COLMAP reconstruction (cameras and images, .bin or .txt, in {}), nerfstudio's transforms.json and Blender's \
             transforms_train.json; and there are no photos or video whose poses could be computed",
            colmap::MODEL_FOLDERS.join(", ")
        ),
    })
}

/// Whether photos lie where COLMAP has them, beside `sparse`: no note is needed then, though `sparse/0` alone was named.
fn is_usual(images: &Path, model: &Path) -> bool {
    let inner = images.parent().and_then(|base| model.strip_prefix(base).ok());
    let parts: Vec<String> =
        inner.iter().flat_map(|b| b.iter()).map(|part| key(&part.to_string_lossy())).collect();
    let is_number = |part: &String| part.parse::<u64>().is_ok();
    parts.first().is_some_and(|part| part == "sparse") && parts[1..].iter().all(is_number)
}

/// The folder a setting names: as it stands, or within the scene's folder.
pub(crate) fn folder_setting(
    name: &'static str,
    value: &str,
    scene: &Path,
) -> Result<Option<PathBuf>, SceneError> {
    if value.is_empty() {
        return Ok(None);
    }
    let dirs = [PathBuf::from(value), scene.join(value)];
    let found = dirs.into_iter().find(|p| p.is_dir());
    found.map(Some).ok_or_else(|| setting(name, value.to_owned(), "there is no such folder"))
}

/// The first folder that holds a photo of the reconstruction, under its name or under what is left of it. Those of the scene itself
/// come before any outside of it.
fn find_photos(folder: &Path, draft: &Draft) -> Result<PathBuf, SceneError> {
    // Photos that lie in the reconstruction's own folder, beside it, or beside the one above it, are rather its own.
    let above = draft.source.ancestors().take(3).map(|dir| below(dir, "images"));
    let (mut dirs, outside): (Vec<PathBuf>, Vec<PathBuf>) = above.partition(|dir| dir.starts_with(folder));
    dirs.extend(photo_folders(folder));
    dirs.extend(outside);
    dirs.retain(|dir| dir.is_dir());
    let holds =
        |dir: &PathBuf| draft.photos.iter().any(|p| is_inside(&p.name) && is_there(&dir.join(&p.name)));
    if let Some(dir) = dirs.iter().find(|dir| holds(dir)) {
        return Ok(dir.clone());
    }
    let mut candidate = None;
    for dir in &dirs {
        let listing = Listing::of(dir);
        if draft.photos.iter().any(|photo| listing.tail(&photo.name).is_some()) {
            return Ok(dir.clone());
        }
        let like = |p: &crate::draft::DraftPhoto| {
            listing.candidate(&p.name).map(|e| (p.name.clone(), e.path.clone()))
        };
        candidate = candidate.or_else(|| draft.photos.iter().find_map(like));
    }
    let reason = match draft.photos.first() {
        None => "the reconstruction has no photo".to_owned(),
        Some(first) => {
            let like = candidate.map_or_else(String::new, |(name, path)| {
                format!("; {} may be {name}: if so, rename it", path.display())
            });
            format!(
                "none of the {} photos of {} was found (the first is {}); looked in {}; name the folder with `images`{like}",
                draft.photos.len(),
                draft.source.display(),
                first.name,
                PHOTO_FOLDERS.join(", ")
            )
        }
    };
    Err(SceneError::NothingUsable { path: folder.to_owned(), reason })
}

/// Whether there is the file, or a converted copy of it.
fn is_there(path: &Path) -> bool {
    path.is_file() || converted(path).is_some()
}

/// The file of each photo, or why there is none. A photo that is found by what is left of its name gets the name of the file.
pub(crate) fn locate(draft: &mut Draft, images: &Path) -> Vec<Result<PathBuf, LocateError>> {
    let exact = |photo: &draft::DraftPhoto| match &photo.file {
        Some(file) => Some(file.clone()),
        None => {
            let path = images.join(&photo.name);
            // An entry that is no file is reported when it is opened.
            (is_inside(&photo.name) && (path.exists() || converted(&path).is_some())).then_some(Ok(path))
        }
    };
    let mut located: Vec<Option<Result<PathBuf, LocateError>>> = draft.photos.par_iter().map(exact).collect();
    if located.iter().all(Option::is_some) {
        return located.into_iter().flatten().collect();
    }
    let listing = Listing::of(images);
    let claim = |(photo, path): (&draft::DraftPhoto, Option<Result<PathBuf, LocateError>>)| match path {
        Some(path) => path.map(|path| Claim { path, left: None }),
        None => match listing.tail(&photo.name) {
            Some(entry) => Ok(Claim::left(entry)),
            None => Err(no_file(images, &photo.name, listing.candidate(&photo.name))),
        },
    };
    let claims = draft.photos.iter().zip(located.drain(..)).map(claim).collect();
    let names: Vec<&str> = draft.photos.iter().map(|photo| photo.name.as_str()).collect();
    let claims = settle(&names, claims);
    let left =
        claims.iter().enumerate().filter_map(|(i, claim)| Some((i, claim.as_ref().ok()?.left.clone()?)));
    let names: Vec<(usize, String)> = left.collect();
    let other = |(i, name): &&(usize, String)| tidy(&draft.photos[*i].name) != *name;
    let found: Vec<(usize, String)> = names.iter().filter(other).cloned().collect();
    draft.notes.extend(renamed(draft, &found));
    for (i, name) in names {
        draft.photos[i].name = name;
    }
    claims.into_iter().map(|claim| claim.map(|claim| claim.path)).collect()
}

fn renamed(draft: &Draft, found: &[(usize, String)]) -> Option<String> {
    let (first, name) = found.first()?;
    Some(format!(
        "{} photos have other names in {} than their files, and were found by what is left of them ({} is {name})",
        found.len(),
        draft.source.display(),
        draft.photos[*first].name
    ))
}

/// Photos that lie beside those of the reconstruction and that it does not hold, counted.
pub(crate) fn unheld(draft: &Draft, located: &[Result<PathBuf, LocateError>]) -> Option<String> {
    let held: HashSet<&Path> = located.iter().flatten().map(PathBuf::as_path).collect();
    let folders: BTreeSet<&Path> = held.iter().filter_map(|path| path.parent()).collect();
    // By their names, and by those without endings.
    let by_stem: HashMap<PathBuf, &Path> = held.iter().map(|path| (path.with_extension(""), *path)).collect();
    // The converted copy or the raw or HEIC original of a photo that is held, or what Blender rendered beside one.
    let of_held = |path: &Path| {
        let stem = path.with_extension("");
        let originals = [held.get(&*stem).copied(), by_stem.get(&stem).copied()];
        let is_copy = originals.into_iter().flatten().any(|held| converted(held).as_deref() == Some(path));
        let copied = || converted(path).is_some_and(|copy| held.contains(copy.as_path()));
        is_copy || copied() || beside_photo(path).is_some_and(|photo| by_stem.contains_key(&photo))
    };
    let mut others = Vec::new();
    for folder in folders {
        let files = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        others
            .extend(files.filter(|path| is_photo(path) && !held.contains(path.as_path()) && !of_held(path)));
    }
    others.sort();
    let first = others.first()?;
    Some(format!(
        "{} of the photos in {} {} not in {} and take no part (the first is {})",
        others.len(),
        first.parent().unwrap_or(first).display(),
        if others.len() == 1 { "is" } else { "are" },
        draft.source.display(),
        first.file_name()?.to_string_lossy()
    ))
}

/// The photo, without its ending, beside which an image of depths, normals or coverage lies: `r_12_depth_0001.png` is one of `r_12`.
fn beside_photo(path: &Path) -> Option<PathBuf> {
    let name = path.file_name()?.to_str()?;
    let name = stem(name);
    let (at, word) = BESIDE.iter().filter_map(|word| Some((name.rfind(word)?, word))).max()?;
    let number = &name[at + word.len()..];
    let is_number = number.strip_prefix('_').unwrap_or(number).chars().all(|c| c.is_ascii_digit());
    is_number.then(|| path.with_file_name(&name[..at]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_beside_sparse_are_no_surprise_where_sparse_0_is_named_as_the_scene() {
        let usual = |images: &str, model: &str| is_usual(Path::new(images), Path::new(model));
        assert!(usual("/s/images", "/s/sparse/0") && usual("/s/images", "/s/Sparse"));
        assert!(!usual("/s/images", "/s/0") && !usual("/s/images", "/s/dense/0/sparse"));
        assert!(!usual("/s/images", "/s/sparse/other") && !usual("/t/images", "/s/sparse/0"));
    }
}
