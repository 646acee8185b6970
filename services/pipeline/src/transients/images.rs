//! Writes and reads the mask images of transients in the run folder.

use super::authorship::{
    self, FOLDER, MADE, MaskImage, TrainPhotoFit, WrittenMask, WrittenMasks, image_files, pixel_hash,
};
use super::known::KnownTransients;
use super::odd::{crowded, odd, share_of};
use crate::{RunError, RunFolder};
use segwild_flow::{ActorFailure, Key, files};
use segwild_raster::Rasterizer;
use segwild_scene::{Mask, Scene};
use segwild_trainer::{Model, TrainPhoto};
use segwild_vision::PromptSegmenter;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::SystemTime;

/// Bytes of a mask image at most, for its hash: a photo of 100 megapixels has less.
const MOST_MASK_BYTES: u64 = 128 << 20;

/// Returns a reader of a run's transient masks, by view and in pixels of the undistorted photo. It gives `None` where
/// no mask image is or can be read.
pub(crate) fn of_run(
    folder: &RunFolder,
    scene: &Scene,
) -> impl Fn(usize) -> Option<Mask> + Send + Sync + use<> {
    let (own, files) = (folder.path().join(FOLDER), image_files(scene));
    let views = scene.views.clone();
    move |view: usize| {
        let taken = Mask::read_png(&files.find(&own, view)).ok()?;
        Some(views[view].mask_from_taken(taken))
    }
}

/// By what a mask image that was read is known to be the same later: its path, length and time.
pub(crate) type MaskImageVersion = (PathBuf, u64, SystemTime);

/// Returns the versions of what [`of_run`] reads, by view; `None` where there is no image.
pub(crate) fn versions_of_run(
    folder: &RunFolder,
    scene: &Scene,
) -> impl Fn(usize) -> Option<MaskImageVersion> + Send + Sync + use<> {
    let (own, files) = (folder.path().join(FOLDER), image_files(scene));
    move |view: usize| {
        let path = files.find(&own, view);
        let data = std::fs::metadata(&path).ok()?;
        Some((path, data.len(), data.modified().ok()?))
    }
}

/// What [`of_run`] reads, as a part of keys: a hash of the mask images. One that cannot be read counts as missing, as it does there.
pub(crate) fn digest_of_run(folder: &RunFolder, scene: &Scene) -> String {
    let (own, images) = (folder.path().join(FOLDER), image_files(scene));
    let mut hasher = blake3::Hasher::new();
    for view in 0..scene.views.len() {
        let bytes = files::read_within(&images.find(&own, view), MOST_MASK_BYTES).unwrap_or_default();
        hasher.update(blake3::hash(&bytes).as_bytes());
    }
    hasher.finalize().to_hex().to_string()
}

/// The mask image of a photo's transients, as taken; `None` where there is none or it cannot be read.
pub(crate) fn read_image(folder: &RunFolder, scene: &Scene, view: usize) -> Option<Mask> {
    Mask::read_png(&image_files(scene).find(&folder.path().join(FOLDER), view)).ok()
}

/// Writes a person's mask of a photo's transients, as taken. One with the pixels of this program's own is no correction.
pub(crate) fn write_image(
    folder: &RunFolder,
    scene: &Scene,
    view: usize,
    mask: &Mask,
) -> Result<(), RunError> {
    Ok(mask.write_png(&image_files(scene).find(&folder.path().join(FOLDER), view))?)
}

/// The damaged mask images of a run, a sentence each. Their photos are used without a mask.
pub(crate) fn damaged(folder: &RunFolder, scene: &Scene) -> Vec<String> {
    let (own, files) = (folder.path().join(FOLDER), image_files(scene));
    let files = (0..scene.views.len()).map(|view| files.find(&own, view));
    let sentence = |file: PathBuf| {
        let reason = authorship::damage_of(&file)?;
        Some(format!(
            "{} is damaged ({reason}) and is passed over; `segwild run` makes it again",
            file.display()
        ))
    };
    files.filter_map(sentence).collect()
}

