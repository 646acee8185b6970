//! Scores a run's mask images of transients against true masks.

use super::authorship::FOLDER;
use crate::artifacts::images::{ImageFiles, OtherShape, check_shape};
use crate::{RunError, RunFolder};
use segwild_scene::{Mask, MaskFileError, MaskFiles, SceneError};
use serde::Serialize;
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Score of the transients of one photo.
#[derive(Clone, Debug, Serialize)]
pub struct TransientScore {
    /// The photo's name.
    pub photo: String,
    /// Intersection over union with the true mask; 1 where both are empty.
    pub iou: f64,
    /// Share of the photo that the true mask covers.
    pub covered: f64,
    /// Share of the photo that the run takes for transient and the true mask does not.
    pub false_share: f64,
}

/// Scores of a run's transients.
#[derive(Clone, Debug, Serialize)]
pub struct TransientScores {
    /// Mean over the photos that show transients.
    pub iou: f64,
    /// Over all pixels of all photos together.
    pub pooled_iou: f64,
    /// Mean of [`TransientScore::false_share`] over the photos.
    pub false_share: f64,
    /// Per photo.
    pub photos: Vec<TransientScore>,
    /// True masks that cannot be read or do not fit their photo, and why. Their photos do not count.
    pub unread: Vec<String>,
}

/// Why a photo is not scored.
#[derive(Debug, thiserror::Error)]
enum UnreadTruth {
    /// It is open which file is the true mask.
    #[error(transparent)]
    File(#[from] MaskFileError),
    /// One of the two masks cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The true mask has another shape than the photo.
    #[error("{} has {shape}", file.display())]
    Shape { file: PathBuf, shape: OtherShape },
}

/// Reads a run's mask image of a photo and the true mask, both in pixels of the true one.
fn compared(found: &Path, truth: &Path) -> Result<(Mask, Mask), UnreadTruth> {
    let (found, true_one) = (Mask::read_png(found)?, Mask::read_png(truth)?);
    check_shape(&true_one, "the photo", (found.width(), found.height()))
        .map_err(|shape| UnreadTruth::Shape { file: truth.to_owned(), shape })?;
    Ok((found.resized(true_one.width(), true_one.height()), true_one))
}

/// Scores a run's mask images of transients against the true masks in `truth`: one image per photo, named as the photo
/// ([`MaskFiles`]). Held-out photos do not count.
///
/// # Errors
/// When the folder is missing or holds no mask that counts. A single mask that cannot be read is listed in
/// [`TransientScores::unread`] instead.
pub fn score_transients(folder: &RunFolder, truth: &Path) -> Result<TransientScores, RunError> {
    let intake = folder.intake()?;
    if !truth.is_dir() {
        return Err(RunError::Input(format!(
            "--transient-truth {}: there is no such folder",
            truth.display()
        )));
    }
    let (mut photos, mut unread) = (Vec::new(), Vec::new());
    let (mut both, mut either) = (0.0, 0.0);
    let names = intake.photos.iter().map(String::as_str);
    let (files, truths) = (ImageFiles::of(names.clone()), MaskFiles::new(truth, names));
    let (own, held_out) = (folder.path().join(FOLDER), intake.held_out.iter().collect::<HashSet<_>>());
    for (i, photo) in intake.photos.iter().enumerate().filter(|(_, photo)| !held_out.contains(photo)) {
        let found = files.find(&own, i);
        let Some(file) = truths.find(photo).transpose().filter(|_| found.is_file()) else { continue };
        let compared = file.map_err(UnreadTruth::from).and_then(|file| compared(&found, &file));
        let (found, truth) = match compared {
            Ok(both) => both,
            Err(error) => {
                unread.push(error.to_string());
                continue;
            }
        };
        let n = f64::from(truth.width()) * f64::from(truth.height());
        both += found.overlap(&truth) as f64;
        either += found.or(&truth).count() as f64;
        photos.push(TransientScore {
            photo: photo.clone(),
            iou: if found.is_empty() && truth.is_empty() { 1.0 } else { found.iou(&truth) },
            covered: truth.count() as f64 / n,
            false_share: found.minus(&truth).count() as f64 / n,
        });
    }
    if photos.is_empty() {
        let reason = format!(
            "--transient-truth {}: it holds no true mask of a photo of this run whose transients were looked for",
            truth.display()
        );
        return Err(RunError::no_truth(reason, &unread));
    }
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len().max(1) as f64;
    Ok(TransientScores {
        iou: mean(photos.iter().filter(|p| p.covered > 0.0).map(|p| p.iou).collect()),
        pooled_iou: if either > 0.0 { both / either } else { 1.0 },
        false_share: mean(photos.iter().map(|p| p.false_share).collect()),
        photos,
        unread,
    })
}
