//! Opening a scene: find what is there, check it against the photos, normalise.

mod check;
mod points;
mod words;

use self::check::{CheckedPhoto, PhotoChecks, UnusablePhoto, check, has_mask};
use crate::draft::Draft;
use crate::frame::Placing;
use crate::locate::{FoundScene, find, folder_setting, locate, setting, unheld};
use crate::mask_files::MaskFiles;
use crate::photo_files::LocateError;
use crate::split::{Split, SplitPart};
use crate::statistics::upper_median;
use crate::{
    HoldOut, ImportedSplats, PosedPhotos, Scene, SceneError, SceneFrame, SceneSettings, Skipped, SplatFile,
    View,
};
use crate::{alpha, keep_masks, orientation};
use image::metadata::Orientation;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

impl Scene {
    /// Opens the scene in folder `path`: a COLMAP reconstruction (also a Photo Tourism folder with its split) or
    /// nerfstudio's `transforms.json`, which may also be named itself.
    ///
    /// Photos that cannot be used are listed in [`Scene::skipped`] with the reason and the rest goes on. Only the heads
    /// of the photos are read here; [`View::load`] reads the pixels. The exceptions are a few masks, a few photos that may
    /// be cut-outs, and photos whose EXIF orientation their size leaves open: they are decoded a few at a time, and none that takes
    /// much memory.
    pub fn open(path: &Path, settings: &SceneSettings) -> Result<Scene, SceneError> {
        Scene::of(find(path, settings)?, settings)
    }

    /// Opens the scene of photos whose poses another program computed.
    ///
    /// # Errors
    /// As [`Scene::open`].
    pub fn open_posed(posed: PosedPhotos, settings: &SceneSettings) -> Result<Scene, SceneError> {
        Scene::of(FoundScene::posed(posed)?, settings)
    }

    fn of(found: FoundScene, settings: &SceneSettings) -> Result<Scene, SceneError> {
        let FoundScene { folder, mut draft, images, unposed } = found;
        let ignore = folder_setting("ignore", &settings.ignore, &folder)?;
        if settings.size == 0 {
            return Err(setting("size", "0".into(), "photos need at least one pixel"));
        }
        let located = locate(&mut draft, &images);
        if unposed.is_none() {
            draft.notes.extend(unheld(&draft, &located));
        }
        let draft = draft;
        let mut notes = Vec::new();
        let names: Vec<&str> = draft.photos.iter().map(|p| p.name.as_str()).collect();
        let model = Some(&*draft.source).filter(|source| source.is_dir() && **source != folder);
        let near: Vec<&Path> = [folder.as_path()].into_iter().chain(model).collect();
        let split = Split::find(&near, settings, &names, draft.split.clone(), &mut notes)?;
        let keep = keep_masks::find(&folder, &images, ignore.as_deref(), settings, &draft, &mut notes)?;
        let ignored = ignore.as_ref().map(|folder| MaskFiles::new(folder, names.iter().copied()));

        let mut skipped = unposed.unwrap_or_default();
        if let Some(split) = &split {
            skip_unposed(split, &names, &mut skipped);
        }
        let checks =
            PhotoChecks { ignored: ignored.as_ref(), keep: keep.as_ref(), split: split.as_ref(), settings };
        let mut usable = usable_photos(&draft, located, &checks, &mut skipped);
        let placed = usable.values().filter_map(|(i, checked)| checked.placed(*i, &draft)).collect();
        let mut placing = Placing::new(&draft, placed);
        for (photo, reason) in placing.take_misplaced() {
            let name = draft.photos[photo].name.as_str();
            usable.remove(name);
            skipped.push(Skipped { name: name.to_owned(), reason });
        }
        skipped.sort_by(|a, b| a.name.cmp(&b.name));
        if usable.is_empty() {
            return Err(words::nothing_usable(&draft, &skipped));
        }
        if let Some(folder) = &ignore {
            refuse_unused_masks(folder, ignored.as_ref(), &usable, &skipped)?;
        }

        let frame = placing.frame();
        let outliers = placing.outliers(&frame);
        let PlacedViews { mut views, view_of, ambiguous, copied } =
            PlacedViews::of(usable, draft.photos.len(), &frame);
        hold_out(&mut views, split.as_ref(), settings.hold_out)?;
        refuse_masked_out(&views, &draft.source)?;
        let points = points::points(&draft, &views, &view_of, &frame, &outliers);
        let orientations = orientation::decide(&mut views, &points, &ambiguous);
        let cut_outs = alpha::decide(&mut views, settings);
        tracing::debug!(
            views = views.len(),
            skipped = skipped.len(),
            points = points.len(),
            points_dropped = draft.points.len() - points.len(),
            source = %draft.source.display(),
            "scene opened"
        );
        notes.extend(match &split {
            Some(split) => Some(words::split_in_words(split, &views, &draft, settings)),
            None if settings.hold_out == HoldOut::Auto => words::held_out_in_words(&views),
            None => None,
        });
        notes.extend(words::notes(&draft, views.len(), points.len(), &view_of));
        notes.extend(words::copies(copied).into_iter().chain(cut_outs).chain(orientations));
        let of_source = |words: String| format!("{}: {words}", draft.source.display());
        notes.extend(placing.notes(&frame, &outliers).into_iter().map(of_source));
        let imported = match &*settings.imported_splats {
            "" => None,
            path => {
                let file = SplatFile::open(Path::new(path))?;
                let rendered = file.is_rendered_in(&folder)?;
                Some(ImportedSplats { file, frame: settings.imported_frame.clone(), rendered })
            }
        };
        let mut scene = Scene { views, points, skipped, notes, frame, imported };
        scene.notes.extend(scene.about_colours().map(of_source));
        Ok(scene)
    }
}

