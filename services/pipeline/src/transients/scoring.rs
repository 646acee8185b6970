//! Scores a run's mask images of transients against true masks.

use super::authorship::FOLDER;
use crate::artifacts::images::{ImageFiles, same_shape};
use crate::{RunError, RunFolder};
use segwild_scene::{Mask, MaskFiles};
use serde::Serialize;
use std::collections::HashSet;
use std::path::Path;

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

/// Reads a run's mask image of a photo and the true mask, both in pixels of the true one.
fn compared(found: &Path, truth: &Path) -> Result<(Mask, Mask), String> {
    let read = |file: &Path| Mask::read_png(file).map_err(|e| e.to_string());
    let (found, true_one) = (read(found)?, read(truth)?);
    let (w, h) = (true_one.width(), true_one.height());
    if !same_shape((w, h), (found.width(), found.height())) {
        let (pw, ph) = (found.width(), found.height());
        return Err(format!(
            "{} has {w} x {h} pixels, which does not fit the photo's {pw} x {ph}",
            truth.display()
        ));
    }
    Ok((found.resized(w, h), true_one))
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
        let file = truths.find(photo).map_err(|e| e.to_string());
        let Some(file) = file.transpose().filter(|_| found.is_file()) else { continue };
        let (found, truth) = match file.and_then(|file| compared(&found, &file)) {
            Ok(both) => both,
            Err(reason) => {
                unread.push(reason);
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
        let mut reason = format!(
            "--transient-truth {}: it holds no true mask of a photo of this run whose transients were looked for",
            truth.display()
        );
        if let Some(first) = unread.first() {
            reason += &format!("; {} could not be read, the first: {first}", unread.len());
        }
        return Err(RunError::Input(reason));
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