/// Writes the mask images of a run's transients.
pub(crate) struct TransientMaskWriter<'a> {
    pub folder: &'a RunFolder,
    pub scene: &'a Scene,
    pub model: &'a Model,
    pub engine: &'a dyn Rasterizer,
    pub segmenter: &'a dyn PromptSegmenter,
    pub known: &'a KnownTransients,
    /// Photos that are worked on at once.
    pub at_once: usize,
}

impl TransientMaskWriter<'_> {
    /// Writes the mask images of these views that are missing or out of date. `key` names what a view's mask is made
    /// from, `photo` loads the photo, and `on_photo` is called with a photo's name before it is worked on. Returns
    /// warnings about single photos.
    ///
    /// # Errors
    /// When a photo cannot be compared or a file cannot be written; also the errors of `photo` and `on_photo`.
    pub fn write(
        &self,
        views: &[usize],
        key: impl Fn(usize) -> Key,
        photo: impl Fn(usize) -> Result<TrainPhoto, ActorFailure> + Sync,
        mut on_photo: impl FnMut(&str) -> Result<(), ActorFailure>,
    ) -> Result<Vec<String>, ActorFailure> {
        let (files, mut notes) = (image_files(self.scene), Vec::new());
        let before = WrittenMasks::of(self.folder);
        let own = self.folder.path().join(FOLDER);
        let (mut after, mut pending) = (BTreeMap::new(), Vec::new());
        for &view in views {
            let (name, mut key) = (files.name(view), key(view).to_string());
            if self.scene.views[view].photo.lens.is_some() {
                // Earlier versions wrote the masks of distorted photos in undistorted pixels.
                key += " as taken";
            }
            let written = before.of_photo(&files, view).cloned().unwrap_or_default();
            let image = authorship::inspect(&files.find(&own, view), Some(&written))
                .map_err(ActorFailure::storage)?;
            let there = match image {
                MaskImage::OfPerson(_) => {
                    after.insert(name.to_owned(), written);
                    continue;
                }
                MaskImage::OfProgram(there) => Some(there),
                MaskImage::Missing | MaskImage::Damaged(_) => None,
            };
            let file = own.join(name);
            if there.is_some() && written.key == key && file.is_file() {
                after.insert(name.to_owned(), written);
            } else {
                pending.push(PendingMask { view, name, key, file, there });
            }
        }
        let mut masks = Vec::new();
        let mut shares = Vec::new();
        for some in pending.chunks(self.at_once) {
            for &PendingMask { view, .. } in some {
                on_photo(&self.scene.views[view].name)?;
            }
            let found = self.find(some, &photo)?;
            for (PendingMask { view, name, key, file, there }, (mask, psnr)) in some.iter().zip(found) {
                notes.extend(odd(&self.scene.views[*view].name, name, &mask, psnr));
                let transient = share_of(&mask);
                shares.push(transient);
                let mask = self.scene.views[*view].mask_to_taken(mask);
                let pixels = [pixel_hash(&mask)].into_iter().chain(there.clone()).collect();
                let fit = Some(TrainPhotoFit { psnr, transient });
                after.insert((*name).to_owned(), WrittenMask { key: key.clone(), pixels, fit });
                masks.push((file, mask));
            }
        }
        notes.extend(crowded(&shares));
        // The list comes first: if the run is killed in between, an image of this program is not taken for a person's.
        self.folder.write_json(MADE, &after).map_err(ActorFailure::storage)?;
        for (file, mask) in masks {
            authorship::write(file, &mask).map_err(ActorFailure::storage)?;
        }
        Ok(notes)
    }
}

/// A mask image that is to be written.
pub(super) struct PendingMask<'a> {
    pub view: usize,
    /// Name of the image in the folder.
    name: &'a str,
    file: PathBuf,
    /// What the mask is made from.
    key: String,
    /// Hash of the pixels of the image that is there now.
    there: Option<String>,
}
