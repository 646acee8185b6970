//! The list of a scene's objects: `objects/objects.json` of a run.

use super::sheet;
use crate::{ObjectQuery, RunError, RunFolder};
use segwild_flow::{FileError, Stopper, fault, files};
use segwild_raster::CpuEngine;
use segwild_scene::{Image, Mask, PhotoStore, Scene};
use segwild_segmenter::PosedView;
use segwild_segmenter::scene_tree::{PartMap, SceneParts, SceneTree};
use segwild_trainer::Model;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::PathBuf;

/// The folder of the list in a run.
const FOLDER: &str = "objects";
/// The list in it, and its thumbnails.
const FILES: [&str; 2] = ["objects.json", "sheet.png"];

/// Pixels of a photo at working size that an object must cover to show there.
pub(crate) const SHOWS: u32 = 24;

/// An object that a photo's frame cuts off counts as so much smaller there: thumbnails and crops are to show whole objects.
const CUT_OFF: u32 = 4;

/// Pixels of an object that count when the photo that shows it best is searched for: `all` that show it, `on_frame` those of them on
/// the photo's frame.
pub(crate) fn whole_pixels(all: u32, on_frame: u32) -> u32 {
    if on_frame * on_frame > all { all / CUT_OFF } else { all }
}

/// An object of a scene, found without a click.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneObject {
    /// Its number in the list, from 1: the likeliest things come first.
    pub number: usize,
    /// The name that a person gave it; empty where it has none.
    pub name: String,
    /// Its splats.
    pub splats: usize,
    /// Its share of the light that all photos see, in [0, 1].
    pub light: f32,
    /// Expected IoU with a thing that a person would click.
    pub expected_iou: f32,
    /// Photos in which it shows.
    pub photos: usize,
    /// The photo that shows it best.
    pub photo: String,
    /// A pixel deep inside of it there, in the photo as taken, at full size.
    pub pixel: [f32; 2],
}

impl SceneObject {
    /// Its name, or its number where it has none.
    pub fn label(&self) -> String {
        if self.name.is_empty() { format!("object-{}", self.number) } else { self.name.clone() }
    }
}

/// What of a scene one photo alone shows: nothing else says how far from the photo it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SeenOnceShare {
    /// Share of the splats.
    pub splats: f32,
    /// Per photo of the training, the share of its pixels that show such a splat more than any other.
    pub photos: BTreeMap<String, f32>,
}

/// The objects of a scene.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObjectList {
    /// Key of the scene tree that they are parts of.
    pub tree: String,
    /// The objects, by their numbers.
    pub objects: Vec<SceneObject>,
    /// What one photo alone shows; `None` in lists of versions that did not count it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seen_once: Option<SeenOnceShare>,
}

impl ObjectList {
    /// The list of a run; `None` where it has none, or a damaged one.
    pub fn read(folder: &RunFolder) -> Option<ObjectList> {
        let list: ObjectList = folder.read_json(&format!("{FOLDER}/{}", FILES[0])).ok()?;
        let sound = |(i, object): (usize, &SceneObject)| {
            object.number == i + 1 && (object.name.is_empty() || can_name(&object.name).is_ok())
        };
        list.objects.iter().enumerate().all(sound).then_some(list)
    }

    /// The image of a run's list: a thumbnail of each object, with its number.
    pub fn sheet(folder: &RunFolder) -> PathBuf {
        folder.path().join(FOLDER).join(FILES[1])
    }

    /// Takes the list of a run away, if it has one.
    ///
    /// # Errors
    /// When it cannot be removed.
    pub(crate) fn remove(folder: &RunFolder) -> Result<(), RunError> {
        let path = folder.path().join(FOLDER);
        match std::fs::remove_dir_all(&path) {
            Err(e) if e.kind() != ErrorKind::NotFound => Err(FileError::new("remove", &path, e).into()),
            _ => Ok(()),
        }
    }

    /// The object of a number, or of a name.
    ///
    /// # Errors
    /// When there is none.
    pub fn find(&self, text: &str) -> Result<&SceneObject, RunError> {
        let number = text.parse::<usize>().ok();
        let found = self.objects.iter().find(|object| Some(object.number) == number || object.name == text);
        found.filter(|_| !text.is_empty()).ok_or_else(|| {
            RunError::Request(format!(
                "there is no object `{}`; this scene has {} (`segwild objects RUN` lists them)",
                files::name::one_line(text),
                self.objects.len()
            ))
        })
    }

