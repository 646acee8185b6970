//! What there is to see of a run before its first scene: its photos, and the curves of its training.

use crate::StudioError;
use crate::messages::TrainingMessage;
use crate::studio::{JPEG_QUALITY, three_planes};
use segwild_flow::lock;
use segwild_pipeline::{Moment, RunFolder};
use segwild_scene::{SceneSettings, UnposedPhotos, load_photo};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Photos that are named at most.
const MOST_PHOTOS: usize = 2000;

/// Points of a curve at most.
const MOST_MOMENTS: usize = 400;

/// A photo as it was taken: its name and its file.
type TakenPhoto = (String, PathBuf);

/// The photos of runs that have no scene yet.
pub(crate) struct EarlyViews {
    /// The photos of the run that is about to start.
    photos: Option<PathBuf>,
    /// Found once per run: the number of a photo stays the same.
    found: Mutex<BTreeMap<String, Arc<Vec<TakenPhoto>>>>,
}

impl EarlyViews {
    pub fn new(photos: Option<PathBuf>) -> EarlyViews {
        EarlyViews { photos, found: Mutex::default() }
    }

    /// The photos of a run, and how its training goes.
    pub fn training(&self, name: &str, folder: &Path) -> TrainingMessage {
        let run = RunFolder::at(folder);
        let photos = self.photos_of(name, &run);
        TrainingMessage {
            photos: photos.iter().map(|(name, _)| name.clone()).collect(),
            history: thinned(run.moments()),
            snapshot: run.newest_snapshot().map(|snapshot| snapshot.step),
        }
    }

    /// A photo as JPEG, with a long side of at most `size` pixels.
    pub fn photo(&self, name: &str, folder: &Path, photo: usize, size: u32) -> Result<Vec<u8>, StudioError> {
        let photos = self.photos_of(name, &RunFolder::at(folder));
        let (_, file) = photos.get(photo).ok_or(StudioError::Request("there is no such photo"))?;
        let image = load_photo(file, size.clamp(16, 4096))?;
        Ok(three_planes(image).to_jpeg(JPEG_QUALITY))
    }

    /// The photos that the run has read, or else those that it is about to read.
    fn photos_of(&self, name: &str, run: &RunFolder) -> Arc<Vec<TakenPhoto>> {
        let mut known = lock(&self.found);
        if let Some(photos) = known.get(name) {
            return photos.clone();
        }
        let mut photos = taken(run).or_else(|| unposed(self.photos.as_deref()?)).unwrap_or_default();
        photos.truncate(MOST_PHOTOS);
        let photos = Arc::new(photos);
        if !photos.is_empty() {
            known.insert(name.to_owned(), photos.clone());
        }
        photos
    }
}

/// The photos that a run has read.
fn taken(run: &RunFolder) -> Option<Vec<TakenPhoto>> {
    let views = run.scene().ok()?.views;
    Some(views.into_iter().map(|view| (view.name, view.photo.path)).collect())
}

/// The photos in a folder.
fn unposed(folder: &Path) -> Option<Vec<TakenPhoto>> {
    let UnposedPhotos { folder, photos, .. } =
        UnposedPhotos::find(folder, &SceneSettings::default()).ok()??;
    Some(photos.into_iter().map(|photo| (photo.name.clone(), folder.join(&photo.name))).collect())
}

/// Every so many moments, the last one included.
fn thinned(moments: Vec<Moment>) -> Vec<Moment> {
    let every = moments.len().div_ceil(MOST_MOMENTS).max(1);
    let mut kept: Vec<Moment> = moments.into_iter().rev().step_by(every).collect();
    kept.reverse();
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_curve_is_thinned_and_keeps_its_end() {
        let at = |step| Moment { step, loss: 0.1, psnr: 20.0, splats: 5, left_out: 0.0 };
        for count in [0, 1, MOST_MOMENTS as u32, 3 * MOST_MOMENTS as u32 + 1] {
            let kept = thinned((1..=count).map(at).collect());
            assert!(kept.len() <= MOST_MOMENTS);
            assert_eq!(kept.last().map_or(0, |moment| moment.step), count);
            assert!(kept.is_sorted_by_key(|moment| moment.step));
        }
    }
}
