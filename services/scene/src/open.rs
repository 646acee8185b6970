//! Opening a scene: find what is there, check it against the photos, normalise.

use crate::draft::{Draft, DraftPhoto, DraftPoint, DraftPose};
use crate::frame::{Placed, Placing};
use crate::photo::Header;
use crate::split::{Part, Split};
use crate::{
    DARKEST, Frame, Observation, Photo, Point, Pose, Scene, SceneError, SceneSettings, Seal, Skipped, View,
};
use crate::{colmap, draft, transforms};
use glam::{Mat3, Vec3};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

/// Folders, relative to the scene's, in which photos are looked for.
const PHOTO_FOLDERS: [&str; 7] = ["images", "dense/images", "input", "images_2", "images_4", "images_8", "."];

impl Scene {
    /// Opens the scene in folder `path`: a COLMAP reconstruction (also a Photo Tourism folder with its split) or
    /// nerfstudio's `transforms.json`, which may also be named itself.
    ///
    /// Photos that cannot be used are listed in [`Scene::skipped`] with the reason and the rest goes on. Only the heads
    /// of the photos are read here; [`View::load`] reads the pixels.
    pub fn open(path: &Path, settings: &SceneSettings) -> Result<Scene, SceneError> {
        let (folder, draft, images) = find(path, settings)?;
        let split = find_split(&folder, settings)?;
        let ignore = folder_setting("ignore", &settings.ignore, &folder)?;
        if settings.size == 0 {
            return Err(setting("size", "0".into(), "photos need at least one pixel"));
        }
        let images = match images {
            Some(images) => images,
            None => find_photos(&folder, &draft)?,
        };

        let mut skipped = Vec::new();
        let mut skip = |name: &str, reason: String| skipped.push(Skipped { name: name.to_owned(), reason });
        if let Some(split) = &split {
            let known: BTreeSet<&str> = draft.photos.iter().map(|p| last_part(&p.name)).collect();
            for (name, part) in &split.rows {
                if !known.contains(last_part(name)) {
                    let why =
                        if *part == Part::NoPose { "the split has no pose of it" } else { "it has no pose" };
                    skip(name, format!("{why}: the reconstruction did not place it"));
                }
            }
        }
        let checked: Vec<Result<Checked, String>> = draft
            .photos
            .par_iter()
            .map(|photo| check(photo, &images, ignore.as_deref(), split.as_ref()))
            .collect();
        let mut usable: BTreeMap<&str, (usize, Checked)> = BTreeMap::new();
        for (i, (photo, checked)) in draft.photos.iter().zip(checked).enumerate() {
            match checked {
                Err(reason) => skip(&photo.name, reason),
                Ok(_) if usable.contains_key(photo.name.as_str()) => {
                    skip(&photo.name, "another photo of the reconstruction has the same name".into());
                }
                Ok(checked) => {
                    usable.insert(&photo.name, (i, checked));
                }
            }
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
        {
            let name = usable.keys().next().copied().unwrap_or_default();
            let reason = format!(
                "no mask in it is named after a photo; for {name} it would be {}",
                mask_names(name)[0]
            );
            return Err(setting("ignore", folder.display().to_string(), &reason));
        }

        let frame = placing.frame();
        let outliers = placing.outliers(&frame);
        let mut view_of = vec![None; draft.photos.len()];
        let mut views = Vec::with_capacity(usable.len());
        for (name, (i, checked)) in usable {
            view_of[i] = Some(views.len() as u32);
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
                let mut track: Vec<Observation> = Vec::with_capacity(point.track.len());
                for &(photo, pixel) in &point.track {
                    let (Some(view), Some(lens)) = (view_of[photo], lenses[photo]) else { continue };
                    let pixel = observed(&views[view as usize], lens, position, pixel);
                    if let Some(pixel) = pixel
                        && track.iter().all(|o| o.view != view)
                    {
                        track.push(Observation { view, pixel });
                    }
                }
                track.sort_by_key(|o| o.view);
                // A point that only unusable photos saw is of no use; one without a track is taken as it is.
                let lost =
                    !point.track.is_empty() && point.track.iter().all(|(photo, _)| view_of[*photo].is_none());
                let colour = point.colour.map(|c| (f32::from(c) / 255.0).max(DARKEST));
                (position.is_finite() && !lost).then_some(Point { position, colour, track })
            })
            .collect();
        tracing::debug!(
            views = views.len(),
            skipped = skipped.len(),
            points = points.len(),
            points_dropped = draft.points.len() - points.len(),
            source = %draft.source.display(),
            "scene opened"
        );
        let mut notes = notes(&draft, views.len(), points.len(), &view_of);
        notes.extend(
            placing
                .notes(&frame, &outliers)
                .into_iter()
                .map(|words| format!("{}: {words}", draft.source.display())),
        );
        let mut scene = Scene { views, points, skipped, notes, frame };
        scene.notes.extend(scene.about_colours().map(|words| format!("{}: {words}", draft.source.display())));
        Ok(scene)
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
            "{source}: {unseen} of {all} points name no photo that sees them: they start splats, and no photo's light or \
             strangers can be told by them"
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

/// A photo that passed every check.
struct Checked {
    photo: Photo,
    camera: crate::Camera,
    pose: DraftPose,
}

impl Checked {
    /// Where it stands; `photo` is its index in the draft.
    fn placed<'a>(&self, photo: usize, draft: &'a Draft) -> Option<Placed<'a>> {
        let lens = draft.photos[photo].lens.as_ref().ok()?;
        Some(Placed { photo, pose: self.pose, camera: self.camera, lens })
    }

