//! Where a scene's reconstruction, its photo folder and its photos are.

use crate::decode::converted;
use crate::draft::Draft;
use crate::names::{Entry, Listing, is_inside, tidy};
use crate::{SceneError, SceneSettings};
use crate::{colmap, draft, transforms};
use rayon::prelude::*;
use std::collections::{BTreeSet, HashMap, HashSet};
use std::path::{Path, PathBuf};

/// Folders, relative to the scene's, in which photos are looked for.
pub(crate) const PHOTO_FOLDERS: [&str; 8] =
    ["images", "dense/images", "dense/0/images", "input", "images_2", "images_4", "images_8", "."];
/// Endings of photo files, those that cannot be read among them.
pub(crate) const PHOTO_ENDINGS: [&str; 10] =
    ["jpg", "jpeg", "png", "webp", "tif", "tiff", "bmp", "heic", "heif", "avif"];

pub(crate) fn setting(setting: &'static str, value: String, reason: &str) -> SceneError {
    SceneError::Setting { setting, value, reason: reason.to_owned() }
}

/// The scene's folder, what its reconstruction says, and the photo folder where that is settled.
pub(crate) fn find(
    path: &Path,
    settings: &SceneSettings,
) -> Result<(PathBuf, Draft, Option<PathBuf>), SceneError> {
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
        return Ok((folder, draft, images));
    }
    let is_json = |json: &PathBuf| json.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if let Some(json) = json.filter(is_json) {
        let mut draft = transforms::read(&json, images.as_deref(), metadata.is_dir())?;
        let beside =
            model.map(|found| format!("{} is read, and not {}", json.display(), found.dir.display()));
        draft.notes.extend(beside);
        // Its photos say themselves where they are.
        let images = images.unwrap_or_else(|| folder.clone());
        return Ok((folder, draft, Some(images)));
    }
    Err(SceneError::NotAScene {
        path: path.to_owned(),
        looked_for: format!(
            "a COLMAP reconstruction (cameras and images, .bin or .txt, in {}), nerfstudio's transforms.json and Blender's \
             transforms_train.json",
            colmap::PLACES.join(", ")
        ),
    })
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
    let places = [PathBuf::from(value), scene.join(value)];
    let found = places.into_iter().find(|p| p.is_dir());
    found.map(Some).ok_or_else(|| setting(name, value.to_owned(), "there is no such folder"))
}

/// The first folder that holds a photo of the reconstruction, under its name or under what is left of it.
pub(crate) fn find_photos(folder: &Path, draft: &Draft) -> Result<PathBuf, SceneError> {
    let mut places: Vec<PathBuf> = PHOTO_FOLDERS.iter().map(|p| folder.join(p)).collect();
    // Photos that lie beside the reconstruction's own folder, or beside the one above it, are surely its own.
    let above = draft.source.ancestors().skip(1).take(2).map(|dir| dir.join("images"));
    places.splice(0..0, above);
    places.retain(|place| place.is_dir());
    let holds =
        |place: &PathBuf| draft.photos.iter().any(|p| is_inside(&p.name) && is_there(&place.join(&p.name)));
    if let Some(place) = places.iter().find(|place| holds(place)) {
        return Ok(place.clone());
    }
    let mut candidate = None;
    for place in &places {
        let listing = Listing::of(place);
        if draft.photos.iter().any(|photo| listing.tail(&photo.name).is_some()) {
            return Ok(place.clone());
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
pub(crate) fn locate(draft: &mut Draft, images: &Path) -> Vec<Result<PathBuf, String>> {
    let exact = |photo: &draft::DraftPhoto| match &photo.file {
        Some(file) => Some(file.clone()),
        None => {
            let path = images.join(&photo.name);
            // What stands there and is no file is told of when it is opened.
            (is_inside(&photo.name) && (path.exists() || converted(&path).is_some())).then_some(Ok(path))
        }
    };
    let mut located: Vec<Option<Result<PathBuf, String>>> = draft.photos.par_iter().map(exact).collect();
    if located.iter().all(Option::is_some) {
        return located.into_iter().flatten().collect();
    }
    let listing = Listing::of(images);
    // A file is one photo: that of its exact name, or the only one that it is left of.
    let mut owners: HashMap<PathBuf, usize> = HashMap::new();
    for path in located.iter().flatten().flatten() {
        owners.insert(path.clone(), usize::MAX);
    }
    let (mut found, mut names) = (Vec::new(), Vec::new());
    for (i, photo) in draft.photos.iter().enumerate() {
        if located[i].is_some() {
            continue;
        }
        let Some(entry) = listing.tail(&photo.name) else {
            located[i] = Some(Err(no_file(images, &photo.name, listing.candidate(&photo.name))));
            continue;
        };
        if let Some(&owner) = owners.get(&entry.path) {
            let of = draft.photos.get(owner).map_or(&entry.name, |other| &other.name);
            let reason =
                format!("what is left of its name is {}, and that is photo {of} already", entry.name);
            located[i] = Some(Err(reason));
            continue;
        }
        owners.insert(entry.path.clone(), i);
        located[i] = Some(Ok(entry.path.clone()));
        if tidy(&photo.name) != entry.name {
            found.push((i, entry.name.clone()));
        }
        names.push((i, entry.name.clone()));
    }
    draft.notes.extend(renamed(draft, &found));
    for (i, name) in names {
        draft.photos[i].name = name;
    }
    located.into_iter().flatten().collect()
}

/// Why a photo has no file, with the file that may be the one.
pub(crate) fn no_file(folder: &Path, name: &str, candidate: Option<&Entry>) -> String {
    let place = folder.display();
    match candidate {
        Some(entry) => format!(
            "there is no file of that name in {place}; {} may be the one: if so, rename it",
            entry.name
        ),
        None if !is_inside(name) => {
            format!(
                "its name is not that of a file inside the photo folder, and there is no file of its last part in {place}"
            )
        }
        None => format!("there is no file of that name in {place}"),
    }
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
pub(crate) fn unheld(draft: &Draft, located: &[Result<PathBuf, String>]) -> Option<String> {
    let copies: Vec<PathBuf> = located.iter().flatten().filter_map(|path| converted(path)).collect();
    let held: HashSet<&Path> = located.iter().flatten().chain(&copies).map(PathBuf::as_path).collect();
    let folders: BTreeSet<&Path> = held.iter().filter_map(|path| path.parent()).collect();
    let is_photo = |path: &Path| {
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        ending.is_some_and(|e| PHOTO_ENDINGS.contains(&e.as_str()))
    };
    let mut others = Vec::new();
    for folder in folders {
        let files = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
        others.extend(files.filter(|path| is_photo(path) && !held.contains(path.as_path())));
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