    /// The object of a number or a name, as a query.
    ///
    /// # Errors
    /// When there is none.
    pub fn query(&self, text: &str) -> Result<ObjectQuery, RunError> {
        let SceneObject { number, photo, .. } = self.find(text)?;
        Ok(ObjectQuery { number: *number, tree: self.tree.clone(), photo: photo.clone() })
    }

    /// Names an object; an empty name takes its name away.
    ///
    /// # Errors
    /// When there is no such object, the name cannot name files, or another object has it.
    pub fn rename(&mut self, object: &str, name: &str) -> Result<(), RunError> {
        let number = self.find(object)?.number;
        if !name.is_empty() {
            can_name(name)?;
            // Systems on which `A` and `a` are one file have to tell them apart.
            let same = |o: &&SceneObject| o.number != number && o.name.to_lowercase() == name.to_lowercase();
            if let Some(other) = self.objects.iter().find(same) {
                return Err(RunError::Request(format!(
                    "object {} is named `{}` already",
                    other.number, other.name
                )));
            }
        }
        name.clone_into(&mut self.objects[number - 1].name);
        Ok(())
    }

    /// Writes the list of a run again, with other names.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, folder: &RunFolder) -> Result<(), RunError> {
        folder.write_json(&format!("{FOLDER}/{}", FILES[0]), self)
    }
}

/// Refuses a name that cannot be an object's: files of the export bear it.
fn can_name(name: &str) -> Result<(), RunError> {
    RunFolder::can_name(name)?;
    let lower = name.to_lowercase();
    let why = if lower.parse::<usize>().is_ok() || lower.starts_with("object-") {
        "objects without names are called so"
    } else if lower == "labels" {
        "the file of all labels is called so"
    } else {
        return Ok(());
    };
    Err(RunError::Request(format!("`{name}` cannot name an object: {why}")))
}

/// What a list is made of.
pub(crate) struct ListRequest<'a> {
    /// Renders what each photo shows; its buffers are used again from photo to photo.
    pub engine: &'a CpuEngine,
    pub photos: &'a PhotoStore,
    pub model: &'a Model,
    pub tree: &'a SceneTree,
    /// Its key.
    pub key: String,
}

/// A list with what was computed for it.
pub struct ListedObjects {
    /// The list.
    pub list: ObjectList,
    pub(super) parts: SceneParts,
    /// Per object, the part of its best photo that shows it, the rest of the photo darkened.
    pub(super) thumbnails: Vec<Image>,
    /// Why the run has not kept the list: its folder can only be read, and has another list or none.
    pub not_kept: Option<String>,
}

/// How well a photo shows an object.
#[derive(Clone, Copy, Default)]
struct ShownIn {
    photos: usize,
    best: u32,
    view: usize,
}

