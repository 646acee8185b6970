//! The hash of each photo of a scene: what the keys of all that is made from photos start with.

use super::lpips::LpipsFile;
use crate::{RunError, Settings};
use rayon::prelude::*;
use segwild_scene::{ImportedSplats, PhotoStore, Scene, SceneError, View, file_digest};
use std::error::Error;
use std::sync::Arc;

/// Why a photo takes no part in a run: its file or one of its masks cannot be used, decoding it takes more memory than there
/// is, or the corrected mask of its transients cannot be used.
pub(crate) type PhotoRefusal = Arc<dyn Error + Send + Sync>;

/// The hash of each photo of a scene, or why the photo cannot be used.
#[derive(Clone, Debug)]
pub struct Digests {
    pub(super) photos: Vec<Result<String, PhotoRefusal>>,
    /// The hash of imported splats.
    pub(super) imported: Option<String>,
    /// The weights of LPIPS, if there are any.
    pub lpips: Option<LpipsFile>,
    /// Warnings about photos that can be used.
    pub odd: Vec<String>,
}

impl Digests {
    /// Examines every photo of the store. `digest` is [`photo_digest`] of a view, or why the view is left out.
    ///
    /// # Errors
    /// [`RunError::Interrupted`] when `stopping` returns true: many large photos take a while. When imported splats or the
    /// weights of LPIPS cannot be read.
    pub fn read(
        photos: &PhotoStore,
        digest: &(dyn Fn(usize) -> Result<String, Box<dyn Error + Send + Sync>> + Sync),
        settings: &Settings,
        stopping: &(dyn Fn() -> bool + Sync),
    ) -> Result<Digests, RunError> {
        let scene = photos.scene();
        let lpips = LpipsFile::of(settings)?;
        let examine =
            |(i, view): (usize, &View)| -> Result<(String, Option<String>), Box<dyn Error + Send + Sync>> {
                let digest = digest(i)?;
                let odd = photos.examine(i)?;
                Ok((digest, odd.map(|odd| format!("photo {}: {odd}", view.name))))
            };
        let (mut digests, mut odd) = (Vec::new(), Vec::new());
        let examined = scene.views.par_iter().enumerate();
        let until_stopped = examined.map(|view| (!stopping()).then(|| examine(view)));
        let all: Option<Vec<_>> = until_stopped.collect();
        let all = all.filter(|_| !stopping()).ok_or(RunError::Interrupted)?;
        for examined in all {
            match examined {
                Ok((digest, words)) => {
                    digests.push(Ok(digest));
                    odd.extend(words);
                }
                Err(refusal) => digests.push(Err(refusal.into())),
            }
        }
        let imported = scene.imported.as_ref().map(ImportedSplats::digest).transpose()?;
        Ok(Digests { photos: digests, imported, lpips, odd })
    }

    /// Leaves out further photos, each with its reason.
    #[must_use]
    pub fn without(mut self, refused: impl IntoIterator<Item = (usize, PhotoRefusal)>) -> Digests {
        for (view, reason) in refused {
            self.photos[view] = Err(reason);
        }
        self
    }

    /// The hashes by view; `None` where the photo cannot be read.
    pub fn all(&self) -> Vec<Option<&str>> {
        self.photos.iter().map(|d| d.as_deref().ok()).collect()
    }

    /// The reason of the first photo, if none of the photos to train on can be used.
    pub(crate) fn nothing_left(&self, scene: &Scene) -> Option<&PhotoRefusal> {
        let train = || scene.views.iter().zip(&self.photos).filter(|(view, _)| !view.test);
        let first = train().find_map(|(_, photo)| photo.as_ref().err());
        first.filter(|_| train().all(|(_, photo)| photo.is_err()))
    }
}

/// The photo's bytes and those of its masks. A mask of what to keep is marked as one: with the same file as the mask of what to
/// ignore, something else is made. So is a photo that is turned where its size does not ask for it.
pub(crate) fn photo_digest(view: &View) -> Result<String, SceneError> {
    let mut digest = view.digest()?;
    for (label, mask) in [("", &view.photo.ignore), ("keep", &view.photo.usable)] {
        let Some(mask) = mask else { continue };
        digest.push_str(label);
        digest.push_str(&file_digest(mask).map_err(SceneError::io(mask))?);
    }
    if view.photo.reading.turned {
        digest.push_str("turned");
    }
    Ok(digest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Camera, Photo, Pose};
    use std::path::Path;

    fn view(photo: &Path, ignore: Option<&Path>, usable: Option<&Path>) -> View {
        let [ignore, usable] = [ignore, usable].map(|mask| mask.map(Path::to_owned));
        let photo = Photo { ignore, usable, ..Photo::new(photo) };
        let camera = Camera { width: 4, height: 3, fx: 4.0, fy: 4.0, cx: 2.0, cy: 1.5 };
        let pose = Pose::look_at(glam::Vec3::NEG_Z, glam::Vec3::ZERO, glam::Vec3::NEG_Y);
        View { name: "0.png".into(), camera, pose, photo, test: false }
    }

    #[test]
    fn what_was_made_with_the_masks_to_keep_is_not_taken_for_that_with_the_same_masks_ignored() {
        let dir = tempfile::tempdir().unwrap();
        let (photo, mask, other) =
            (dir.path().join("0.png"), dir.path().join("m.png"), dir.path().join("n.png"));
        std::fs::write(&photo, b"photo").unwrap();
        std::fs::write(&mask, b"mask").unwrap();
        std::fs::write(&other, b"another mask").unwrap();
        let digest = |ignore, usable| photo_digest(&view(&photo, ignore, usable)).unwrap();
        let (ignored, kept) = (digest(Some(&*mask), None), digest(None, Some(&*mask)));
        assert_ne!(ignored, kept);
        assert_ne!(digest(Some(&*mask), Some(&*other)), digest(Some(&*other), Some(&*mask)));
        // The hashes of photos without masks to keep stay as they were.
        let hash = |bytes: &[u8]| blake3::hash(bytes).to_hex().to_string();
        assert_eq!(digest(None, None), hash(b"photo"));
        assert_eq!(ignored, hash(b"photo") + &hash(b"mask"));
    }

    #[test]
    fn what_was_made_of_a_photo_as_stored_is_not_taken_for_that_of_the_turned_one() {
        let dir = tempfile::tempdir().unwrap();
        let photo = dir.path().join("0.png");
        std::fs::write(&photo, b"photo").unwrap();
        let mut view = view(&photo, None, None);
        let stored = photo_digest(&view).unwrap();
        view.photo.reading.turned = true;
        assert_ne!(photo_digest(&view).unwrap(), stored);
    }
}
