//! Opening a scene: find what is there, check it against the photos, normalise.

use crate::decode::{self, ImageHead, pixels_of};
use crate::draft::{Draft, DraftLensError, DraftPhoto, DraftPoint, DraftPose, PoseError};
use crate::frame::{Placed, Placing};
use crate::locate::{FoundScene, find, folder_setting, locate, setting, unheld};
use crate::mask_files::MaskFiles;
use crate::names::is_inside;
use crate::photo_files::LocateError;
use crate::split::{Split, SplitPart};
use crate::statistics::upper_median;
use crate::{
    DARKEST, DecodeError, HoldOut, ImportedSplats, MaskFileError, Observation, Photo, PhotoError, Point,
    Pose, PosedPhotos, Reading, Scene, SceneError, SceneFrame, SceneSettings, Seal, Skipped, SplatFile, View,
};
use crate::{alpha, keep_masks, orientation};
use glam::{Mat3, Vec3};
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
        let mut remarks = Vec::new();
        let names: Vec<&str> = draft.photos.iter().map(|p| p.name.as_str()).collect();
        let model = Some(&*draft.source).filter(|source| source.is_dir() && **source != folder);
        let near: Vec<&Path> = [folder.as_path()].into_iter().chain(model).collect();
        let split = Split::find(&near, settings, &names, draft.split.clone(), &mut remarks)?;
        let keep = keep_masks::find(&folder, &images, ignore.as_deref(), settings, &draft, &mut remarks)?;
        let ignored = ignore.as_ref().map(|folder| MaskFiles::new(folder, names.iter().copied()));

        let mut skipped = unposed.unwrap_or_default();
        let reasons_known: HashSet<String> = skipped.iter().map(|photo| photo.name.clone()).collect();
        let mut skip = |name: &str, reason: String| skipped.push(Skipped { name: name.to_owned(), reason });
        if let Some(split) = &split {
            for (name, part) in split.unmatched(&names) {
                if reasons_known.contains(name) {
                    continue;
                }
                let why =
                    if *part == SplitPart::NoPose { "the split has no pose of it" } else { "it has no pose" };
                skip(name, format!("{why}: the reconstruction did not place it"));
            }
        }
        let held: HashSet<PathBuf> = located.iter().flatten().cloned().collect();
        let checked: Vec<Result<CheckedPhoto, UnusablePhoto>> = draft
            .photos
            .par_iter()
            .zip(located)
            .map(|(photo, path)| {
                check(photo, path, &held, ignored.as_ref(), keep.as_ref(), split.as_ref(), settings)
            })
            .collect();
        let mut usable: BTreeMap<&str, (usize, CheckedPhoto)> = BTreeMap::new();
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
        let placed = usable.values().filter_map(|(i, checked)| checked.placed(*i, &draft)).collect();
        let mut placing = Placing::new(&draft, placed);
        for (photo, reason) in placing.take_misplaced() {
            let name = draft.photos[photo].name.as_str();
            usable.remove(name);
            skip(name, reason);
        }
        skipped.sort_by(|a, b| a.name.cmp(&b.name));
        if usable.is_empty() {
            return Err(nothing_usable(&draft, &skipped));
        }
        if let Some(folder) = &ignore
            && usable.values().all(|(_, c)| c.photo.ignore.is_none())
            && !skipped.iter().any(|s| has_mask(ignored.as_ref(), &s.name))
        {
            let name = usable.keys().next().copied().unwrap_or_default();
            let reason = format!(
                "no mask in it is named after a photo; for {name} it would be {}",
                MaskFiles::wanted(name)
            );
            return Err(setting("ignore", folder.display().to_string(), &reason));
        }

        let frame = placing.frame();
        let outliers = placing.outliers(&frame);
        let copied: Vec<String> = usable.values().filter_map(|(_, c)| c.copied.clone()).collect();
        let mut view_of = vec![None; draft.photos.len()];
        let mut views = Vec::with_capacity(usable.len());
        let mut ambiguous: Vec<(usize, Orientation)> = Vec::new();
        for (name, (i, checked)) in usable {
            view_of[i] = Some(views.len() as u32);
            ambiguous.extend(checked.ambiguous.map(|orientation| (views.len(), orientation)));
            views.push(checked.into_view(name, &frame));
        }
        hold_out(&mut views, split.as_ref(), settings.hold_out)?;
        if let Some(first) = views.iter().find(|v| !v.test)
            && views.iter().filter(|v| !v.test).all(View::is_masked_out)
        {
            let reason = format!(
                "the masks of things to ignore leave nothing of any photo; the first is {}",
                first.name
            );
            return Err(SceneError::NothingUsable { path: draft.source.clone(), reason });
        }
        let lenses: Vec<_> = draft.photos.iter().map(|p| p.lens.as_ref().ok()).collect();
        let points: Vec<Point> = draft
            .points
            .par_iter()
            .zip(&outliers)
            .filter_map(|(point, &outlier)| {
                if !point.position.is_finite() || outlier {
                    return None;
                }
                let position = ((point.position - frame.origin) / frame.scale).as_vec3();
                let seen = |&(photo, pixel): &(usize, Option<[f64; 2]>)| {
                    let (view, lens) = (view_of[photo]?, lenses[photo]?);
                    let pixel = observed(&views[view as usize], lens, position, pixel)?;
                    Some(Observation { view, pixel })
                };
                let mut track: Vec<Observation> = point.track.iter().filter_map(seen).collect();
                // Of several sightings in one photo the first counts.
                track.sort_by_key(|o| o.view);
                track.dedup_by_key(|o| o.view);
                // A point that only unusable photos saw is of no use; one without a track is taken as it is.
                let lost =
                    !point.track.is_empty() && point.track.iter().all(|(photo, _)| view_of[*photo].is_none());
                let colour = point.colour.map(|c| (f32::from(c) / 255.0).max(DARKEST));
                (position.is_finite() && !lost).then_some(Point { position, colour, track })
            })
            .collect();
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
        remarks.extend(split.iter().map(|split| split_in_words(split, &views, &draft, settings)));
        let held_out = views.iter().filter(|view| view.test).count();
        if held_out > 0 && split.is_none() && settings.hold_out == HoldOut::Auto {
            remarks.push(format!(
                "{held_out} of {} photos are held out of the training, to be scored; `--hold-out none` trains on all",
                views.len()
            ));
        }
        remarks.extend(notes(&draft, views.len(), points.len(), &view_of));
        let mut notes = remarks;
        notes.extend(copies(copied).into_iter().chain(cut_outs).chain(orientations));
        notes.extend(
            placing
                .notes(&frame, &outliers)
                .into_iter()
                .map(|words| format!("{}: {words}", draft.source.display())),
        );
        let imported = match &*settings.imported_splats {
            "" => None,
            file => Some(ImportedSplats {
                file: SplatFile::open(Path::new(file))?,
                frame: settings.imported_frame.clone(),
            }),
        };
        let mut scene = Scene { views, points, skipped, notes, frame, imported };
        scene.notes.extend(scene.about_colours().map(|words| format!("{}: {words}", draft.source.display())));
        Ok(scene)
    }
}