/// The photos that can be used, by name; each with its index in the draft.
type UsablePhotos<'a> = BTreeMap<&'a str, (usize, CheckedPhoto)>;

/// Skips the photos that a split lists and the reconstruction does not have, but for those that are skipped already.
fn skip_unposed(split: &Split, names: &[&str], skipped: &mut Vec<Skipped>) {
    let known: HashSet<String> = skipped.iter().map(|photo| photo.name.clone()).collect();
    for (name, part) in split.unmatched(names) {
        if known.contains(name) {
            continue;
        }
        let why = if *part == SplitPart::NoPose { "the split has no pose of it" } else { "it has no pose" };
        let reason = format!("{why}: the reconstruction did not place it");
        skipped.push(Skipped { name: name.clone(), reason });
    }
}

/// Checks the photos of a draft, each by itself and all against each other. Skips those that cannot be used.
fn usable_photos<'a>(
    draft: &'a Draft,
    located: Vec<Result<PathBuf, LocateError>>,
    checks: &PhotoChecks<'_>,
    skipped: &mut Vec<Skipped>,
) -> UsablePhotos<'a> {
    let mut skip = |name: &str, reason: String| skipped.push(Skipped { name: name.to_owned(), reason });
    let held: HashSet<PathBuf> = located.iter().flatten().cloned().collect();
    let checked: Vec<Result<CheckedPhoto, UnusablePhoto>> =
        draft.photos.par_iter().zip(located).map(|(photo, path)| check(photo, path, &held, checks)).collect();
    let mut usable = UsablePhotos::new();
    for (i, (photo, checked)) in draft.photos.iter().zip(checked).enumerate() {
        match checked {
            Err(error) => skip(&photo.name, error.to_string()),
            Ok(_) if usable.contains_key(photo.name.as_str()) => {
                skip(&photo.name, "another photo of the reconstruction has the same name".into());
            }
            Ok(checked) => {
                usable.insert(&photo.name, (i, checked));
            }
        }
    }
    for (name, reason) in far_off(&usable) {
        usable.remove(name);
        skip(name, reason);
    }
    usable
}

/// Refuses a folder of masks in which none is named after a photo.
fn refuse_unused_masks(
    folder: &Path,
    ignored: Option<&MaskFiles>,
    usable: &UsablePhotos<'_>,
    skipped: &[Skipped],
) -> Result<(), SceneError> {
    let used = usable.values().any(|(_, checked)| checked.photo.ignore.is_some());
    if used || skipped.iter().any(|photo| has_mask(ignored, &photo.name)) {
        return Ok(());
    }
    let name = usable.keys().next().copied().unwrap_or_default();
    let reason =
        format!("no mask in it is named after a photo; for {name} it would be {}", MaskFiles::wanted(name));
    Err(setting("ignore", folder.display().to_string(), &reason))
}