    fn into_view(self, name: &str, frame: &Frame) -> View {
        let rotation = self.pose.rotation;
        let centre = (self.pose.centre - frame.origin) / frame.scale;
        let pose = Pose {
            rotation: Mat3::from_cols_array(&rotation.to_cols_array().map(|v| v as f32)),
            translation: (-(rotation * centre)).as_vec3(),
        };
        View { name: name.to_owned(), camera: self.camera, pose, photo: self.photo, test: false }
    }
}

fn setting(setting: &'static str, value: String, reason: &str) -> SceneError {
    SceneError::Setting { setting, value, reason: reason.to_owned() }
}

fn last_part(name: &str) -> &str {
    name.rsplit('/').next().unwrap_or(name)
}

/// The scene's folder, what its reconstruction says, and the photo folder where that is settled.
fn find(path: &Path, settings: &SceneSettings) -> Result<(PathBuf, Draft, Option<PathBuf>), SceneError> {
    let metadata = std::fs::metadata(path).map_err(SceneError::io(path))?;
    // Absolute, so that folders above can be named and the photos be found again from elsewhere.
    let path = &std::path::absolute(path).map_err(SceneError::io(path))?;
    let (folder, json) = if metadata.is_dir() {
        (path.to_owned(), path.join("transforms.json"))
    } else {
        (path.parent().unwrap_or(Path::new("")).to_owned(), path.to_owned())
    };
    let images = folder_setting("images", &settings.images, &folder)?;
    if metadata.is_dir()
        && let Some(dir) = colmap::find(&folder)
    {
        return Ok((folder, draft::from_colmap(&dir)?, images));
    }
    let is_json = json.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    if is_json && json.is_file() {
        let draft = transforms::read(&json, images.as_deref())?;
        // Its photos say themselves where they are.
        let images = images.unwrap_or_else(|| folder.clone());
        return Ok((folder, draft, Some(images)));
    }
    Err(SceneError::NotAScene {
        path: path.to_owned(),
        looked_for: format!(
            "a COLMAP reconstruction (cameras and images, .bin or .txt, in {}) and nerfstudio's transforms.json",
            colmap::PLACES.join(", ")
        ),
    })
}

/// The folder a setting names: as it stands, or within the scene's folder.
fn folder_setting(name: &'static str, value: &str, scene: &Path) -> Result<Option<PathBuf>, SceneError> {
    if value.is_empty() {
        return Ok(None);
    }
    let places = [PathBuf::from(value), scene.join(value)];
    let found = places.into_iter().find(|p| p.is_dir());
    found.map(Some).ok_or_else(|| setting(name, value.to_owned(), "there is no such folder"))
}

fn find_split(folder: &Path, settings: &SceneSettings) -> Result<Option<Split>, SceneError> {
    if !settings.split.is_empty() {
        let places = [PathBuf::from(&settings.split), folder.join(&settings.split)];
        let found = places.into_iter().find(|p| p.is_file());
        let found = found.ok_or_else(|| setting("split", settings.split.clone(), "there is no such file"))?;
        return Split::read(&found).map(Some);
    }
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(SceneError::io(folder))? {
        let path = entry.map_err(SceneError::io(folder))?.path();
        if path.extension().is_some_and(|e| e == "tsv") && path.is_file() {
            found.push(path);
        }
    }
    found.sort();
    match &found[..] {
        [] => Ok(None),
        [one] => Split::read(one).map(Some),
        [one, two, ..] => {
            let reason = format!(
                "there are several splits, such as {} and {}; name one",
                one.display(),
                two.display()
            );
            Err(setting("split", "nothing".into(), &reason))
        }
    }
}

