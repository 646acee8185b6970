//! Masks of transients that a person has corrected.

use super::authorship::{self, FOLDER, MaskImage, WrittenMasks, image_files, pixel_hash};
use crate::artifacts::digests::PhotoRefusal;
use crate::artifacts::images::{OtherShape, check_shape};
use crate::{RunError, RunFolder};
use segwild_scene::{Mask, MaskFileError, MaskFiles, Scene, SceneError, View, named_and_counted};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Corrected masks, by view.
#[derive(Clone, Debug, Default)]
pub struct Corrections {
    found: Vec<Option<Correction>>,
    /// Damaged mask images of the run folder, and what is wrong with each.
    damaged: Vec<(PathBuf, String)>,
    /// Views whose corrected mask cannot be used, and why. They are not trained on: what the mask leaves out would show.
    unusable: Vec<(usize, Arc<UnusableCorrection>)>,
}

#[derive(Clone, Debug)]
struct Correction {
    file: PathBuf,
    /// In pixels of the undistorted photo.
    mask: Mask,
    digest: String,
}

/// A corrected mask of the folder of `--transient-masks` that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("its mask in --transient-masks {folder} cannot be used: {source}")]
struct UnusableCorrection {
    /// The folder.
    folder: String,
    /// Why.
    source: CorrectionError,
}

/// Why a corrected mask cannot be used.
#[derive(Debug, thiserror::Error)]
enum CorrectionError {
    /// It is open which file it is.
    #[error(transparent)]
    File(#[from] MaskFileError),
    /// It cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// It has another shape than its photo.
    #[error("{}: it has {shape}", file.display())]
    Shape { file: PathBuf, shape: OtherShape },
}

impl Corrections {
    /// Finds the masks that a person made or changed: in the folder `named` by `--transient-masks`, else in the run
    /// folder. An empty `named` stands for no folder. [`Corrections::unusable`] lists the masks of the named folder
    /// that cannot be read or do not fit their photo.
    ///
    /// # Errors
    /// When the named folder is missing or holds no mask of a photo, and when a corrected mask of the run folder does
    /// not fit its photo.
    pub fn find(scene: &Scene, folder: &RunFolder, named: &str) -> Result<Corrections, RunError> {
        if !named.is_empty() && !Path::new(named).is_dir() {
            return Err(RunError::Request(format!("--transient-masks {named}: there is no such folder")));
        }
        let (files, written) = (image_files(scene), WrittenMasks::of(folder));
        let own = folder.path().join(FOLDER);
        let photos = scene.views.iter().map(|v| v.name.as_str());
        let named_files = (!named.is_empty()).then(|| MaskFiles::new(Path::new(named), photos));
        let mut corrections = Corrections::default();
        for (i, view) in scene.views.iter().enumerate() {
            let given = named_files.as_ref().map_or(Ok(None), |files| files.find(&view.name));
            let given = given.map_err(CorrectionError::from);
            let given = given.and_then(|file| file.map(|file| read(file, view)).transpose());
            let file = files.find(&own, i);
            let of_own = match authorship::inspect(&file, written.of_photo(&files, i))? {
                MaskImage::OfPerson(mask) => {
                    let misfit =
                        |shape| RunError::Folder { path: file.clone(), reason: format!("it has {shape}") };
                    Some(Correction::of(file.clone(), mask, view).map_err(misfit)?)
                }
                MaskImage::Damaged(reason) => {
                    corrections.damaged.push((file, reason));
                    None
                }
                MaskImage::Missing | MaskImage::OfProgram(_) => None,
            };
            match given {
                Ok(given) => corrections.found.push(given.or(of_own)),
                Err(source) => {
                    let unusable = UnusableCorrection { folder: named.to_owned(), source };
                    corrections.unusable.push((i, Arc::new(unusable)));
                    corrections.found.push(None);
                }
            }
        }
        let of_named = |c: &Correction| c.file.starts_with(named);
        let some =
            corrections.unusable.len() + corrections.found.iter().flatten().filter(|c| of_named(c)).count();
        if !named.is_empty() && some == 0 {
            let reason = "it holds no mask with the name of a photo of this scene";
            return Err(RunError::Request(format!("--transient-masks {named}: {reason}")));
        }
        Ok(corrections)
    }

