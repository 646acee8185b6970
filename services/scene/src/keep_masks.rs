//! Folders of masks that other programs write: white is kept.

use crate::decode::{MEGAPIXELS, pixels_of};
use crate::draft::Draft;
use crate::locate::{folder_setting, setting};
use crate::mask_files::MaskFiles;
use crate::names::below;
use crate::photo::{bytes_of, cheap_ones};
use crate::{Mask, SceneError, SceneSettings};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Names of such folders.
const FOLDERS: [&str; 2] = ["masks", "mask"];
/// Number of masks that are checked before the folder is used.
const LOOKED_AT: usize = 8;

/// The masks of what to keep of the photos, if the scene has any: the folder that `keep_masks` names, else one that lies beside the
/// photos, as COLMAP, nerfstudio and LichtFeld write it. Adds to `notes` which masks are used, and why others are not.
pub(crate) fn find(
    folder: &Path,
    images: &Path,
    ignore: Option<&Path>,
    settings: &SceneSettings,
    draft: &Draft,
    notes: &mut Vec<String>,
) -> Result<Option<MaskFiles>, SceneError> {
    if settings.keep_masks == "none" || draft.photos.is_empty() {
        return Ok(None);
    }
    let names = || draft.photos.iter().map(|photo| photo.name.as_str());
    if let Some(dir) = folder_setting("keep_masks", &settings.keep_masks, folder)? {
        let masks = MaskFiles::new(&dir, names());
        let first = draft.photos[0].name.as_str();
        if found(&masks, names()).is_empty() {
            let reason = format!(
                "no mask in it is named after a photo; for {first} it would be {}",
                MaskFiles::wanted(first)
            );
            return Err(setting("keep_masks", settings.keep_masks.clone(), &reason));
        }
        return Ok(Some(masks));
    }
    // Where the reconstruction names masks itself, those are meant.
    if draft.photos.iter().any(|photo| photo.usable.is_some()) {
        return Ok(None);
    }
    let taken = [
        ignore.map(Path::to_owned),
        folder_setting("transient_masks", &settings.transient_masks, folder).ok().flatten(),
    ];
    let Some(dir) =
        beside(folder, images).filter(|dir| taken.iter().flatten().all(|other| !same(dir, other)))
    else {
        return Ok(None);
    };
    let masks = MaskFiles::new(&dir, names());
    let (shown, all) = (dir.display(), draft.photos.len());
    if let Some(both) = names().find_map(|photo| masks.find(photo).err()) {
        notes.push(format!("the masks in {shown} are not used: {both}"));
        return Ok(None);
    }
    let files = found(&masks, names());
    if files.is_empty() {
        if !masks.is_empty() {
            notes.push(format!(
                "{shown}: none of its files is named after a photo, and none is used as a mask"
            ));
        }
        return Ok(None);
    }
    let masked_shares = match masked_shares(&files) {
        Ok(masked_shares) => masked_shares,
        Err(error) => {
            notes.push(format!("the masks in {shown} are not used: {error}"));
            return Ok(None);
        }
    };
    notes.push(format!(
        "{} of {all} photos have a mask in {shown}: what is white in it is kept and the rest left out, as COLMAP and nerfstudio mean \
         it; `--keep-masks none` uses none of them, and `--ignore {shown}` leaves out what is white",
        files.len()
    ));
    let most = masked_shares.iter().filter(|share| **share > 0.5).count();
    if !masked_shares.is_empty() && 10 * most >= 9 * masked_shares.len() {
        notes.push(format!(
            "the masks in {shown} hide more than half of nearly every photo: if what is white is to be left out, say \
             `--ignore {shown}`"
        ));
    }
    Ok(Some(masks))
}

fn beside(folder: &Path, images: &Path) -> Option<PathBuf> {
    let bases = [Some(folder), images.parent()];
    let folders = bases.into_iter().flatten().flat_map(|base| FOLDERS.map(|name| below(base, name)));
    folders.into_iter().find(|shown| shown.is_dir() && !same(shown, images))
}

fn same(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

fn found<'a>(masks: &MaskFiles, photos: impl Iterator<Item = &'a str>) -> Vec<PathBuf> {
    photos.filter_map(|photo| masks.find(photo).ok().flatten()).collect()
}

/// The shares of the photo that some of the masks leave out; only masks that take little memory are read.
fn masked_shares<'a>(files: &'a [PathBuf]) -> Result<Vec<f64>, SceneError> {
    let with_bytes = |file: &'a PathBuf| (file, bytes_of(file, pixels_of(MEGAPIXELS)));
    let files = cheap_ones(files.par_iter().map(with_bytes).collect(), LOOKED_AT);
    let n = files.len().min(LOOKED_AT);
    let share = |k: usize| {
        let mask = Mask::read_png(files[k * files.len() / n])?;
        let pixels = f64::from(mask.width()) * f64::from(mask.height());
        Ok(1.0 - mask.count() as f64 / pixels.max(1.0))
    };
    (0..n).map(share).collect()
}