impl ListRequest<'_> {
    /// The scene.
    pub fn scene(&self) -> &Scene {
        self.photos.scene()
    }

    /// The view of a photo at working size.
    pub fn posed(&self, view: usize) -> PosedView {
        let view = &self.scene().views[view];
        PosedView { camera: view.camera.scaled_to(self.photos.long_side()), ..view.into() }
    }

    fn map(&self, view: usize, parts: &SceneParts) -> Result<PartMap, RunError> {
        let (splats, options) = (&self.model.splats, self.model.options());
        Ok(PartMap::render(self.engine, splats, &options, &self.posed(view), parts)?)
    }

    /// Lists the objects. Names of `before` stay with the objects that have the same pixels.
    ///
    /// # Errors
    /// When the scene cannot be rendered, or `stopper` stops it.
    pub fn list(&self, before: Option<&ObjectList>, stopper: &Stopper) -> Result<ListedObjects, RunError> {
        let parts = self.tree.parts();
        let mut shown = vec![ShownIn::default(); parts.groups.len() + 1];
        let splats_once = parts.seen_once.iter().filter(|once| **once).count();
        let mut seen_once = SeenOnceShare {
            splats: splats_once as f32 / parts.seen_once.len().max(1) as f32,
            photos: BTreeMap::new(),
        };
        let training = || (0..self.scene().views.len()).filter(|&view| !self.scene().views[view].test);
        for view in training() {
            RunError::unless_running(stopper)?;
            let map = self.map(view, &parts)?;
            let share = map.seen_once as f32 / map.labels.len().max(1) as f32;
            seen_once.photos.insert(self.scene().views[view].name.clone(), share);
            let (counts, rims) = (map.counts(), map.counts_on_frame());
            for ((shown, count), rim) in shown.iter_mut().zip(counts).zip(rims) {
                shown.photos += usize::from(count >= SHOWS);
                let whole = whole_pixels(count, rim);
                if whole > shown.best {
                    (shown.best, shown.view) = (whole, view);
                }
            }
        }
        let mut names = self.names(before, &parts)?;
        let mut splats = vec![0usize; parts.groups.len() + 1];
        parts.labels.iter().for_each(|&label| splats[usize::from(label)] += 1);
        let (mut objects, mut thumbnails) = (Vec::new(), Vec::new());
        for (group, number) in parts.groups.iter().zip(1..) {
            let ShownIn { photos, view, .. } = shown[number];
            let (map, photo) = (self.map(view, &parts)?, &self.scene().views[view]);
            let mask = map.mask(number as u8);
            objects.push(SceneObject {
                number,
                name: names.remove(&number).unwrap_or_default(),
                splats: splats[number],
                light: group.area,
                expected_iou: group.score,
                photos,
                photo: photo.name.clone(),
                pixel: self.as_taken(view, &mask).unwrap_or_default(),
            });
            // A photo that can no longer be read leaves a dark thumbnail.
            let image = self.photos.read(view).ok();
            thumbnails.push(sheet::thumbnail(image.as_ref().map(|loaded| &loaded.image), &mask));
        }
        let list = ObjectList { tree: self.key.clone(), objects, seen_once: Some(seen_once) };
        Ok(ListedObjects { list, parts, thumbnails, not_kept: None })
    }

    /// The deepest pixel of a mask of a view, in the photo as taken, at full size.
    fn as_taken(&self, view: usize, mask: &Mask) -> Option<[f32; 2]> {
        let view = &self.scene().views[view];
        let depths = mask.not().distances();
        let depth = |&(x, y): &(u32, u32)| depths[(y * mask.width() + x) as usize];
        // Of equal depths the first counts.
        let (x, y) = mask.pixels().reduce(|a, b| if depth(&b) > depth(&a) { b } else { a })?;
        let scale = |v: u32, full: u32, small: u32| (v as f32 + 0.5) * full as f32 / small as f32;
        let inner = [scale(x, view.camera.width, mask.width()), scale(y, view.camera.height, mask.height())];
        view.to_taken(inner)
    }

    /// The names of an earlier list, by the present numbers: a name belongs to the object whose pixel was noted with it.
    fn names(
        &self,
        before: Option<&ObjectList>,
        parts: &SceneParts,
    ) -> Result<BTreeMap<usize, String>, RunError> {
        let mut names = BTreeMap::new();
        let named = before.iter().flat_map(|list| &list.objects).filter(|object| !object.name.is_empty());
        for object in named {
            let Some(view) = self.scene().views.iter().position(|v| v.name == object.photo) else { continue };
            let (full, map) = (self.scene().views[view].camera, self.map(view, parts)?);
            let Some([x, y]) = self.scene().views[view].from_taken(object.pixel) else { continue };
            let at = |v: f32, full: u32, small: usize| {
                ((v * small as f32 / full.max(1) as f32) as usize).min(small.saturating_sub(1))
            };
            let label = map.labels[at(y, full.height, map.height) * map.width + at(x, full.width, map.width)];
            if label > 0 {
                names.entry(usize::from(label)).or_insert_with(|| object.name.clone());
            }
        }
        Ok(names)
    }
}

impl ListedObjects {
    /// Writes the list and its thumbnails into the run's folder, as a whole or not at all.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: &RunFolder) -> Result<(), RunError> {
        files::write_folder(&folder.path().join(FOLDER), |aside| -> Result<(), RunError> {
            let path = aside.join(FILES[0]);
            fault::point("objects.file").map_err(|e| FileError::new("write", &path, e))?;
            let text = serde_json::to_vec_pretty(&self.list)
                .map_err(|e| RunError::Folder { path: path.clone(), reason: e.to_string() })?;
            files::write_atomic(&path, &text)?;
            Ok(sheet::sheet(&self.thumbnails).write_png(&aside.join(FILES[1]))?)
        })
    }
}