/// The views of a scene, as their photos become them.
struct PlacedViews {
    views: Vec<View>,
    /// The view of each photo of the draft.
    view_of: Vec<Option<u32>>,
    /// Views that their size does not tell from turned ones, with their EXIF orientation.
    ambiguous: Vec<(usize, Orientation)>,
    /// What to say of photos for which a converted copy stands.
    copied: Vec<String>,
}

impl PlacedViews {
    /// The views of these photos; the draft has `photos` of them.
    fn of(usable: UsablePhotos<'_>, photos: usize, frame: &SceneFrame) -> PlacedViews {
        let mut all = PlacedViews {
            views: Vec::with_capacity(usable.len()),
            view_of: vec![None; photos],
            ambiguous: Vec::new(),
            copied: Vec::new(),
        };
        for (name, (i, checked)) in usable {
            let view = all.views.len();
            all.view_of[i] = Some(view as u32);
            all.ambiguous.extend(checked.ambiguous.map(|orientation| (view, orientation)));
            all.copied.extend(checked.copied.clone());
            all.views.push(checked.into_view(name, frame));
        }
        all
    }
}

/// Refuses masks that leave nothing of any photo that is trained on.
fn refuse_masked_out(views: &[View], source: &Path) -> Result<(), SceneError> {
    let train = || views.iter().filter(|view| !view.test);
    let Some(first) = train().next() else { return Ok(()) };
    if !train().all(View::is_masked_out) {
        return Ok(());
    }
    let reason =
        format!("the masks of things to ignore leave nothing of any photo; the first is {}", first.name);
    Err(SceneError::NothingUsable { path: source.to_owned(), reason })
}

/// Photos whose focal length is so far from the others' that the reconstruction went wrong there: one alone distorts the depth
/// range of all.
fn far_off<'a>(usable: &UsablePhotos<'a>) -> Vec<(&'a str, String)> {
    let ratio = |c: &CheckedPhoto| {
        f64::from(c.camera.fx.max(c.camera.fy) / c.camera.width.max(c.camera.height) as f32)
    };
    let usual = upper_median(usable.values().map(|(_, c)| ratio(c)).collect()).unwrap_or(1.0);
    let far = |c: &CheckedPhoto| usable.len() > 3 && !(usual / FAR_OFF..=usual * FAR_OFF).contains(&ratio(c));
    let reason = |c: &CheckedPhoto| {
        format!(
            "its camera has a focal length of {:.1} photo lengths where {usual:.1} is usual here: the reconstruction went wrong there",
            ratio(c)
        )
    };
    usable.iter().filter(|(_, (_, c))| far(c)).map(|(name, (_, c))| (*name, reason(c))).collect()
}

/// How many times the usual focal length a photo's may be: a telephoto lens has twenty times that of the widest.
const FAR_OFF: f64 = 20.0;

/// A scene of so many photos has one in as many held out, where nothing says which: fewer are better trained on all.
const FEW_HELD_OUT: usize = 16;

/// Marks the views that are held out of the training.
fn hold_out(views: &mut [View], split: Option<&Split>, which: HoldOut) -> Result<(), SceneError> {
    let n = views.len();
    for (i, view) in views.iter_mut().enumerate() {
        view.test = match (which, split) {
            (HoldOut::Every(every), _) => every > 0 && i % every as usize == 0,
            (_, Some(split)) => split.part(&view.name) == Some(SplitPart::Test),
            (HoldOut::None, None) => false,
            // From the middle of each sixteen: at the ends of a capture few other photos show the same.
            (HoldOut::Auto, None) => n >= FEW_HELD_OUT && i % FEW_HELD_OUT == FEW_HELD_OUT / 2,
        };
    }
    if views.iter().all(|v| v.test) {
        let n = views.len();
        return Err(match (which, split) {
            (HoldOut::Auto | HoldOut::None, Some(split)) => SceneError::NothingUsable {
                path: split.path.clone(),
                reason: format!("all {n} usable photos are for testing; none is left to train on"),
            },
            _ => setting(
                "hold_out",
                which.to_string(),
                &format!("of {n} usable photos none is left to train on"),
            ),
        });
    }
    Ok(())
}