/// The first folder that holds a photo of the reconstruction.
fn find_photos(folder: &Path, draft: &Draft) -> Result<PathBuf, SceneError> {
    let mut places: Vec<PathBuf> = PHOTO_FOLDERS.iter().map(|p| folder.join(p)).collect();
    // Photos that lie beside the reconstruction's own folder, or beside the one above it, are surely its own.
    let above = draft.source.ancestors().skip(1).take(2).map(|dir| dir.join("images"));
    places.splice(0..0, above);
    let holds =
        |place: &PathBuf| draft.photos.iter().any(|p| is_inside(&p.name) && place.join(&p.name).is_file());
    places.iter().find(|p| p.is_dir() && holds(p)).cloned().ok_or_else(|| {
        let reason = match draft.photos.first() {
            None => "the reconstruction has no photo".to_owned(),
            Some(first) => format!(
                "none of the {} photos of {} was found (the first is {}); looked in {}; name the folder with `images`",
                draft.photos.len(),
                draft.source.display(),
                first.name,
                PHOTO_FOLDERS.join(", ")
            ),
        };
        SceneError::NothingUsable { path: folder.to_owned(), reason }
    })
}

/// Whether a name stays inside the folder it is relative to: names become the names of files that are written.
fn is_inside(name: &str) -> bool {
    let path = Path::new(name);
    !name.is_empty() && path.components().all(|c| matches!(c, Component::Normal(_)))
}

fn check(
    photo: &DraftPhoto,
    images: &Path,
    ignore: Option<&Path>,
    split: Option<&Split>,
) -> Result<Checked, String> {
    if !is_inside(&photo.name) || photo.name.contains('\0') {
        return Err("its name is not that of a file inside the photo folder".into());
    }
    match split.map(|s| (s, s.part(&photo.name))) {
        Some((s, None)) => return Err(format!("it is not listed in the split {}", s.path.display())),
        Some((s, Some(Part::NoPose))) => {
            return Err(format!("the split {} gives it no id", s.path.display()));
        }
        _ => {}
    }
    let pose = photo.pose.clone()?;
    let path = photo.file.clone().unwrap_or_else(|| images.join(&photo.name));
    if !path.is_file() {
        return Err(format!("there is no file {}", path.display()));
    }
    let ignore =
        ignore.and_then(|dir| mask_names(&photo.name).into_iter().map(|n| dir.join(n)).find(|p| p.is_file()));
    let usable = photo.usable.clone();
    let files = [Some(&path), ignore.as_ref(), usable.as_ref()];
    let seal = Seal::on(files.into_iter().flatten().map(PathBuf::as_path));
    let lens = photo.lens.as_ref().map_err(String::clone)?;
    let (width, height) = Header::read(&path)?.size_for(lens.width(), lens.height())?;
    let lens = lens.resized(width, height);
    let filled = lens.filled();
    if filled < HALF {
        return Err(format!(
            "its lens cannot be right: of the undistorted picture only {:.0} % can be filled from the photo",
            100.0 * filled
        ));
    }
    let camera = lens.pinhole();
    if let Some(mask) = usable.as_ref().filter(|mask| !mask.is_file()) {
        return Err(format!("there is no file {}, which is to be its mask", mask.display()));
    }
    let lens = lens.is_distorted().then_some(lens);
    Ok(Checked { photo: Photo { path, ignore, usable, lens, seal }, camera, pose })
}

/// Least share of the undistorted picture that a photo must fill for its lens to be believed.
const HALF: f64 = 0.5;

/// What the mask of a photo may be called.
fn mask_names(name: &str) -> [String; 2] {
    let stem = Path::new(name).with_extension("png").to_string_lossy().into_owned();
    [stem, format!("{name}.png")]
}

fn nothing_usable(draft: &Draft, skipped: &[Skipped]) -> SceneError {
    let of_draft = |s: &&Skipped| draft.photos.iter().any(|p| p.name == s.name);
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

fn hold_out(views: &mut [View], split: Option<&Split>, every: u32) -> Result<(), SceneError> {
    for (i, view) in views.iter_mut().enumerate() {
        view.test = if every > 0 {
            i % every as usize == 0
        } else {
            split.is_some_and(|s| s.part(&view.name) == Some(Part::Test))
        };
    }
    if views.iter().all(|v| v.test) {
        let n = views.len();
        return Err(match (every, split) {
            (0, Some(split)) => SceneError::NothingUsable {
                path: split.path.clone(),
                reason: format!("all {n} usable photos are for testing; none is left to train on"),
            },
            _ => setting(
                "hold_out",
                every.to_string(),
                &format!("of {n} usable photos none is left to train on"),
            ),
        });
    }
    Ok(())
}