    /// Views whose corrected mask cannot be used, each with the reason. A run leaves these photos out.
    pub fn unusable(&self) -> impl Iterator<Item = (usize, PhotoRefusal)> {
        self.unusable.iter().map(|(view, reason)| (*view, reason.clone() as PhotoRefusal))
    }

    /// Moves the damaged mask images aside, so that they are made again. Returns a sentence for each.
    ///
    /// # Errors
    /// When one cannot be moved.
    pub fn put_damaged_aside(&self) -> Result<Vec<String>, RunError> {
        authorship::put_aside(&self.damaged)
    }

    /// Per view, the hash of its corrected mask, for the keys of what is made with it.
    pub fn digests(&self) -> Vec<Option<&str>> {
        self.found.iter().map(|one| Some(one.as_ref()?.digest.as_str())).collect()
    }

    /// Hash of all corrected masks; `None` when there is none.
    pub fn digest_of_all(&self) -> Option<String> {
        let mut hasher = blake3::Hasher::new();
        for (view, one) in self.found.iter().enumerate() {
            if let Some(one) = one {
                hasher.update(format!("{view} {}\n", one.digest).as_bytes());
            }
        }
        self.found.iter().any(Option::is_some).then(|| hasher.finalize().to_hex()[..32].to_owned())
    }

    /// A view's corrected mask, scaled to `width` x `height` pixels of the undistorted photo.
    pub fn mask(&self, view: usize, width: u32, height: u32) -> Option<Mask> {
        Some(self.found.get(view)?.as_ref()?.mask.resized(width, height))
    }

    /// The photos that have a corrected mask, in words; `None` when none has.
    pub fn in_words(&self, scene: &Scene) -> Option<String> {
        let names: Vec<&str> = (0..self.found.len())
            .filter(|&view| self.found[view].is_some())
            .map(|view| scene.views[view].name.as_str())
            .collect();
        (!names.is_empty())
            .then(|| format!("transients as they were put right by hand: {}", named_and_counted(&names)))
    }
}

impl Correction {
    fn of(file: PathBuf, mask: Mask, view: &View) -> Result<Correction, OtherShape> {
        check_shape(&mask, &view.name, (view.camera.width, view.camera.height))?;
        Ok(Correction { digest: pixel_hash(&mask), file, mask: view.mask_from_taken(mask) })
    }
}

/// Reads a corrected mask.
fn read(file: PathBuf, view: &View) -> Result<Correction, CorrectionError> {
    let mask = Mask::read_png(&file)?;
    Correction::of(file.clone(), mask, view).map_err(|shape| CorrectionError::Shape { file, shape })
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Camera, Photo, Pose};

    fn view(photo: &Path) -> View {
        let name = photo.file_name().unwrap().to_string_lossy().into_owned();
        let photo = Photo::new(photo);
        let camera = Camera { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 20.0, cy: 15.0 };
        let pose = Pose::look_at(glam::Vec3::NEG_Z, glam::Vec3::ZERO, glam::Vec3::NEG_Y);
        View { name, camera, pose, photo, test: false }
    }

    #[test]
    fn one_unusable_mask_of_a_named_folder_leaves_out_that_photo_by_name() {
        let dir = tempfile::tempdir().unwrap();
        let views = ["a.jpg", "b.jpg", "c.jpg", "d.jpg"].map(|name| view(&dir.path().join(name))).to_vec();
        let scene = Scene::new(views, Vec::new());
        let (named, run) = (dir.path().join("named"), RunFolder::create(&dir.path().join("run")).unwrap());
        std::fs::create_dir(&named).unwrap();
        Mask::full(40, 30).write_png(&named.join("a.png")).unwrap();
        Mask::full(50, 50).write_png(&named.join("b.png")).unwrap();
        std::fs::write(named.join("c.png"), b"no image").unwrap();
        let found = Corrections::find(&scene, &run, &named.to_string_lossy()).unwrap();
        let reasons: Vec<(usize, String)> = found.unusable().map(|(i, why)| (i, why.to_string())).collect();
        assert!(
            matches!(&reasons[..], [(1, b), (2, c)] if b.contains("b.png: it has 50 x 50") && c.contains("c.png")),
            "{reasons:?}"
        );
        let digests: Vec<bool> = found.digests().iter().map(Option::is_some).collect();
        assert_eq!(digests, [true, false, false, false]);
    }
}
