//! A folder of photos without a reconstruction: which of them can be given to a program that finds their poses.

use crate::decode::{self, ImageHead, pixels_of};
use crate::endings::is_photo;
use crate::locate::folder_setting;
use crate::names::{Listing, ListingEntry, is_inside, last_part};
use crate::photo_files::photo_folders;
use crate::{ExifCamera, SceneError, SceneSettings, Skipped};
use rayon::prelude::*;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// A photo that has no pose yet.
#[derive(Clone, Debug, PartialEq)]
pub struct UnposedPhoto {
    /// Its name: its path below the photo folder, with `/`.
    pub name: String,
    /// Width and height as stored, in pixels.
    pub size: (u32, u32),
    /// The camera that took it, where EXIF data say so.
    pub camera: Option<ExifCamera>,
}

/// Photos that have no poses yet.
#[derive(Clone, Debug, PartialEq)]
pub struct UnposedPhotos {
    /// The folder of the photos.
    pub folder: PathBuf,
    /// The photos, by name.
    pub photos: Vec<UnposedPhoto>,
    /// Photos that cannot be read, and why.
    pub skipped: Vec<Skipped>,
}

impl UnposedPhotos {
    /// The photos of a scene's folder, or of the folder that `images` names: the first of the folders in which photos are
    /// searched that holds any. Of a folder with photos in it, those below it are left; `None` where there is no photo.
    ///
    /// # Errors
    /// The folder cannot be listed, or there is no folder that `images` names.
    pub fn find(scene: &Path, settings: &SceneSettings) -> Result<Option<UnposedPhotos>, SceneError> {
        let Some((folder, entries)) = folder_with_photos(scene, settings)? else { return Ok(None) };
        let most = pixels_of(settings.max_megapixels);
        let read: Vec<Result<UnposedPhoto, Skipped>> =
            entries.into_par_iter().map(|entry| read(&folder, entry, most)).collect();
        let (mut photos, mut skipped) = (Vec::new(), Vec::new());
        for photo in read {
            match photo {
                Ok(photo) => photos.push(photo),
                Err(reason) => skipped.push(reason),
            }
        }
        Ok(Some(UnposedPhotos { folder, photos, skipped }))
    }
}

/// The first folder of a scene that holds photos, with them.
fn folder_with_photos(
    scene: &Path,
    settings: &SceneSettings,
) -> Result<Option<(PathBuf, Vec<ListingEntry>)>, SceneError> {
    let scene = &std::path::absolute(scene).map_err(SceneError::io(scene))?;
    std::fs::read_dir(scene).map_err(SceneError::io(scene))?;
    let folders = match folder_setting("images", &settings.images, scene)? {
        Some(named) => vec![named],
        None => photo_folders(scene),
    };
    // `.` as a part of the path would stay in messages.
    let listed = folders.into_iter().map(|folder| folder.components().collect::<PathBuf>());
    let mut photos = listed.map(|folder| (photos_in(&folder), folder));
    Ok(photos.find(|(photos, _)| !photos.is_empty()).map(|(photos, folder)| (folder, photos)))
}

/// The photos in a folder itself; where there are none, those below it. Masks and copies of other photos are left out.
fn photos_in(folder: &Path) -> Vec<ListingEntry> {
    let mut photos: Vec<ListingEntry> =
        Listing::of(folder).into_entries().into_iter().filter(|entry| is_photo(&entry.path)).collect();
    if photos.iter().any(|entry| last_part(&entry.name) == entry.name) {
        photos.retain(|entry| last_part(&entry.name) == entry.name);
    } else {
        photos.retain(|entry| !is_of_masks(&entry.name));
    }
    let paths: HashSet<&PathBuf> = photos.iter().map(|entry| &entry.path).collect();
    // The converted copy stands for a photo that is not read.
    let has_copy =
        |entry: &&ListingEntry| decode::converted_copies(&entry.path).any(|copy| paths.contains(&copy));
    let copied: HashSet<String> = photos.iter().filter(has_copy).map(|entry| entry.name.clone()).collect();
    photos.retain(|entry| !copied.contains(&entry.name));
    photos
}

/// Whether a photo's name leads through a folder that holds masks or is hidden.
fn is_of_masks(name: &str) -> bool {
    let mut folders: Vec<&str> = name.split('/').collect();
    folders.pop();
    folders.iter().any(|part| part.starts_with('.') || part.to_lowercase().contains("mask"))
}

fn read(folder: &Path, entry: ListingEntry, most_pixels: u64) -> Result<UnposedPhoto, Skipped> {
    let ListingEntry { name, path } = entry;
    let skip = |reason: &str| Skipped { name: name.clone(), reason: reason.to_owned() };
    // Programs that find poses read lists of names, a line each.
    if !is_inside(&name) || folder.join(&name) != path || name.contains(char::is_control) {
        return Err(skip("its name has signs that other programs do not read: rename it"));
    }
    let head = ImageHead::read(&path, most_pixels).map_err(|error| skip(&error.to_string()))?;
    head.check_end(&path).map_err(|error| skip(&error.to_string()))?;
    Ok(UnposedPhoto { name, size: (head.width, head.height), camera: head.camera })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(files: &[&str]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for name in files {
            let path = dir.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            match name.ends_with(".png") {
                true => image::GrayImage::new(8, 6).save(path).unwrap(),
                false => std::fs::write(path, b"no image").unwrap(),
            }
        }
        dir
    }

    fn names(files: &[&str]) -> Vec<String> {
        let dir = scene(files);
        let found = UnposedPhotos::find(dir.path(), &SceneSettings::default()).unwrap();
        found.map_or(Vec::new(), |found| found.photos.into_iter().map(|photo| photo.name).collect())
    }

    #[test]
    fn photos_are_those_of_the_folder_itself_or_else_those_below_it() {
        assert_eq!(names(&["b.png", "a.png", "masks/a.png", "notes.txt"]), ["a.png", "b.png"]);
        assert_eq!(names(&["day/a.png", "night/a.png", "masks/a.png"]), ["day/a.png", "night/a.png"]);
        assert_eq!(names(&["images/a.png", "truth.png"]), ["a.png"]);
        assert_eq!(names(&["notes.txt"]), [""; 0]);
    }

    #[test]
    fn a_photo_that_cannot_be_read_is_named_with_its_reason() {
        let dir = scene(&["a.png", "b.jpg", "c.heic", "c.png"]);
        let found = UnposedPhotos::find(dir.path(), &SceneSettings::default()).unwrap().unwrap();
        let names: Vec<&str> = found.photos.iter().map(|photo| photo.name.as_str()).collect();
        assert_eq!(names, ["a.png", "c.png"], "the converted copy stands for c.heic");
        assert_eq!(found.skipped.len(), 1);
        assert_eq!(found.skipped[0].name, "b.jpg");
        assert_eq!(found.photos[0].size, (8, 6));
    }

    #[test]
    fn a_folder_that_is_not_there_is_an_error_and_no_folder_without_photos() {
        assert!(UnposedPhotos::find(Path::new("/nowhere/at/all"), &SceneSettings::default()).is_err());
    }
}