/// Photos whose focal length is so far from the others' that the reconstruction went wrong there: one alone distorts the depth
/// range of all.
fn far_off<'a>(usable: &BTreeMap<&'a str, (usize, CheckedPhoto)>) -> Vec<(&'a str, String)> {
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

/// What to say of photos that are read from a converted copy: the first, and how many more there are.
fn copies(copied: Vec<String>) -> Option<String> {
    match copied.len() {
        0 => None,
        1 => copied.into_iter().next(),
        n => copied.first().map(|first| format!("{first}, and {} more photos from theirs", n - 1)),
    }
}

/// What is odd about a reconstruction, though it can be used.
fn notes(draft: &Draft, views: usize, points: usize, view_of: &[Option<u32>]) -> Vec<String> {
    let mut notes = draft.notes.clone();
    let (source, all) = (draft.source.display(), draft.points.len());
    let count = |odd: &dyn Fn(&DraftPoint) -> bool| draft.points.iter().filter(|p| odd(p)).count();
    let broken = count(&|p| !p.position.is_finite());
    if broken > 0 {
        notes.push(format!(
            "{source}: {broken} of {all} points lie nowhere (a position is no number) and are left out"
        ));
    }
    let lost = count(&|p| !p.track.is_empty() && p.track.iter().all(|(photo, _)| view_of[*photo].is_none()));
    if lost > 0 {
        notes.push(format!(
            "{source}: {lost} of {all} points were seen by unusable photos alone and are left out"
        ));
    }
    let unseen = count(&|p| p.track.is_empty());
    // nerfstudio's points never say who saw them.
    if unseen > 0 && (unseen < all || draft.source.extension().is_none_or(|e| e != "json")) {
        notes.push(format!(
            "{source}: {unseen} of {all} points name no photo that sees them: they start splats, but do not help to find any \
             photo's light or transients"
        ));
    }
    if points == 0 {
        notes.push(format!("{source}: there are no points: the training starts from random splats"));
    }
    if views == 1 {
        notes.push(
            "there is one photo: nothing tells how far away things are, so only views close to it will look right".into(),
        );
    }
    notes
}

/// Why a photo of the reconstruction takes no part.
#[derive(Debug, thiserror::Error)]
enum UnusablePhoto {
    #[error("its name is not that of a file inside the photo folder")]
    OutsideName,
    #[error("it is not listed in the split {}", .0.display())]
    NotInSplit(PathBuf),
    #[error("the split {} keeps it for validation", .0.display())]
    Validation(PathBuf),
    #[error("the split {} gives it no id", .0.display())]
    NoId(PathBuf),
    /// It has no file.
    #[error(transparent)]
    Locate(#[from] LocateError),
    #[error("there is no file {}", .0.display())]
    NoFile(PathBuf),
    #[error(transparent)]
    Photo(#[from] PhotoError),
    #[error(transparent)]
    Pose(#[from] PoseError),
    #[error(transparent)]
    Lens(#[from] DraftLensError),
    #[error(
        "its lens cannot be right: of the undistorted image only {percent:.0} % can be filled from the photo"
    )]
    Folded { percent: f64 },
    /// Two files may be its mask.
    #[error(transparent)]
    MaskFile(#[from] MaskFileError),
    #[error("there is no file {}, which is to be its mask", .0.display())]
    NoMask(PathBuf),
    #[error("its mask {}: {reason}", mask.display())]
    Mask { mask: PathBuf, reason: DecodeError },
}

impl From<DecodeError> for UnusablePhoto {
    fn from(error: DecodeError) -> UnusablePhoto {
        UnusablePhoto::Photo(error.into())
    }
}

/// A photo that passed every check.
struct CheckedPhoto {
    photo: Photo,
    camera: crate::Camera,
    pose: DraftPose,
    /// What to say where a converted copy stands for the photo.
    copied: Option<String>,
    /// Its EXIF orientation, where its size does not decide whether the poses are of the turned pixels.
    ambiguous: Option<Orientation>,
}

impl CheckedPhoto {
    /// Where it stands; `photo` is its index in the draft.
    fn placed<'a>(&self, photo: usize, draft: &'a Draft) -> Option<Placed<'a>> {
        let lens = draft.photos[photo].lens.as_ref().ok()?;
        Some(Placed { photo, pose: self.pose, camera: self.camera, lens })
    }

    fn into_view(self, name: &str, frame: &SceneFrame) -> View {
        let rotation = self.pose.rotation;
        let centre = (self.pose.centre - frame.origin) / frame.scale;
        let pose = Pose {
            rotation: Mat3::from_cols_array(&rotation.to_cols_array().map(|v| v as f32)),
            translation: (-(rotation * centre)).as_vec3(),
        };
        View { name: name.to_owned(), camera: self.camera, pose, photo: self.photo, test: false }
    }
}

/// Whether a mask is named after the photo.
fn has_mask(masks: Option<&MaskFiles>, photo: &str) -> bool {
    masks.is_some_and(|masks| !matches!(masks.find(photo), Ok(None)))
}

fn check(
    photo: &DraftPhoto,
    path: Result<PathBuf, LocateError>,
    held: &HashSet<PathBuf>,
    ignored: Option<&MaskFiles>,
    keep: Option<&MaskFiles>,
    split: Option<&Split>,
    settings: &SceneSettings,
) -> Result<CheckedPhoto, UnusablePhoto> {
    if !is_inside(&photo.name) {
        path?;
        return Err(UnusablePhoto::OutsideName);
    }
    match split.map(|s| (s, s.part(&photo.name))) {
        Some((s, None)) => return Err(UnusablePhoto::NotInSplit(s.path.clone())),
        Some((s, Some(SplitPart::Validation))) => return Err(UnusablePhoto::Validation(s.path.clone())),
        Some((s, Some(SplitPart::NoPose))) => return Err(UnusablePhoto::NoId(s.path.clone())),
        _ => {}
    }
    let pose = photo.pose.clone()?;
    let (path, head, copied) = readable(path?, held, settings)?;
    let mask = |masks: Option<&MaskFiles>| masks.map_or(Ok(None), |masks| masks.find(&photo.name));
    let ignore = mask(ignored)?;
    let usable = match &photo.usable {
        Some(mask) => Some(mask.clone()),
        None => mask(keep)?,
    };
    let files = [Some(&path), ignore.as_ref(), usable.as_ref()];
    let seal = Seal::on(files.into_iter().flatten().map(PathBuf::as_path));
    let lens = photo.lens.as_ref().map_err(DraftLensError::clone)?;
    let (width, height) = head.size_for(lens.width(), lens.height())?;
    let lens = lens.resized(width, height);
    let filled = lens.filled();
    if filled < HALF {
        return Err(UnusablePhoto::Folded { percent: 100.0 * filled });
    }
    let camera = lens.pinhole();
    if let Some(mask) = usable.as_ref().filter(|mask| !mask.is_file()) {
        return Err(UnusablePhoto::NoMask(mask.clone()));
    }
    let most_pixels = pixels_of(settings.max_megapixels);
    let mut bytes = head.photo_bytes(&camera, lens.is_distorted(), settings.size);
    for mask in [&ignore, &usable].into_iter().flatten() {
        let head = ImageHead::read(mask, most_pixels)
            .map_err(|reason| UnusablePhoto::Mask { mask: mask.clone(), reason })?;
        bytes = bytes.max(head.bytes_for(head.width, head.height));
    }
    // Whether it is empty or turned is decided when all photos are known.
    let reading = Reading { bytes, empty: head.has_alpha(), turned: false, most_pixels };
    let ambiguous = head.ambiguous_orientation();
    let lens = lens.is_distorted().then_some(lens);
    Ok(CheckedPhoto {
        photo: Photo { path, ignore, usable, lens, seal, reading },
        camera,
        pose,
        copied,
        ambiguous,
    })
}

/// The photo's file, or its converted copy where this program does not read the file itself; the head of what is read, and what
/// to say of the copy.
fn readable(
    path: PathBuf,
    held: &HashSet<PathBuf>,
    settings: &SceneSettings,
) -> Result<(PathBuf, ImageHead, Option<String>), UnusablePhoto> {
    let most = pixels_of(settings.max_megapixels);
    let read = match path.exists() {
        true => ImageHead::read(&path, most).map_err(UnusablePhoto::from),
        false => Err(UnusablePhoto::NoFile(path.clone())),
    };
    // A file that is another photo is nobody's copy.
    let copy = || decode::converted_copies(&path).find(|copy| !held.contains(copy));
    let (path, head, note) = match read.map_err(|error| (error, copy())) {
        Ok(head) => (path, head, None),
        Err((error, None)) => return Err(error),
        Err((_, Some(copy))) => {
            let head = ImageHead::read(&copy, most)?;
            let note = format!("{} is read from its converted copy {}", path.display(), copy.display());
            (copy, head, Some(note))
        }
    };
    head.check_end(&path)?;
    Ok((path, head, note))
}

/// Least share of the undistorted image that a photo must fill for its lens to be accepted.
const HALF: f64 = 0.5;

fn nothing_usable(draft: &Draft, skipped: &[Skipped]) -> SceneError {
    let names: HashSet<&str> = draft.photos.iter().map(|p| p.name.as_str()).collect();
    let of_draft = |s: &&Skipped| names.contains(s.name.as_str());
    let reason = match (skipped.iter().find(of_draft), draft.photos.len()) {
        (Some(first), 1) => format!("its only photo, {}, cannot be used: {}", first.name, first.reason),
        (Some(first), n) => {
            format!("of {n} photos none can be used; the first, {}: {}", first.name, first.reason)
        }
        (None, _) => "the reconstruction has no photo".to_owned(),
    };
    SceneError::NothingUsable { path: draft.source.clone(), reason }
}

/// The pixel of a sighting after undistortion, if the view shows it. Where the file gives no pixel, the point's own
/// projection stands for it.
fn observed(
    view: &View,
    lens: &crate::lens::Lens,
    position: Vec3,
    pixel: Option<[f64; 2]>,
) -> Option<[f32; 2]> {
    let camera = &view.camera;
    let pixel = match pixel {
        Some(p) => {
            let p = if lens.is_distorted() { lens.undistort(p)? } else { p };
            // From the size the reconstruction knew to that of the file.
            let scale = [
                f64::from(camera.width) / f64::from(lens.width()),
                f64::from(camera.height) / f64::from(lens.height()),
            ];
            [(p[0] * scale[0]) as f32, (p[1] * scale[1]) as f32]
        }
        None => {
            let p = view.pose.to_camera(position);
            if p.z <= 0.0 {
                return None;
            }
            camera.pixel(p).to_array()
        }
    };
    camera.contains(pixel.into()).then_some(pixel)
}

/// Which split is taken, and how many photos it gives to what.
fn split_in_words(split: &Split, views: &[View], draft: &Draft, settings: &SceneSettings) -> String {
    let tests = views.iter().filter(|view| view.test).count();
    let of =
        |photo: &&DraftPhoto| matches!(split.part(&photo.name), Some(SplitPart::Train | SplitPart::Test));
    let left = draft.photos.len() - draft.photos.iter().filter(of).count();
    let who = if matches!(settings.hold_out, HoldOut::Every(_)) { ", as `hold_out` says" } else { "" };
    format!(
        "the split {} is taken: {} photos train, {tests} are held out for testing{who}, {left} are left out; `--split none` takes none",
        split.path.display(),
        views.len() - tests
    )
}

/// A scene of so many photos has one in as many held out, where nothing says which: fewer are better trained on all.
const FEW_HELD_OUT: usize = 16;

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
