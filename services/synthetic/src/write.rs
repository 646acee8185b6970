//! Writes a set as a COLMAP scene with its truth beside it, photo by photo.

use crate::error::SyntheticError;
use crate::options::SyntheticOptions;
use crate::photo::{PhotoRecord, SyntheticPhoto};
use crate::planned::photo_name;
use crate::points::SyntheticPoint;
use crate::scene::SyntheticScene;
use crate::truth::{Manifest, TruthBuilder};
use crate::world::{Instance, WorldPart};
use glam::{DMat3, DQuat};
use rayon::prelude::*;
use segwild_files::name::is_plain;
use segwild_files::{FileError, read_within, write_atomic};
use segwild_scene::colmap::{
    self, CameraModel, CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction,
};
use segwild_scene::{Image, SceneError};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Folders in `truth` with an image of each photo, besides those of the objects.
const KINDS: [&str; 5] = ["clean", "sky", "transient", "instance", "part"];

/// The folder in `truth` with the depth of each photo.
const DEPTH: &str = "depth";

/// The file that holds an [`UnfinishedSet`]. Not there once the set is whole.
const UNFINISHED: &str = "truth/unfinished.json";

/// What wrote a set: another version may take other photos.
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// A set whose writing was stopped.
#[derive(Deserialize)]
struct UnfinishedSet {
    /// What wrote it.
    version: String,
    options: SyntheticOptions,
    /// The truth of the photos that are there.
    truth: TruthBuilder,
}

/// Most bytes of a manifest. One of 4000 photos, the most that a set has, takes less than 1 MiB.
const MOST_MANIFEST: u64 = 64 << 20;

/// Most photos of a set, as [`SyntheticOptions`] allow them.
const MOST_PHOTOS: usize = 4000;

/// Most objects of a set: their ids have 8 bits.
const MOST_OBJECTS: usize = 255;

impl SyntheticScene {
    /// Writes the set into a folder, which is made if it is not there:
    ///
    /// - `images/*.png`, `sparse/0/*.bin`, `split.tsv`: the scene, as a user has one;
    /// - `truth.json`: [`Manifest`];
    /// - `truth/<object>/<stem>.png`: where the object is (transients aside), for each photo that shows it or could;
    /// - `truth/clean`, `truth/sky`, `truth/transient`, `truth/instance` and `truth/part` (8-bit ids), `truth/depth`
    ///   (`.pfm`, file units, 0 = sky).
    pub fn write(&self, dir: &Path) -> Result<Manifest, SyntheticError> {
        let records = self.records();
        let mut writer = SetWriter::new(dir, &self.options, &self.instances, &records)?;
        for photo in &self.photos[writer.written()..] {
            writer.add(photo)?;
        }
        writer.finish(&self.parts, &self.points)
    }

    /// The scene as COLMAP's records.
    pub fn reconstruction(&self) -> Reconstruction {
        reconstruction(&self.records(), &self.points)
    }

    fn records(&self) -> Vec<PhotoRecord> {
        self.photos.iter().map(SyntheticPhoto::record).collect()
    }
}

/// Writes a set photo by photo, and keeps no pixels of what is written.
pub struct SetWriter<'a> {
    dir: &'a Path,
    options: &'a SyntheticOptions,
    photos: &'a [PhotoRecord],
    /// Ids and names of the instances with masks.
    objects: Vec<(u16, String)>,
    truth: TruthBuilder,
}

impl<'a> SetWriter<'a> {
    /// Makes the folders of a set of these photos. What a stopped writer of the same set wrote stays, and counts as written. Another
    /// set that the folder holds is removed: photos that stayed of it would be taken for photos of this one.
    pub fn new(
        dir: &'a Path,
        options: &'a SyntheticOptions,
        instances: &[Instance],
        photos: &'a [PhotoRecord],
    ) -> Result<SetWriter<'a>, SyntheticError> {
        let truth = held_truth(dir, options, instances, photos)?;
        let objects: Vec<(u16, String)> =
            (0..).zip(instances).skip(1).map(|(id, instance)| (id, instance.name.clone())).collect();
        let kinds = KINDS.into_iter().chain([DEPTH]).chain(objects.iter().map(|(_, name)| name.as_str()));
        for folder in kinds.map(|kind| dir.join("truth").join(kind)).chain([dir.join("images")]) {
            let failed = |e| SceneError::from(FileError::new("create the folder", &folder, e));
            std::fs::create_dir_all(&folder).map_err(failed)?;
        }
        let truth = truth.unwrap_or_else(|| TruthBuilder::new(instances));
        let writer = SetWriter { dir, options, photos, objects, truth };
        writer.keep()?;
        Ok(writer)
    }

    /// Writes what is needed to go on.
    fn keep(&self) -> Result<(), SyntheticError> {
        let path = self.dir.join(UNFINISHED);
        let held = json!({ "version": VERSION, "options": self.options, "truth": self.truth });
        Ok(write_atomic(&path, held.to_string().as_bytes()).map_err(SceneError::from)?)
    }

    /// Number of photos that are written: the first ones of the set.
    pub fn written(&self) -> usize {
        self.truth.photo_names().len()
    }

    /// Writes the files of the next photo, several at a time.
    pub fn add(&mut self, photo: &SyntheticPhoto) -> Result<(), SyntheticError> {
        let SetWriter { dir, objects, truth, .. } = self;
        let (written, ()) = rayon::join(|| write_photo(dir, objects, photo), || truth.add(photo));
        written?;
        self.keep()
    }

    /// Writes what the set has besides its photos, all of which are written.
    pub fn finish(self, parts: &[WorldPart], points: &[SyntheticPoint]) -> Result<Manifest, SyntheticError> {
        colmap::write(&self.dir.join("sparse/0"), &reconstruction(self.photos, points))?;
        write_atomic(&self.dir.join("split.tsv"), split(self.photos).as_bytes()).map_err(SceneError::from)?;
        let manifest = self.truth.manifest(self.options, parts);
        let path = self.dir.join("truth.json");
        let text = serde_json::to_string_pretty(&manifest)
            .map_err(|e| SceneError::invalid(&path, "manifest", e.to_string()))?;
        write_atomic(&path, (text + "\n").as_bytes()).map_err(SceneError::from)?;
        remove(&self.dir.join(UNFINISHED))?;
        Ok(manifest)
    }
}

/// The truth of the photos that a stopped writer of the same set wrote. Other sets are removed; the same set, if it is whole, is
/// written again as it is.
fn held_truth(
    dir: &Path,
    options: &SyntheticOptions,
    instances: &[Instance],
    photos: &[PhotoRecord],
) -> Result<Option<TruthBuilder>, SceneError> {
    let (whole_path, path) = (dir.join("truth.json"), dir.join(UNFINISHED));
    // Both are read and checked before anything is removed.
    let whole = held_set::<Manifest>(&whole_path)?;
    let unfinished = held_set::<UnfinishedSet>(&path)?;
    let listed = |UnfinishedSet { options, truth, .. }: &UnfinishedSet| {
        if !truth.is_sound() {
            return Err(refusal(&path, "its objects and photos do not fit together"));
        }
        let manifest = truth.clone().manifest(options, &[]);
        check_listed(&path, &manifest).map(|()| manifest)
    };
    let manifest = unfinished.as_ref().map(listed).transpose()?;
    if let Some(held) = whole.filter(|held| held.options != *options) {
        let names = held.photos.iter().map(|photo| photo.name.clone()).collect();
        forget(dir, &whole_path, &held, names)?;
    }
    let Some((set, manifest)) = unfinished.zip(manifest) else { return Ok(None) };
    let UnfinishedSet { version, options: held_options, truth } = set;
    let is_same = version == VERSION && held_options == *options && truth.instances() == instances;
    let names: Vec<String> = truth.photo_names().map(str::to_owned).collect();
    let is_there = |(name, photo): (&String, &PhotoRecord)| {
        *name == photo.name && files_of(name, &manifest).all(|file| dir.join(file).is_file())
    };
    if is_same && names.len() <= photos.len() && names.iter().zip(photos).all(is_there) {
        return Ok(Some(truth));
    }
    // Of the photo after the last, a writer that was stopped may have left some files.
    let next = photo_name(names.len());
    forget(dir, &path, &manifest, names.into_iter().chain([next]).collect())?;
    Ok(None)
}

/// Removes a set: its reconstruction, the photos and masks of these names, and its manifest at `path`.
fn forget(dir: &Path, path: &Path, held: &Manifest, names: Vec<String>) -> Result<(), SceneError> {
    check_listed(path, held)?;
    for name in ["sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin", "split.tsv"] {
        remove(&dir.join(name))?;
    }
    names.iter().flat_map(|name| files_of(name, held)).try_for_each(|file| remove(&dir.join(file)))?;
    // The manifest last: it names the rest to whoever is stopped before.
    remove(path)
}

/// What a file says of the set that its folder holds; `None` where there is none.
fn held_set<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, SceneError> {
    let text = match read_within(path, MOST_MANIFEST) {
        Ok(text) => text,
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(None),
        Err(source) => return Err(SceneError::Io { path: path.to_owned(), source }),
    };
    serde_json::from_slice(&text)
        .map(Some)
        .map_err(|e| refusal(path, &format!("it does not name the set that the folder holds: {e}")))
}

/// Refuses a manifest that lists what no set has: it may come from anywhere, and its names must lead nowhere else.
fn check_listed(path: &Path, held: &Manifest) -> Result<(), SceneError> {
    let refuse = |what: String| Err(refusal(path, &what));
    let (photos, objects) = (held.photos.len(), held.objects.len());
    if photos > MOST_PHOTOS || objects > MOST_OBJECTS {
        return refuse(format!(
            "a set has at most {MOST_PHOTOS} photos and {MOST_OBJECTS} objects, not {photos} and {objects}"
        ));
    }
    let objects = held.objects.iter().map(|object| &object.name);
    let mut names = held.photos.iter().map(|photo| &photo.name).chain(objects);
    match names.find(|name| !is_plain(name)) {
        Some(name) => refuse(format!("`{name}` is no file name")),
        None => Ok(()),
    }
}

/// Why what a folder holds is not believed.
fn refusal(path: &Path, what: &str) -> SceneError {
    SceneError::invalid(path, "manifest", format!("{what}; take the file away, or choose another folder"))
}

/// A photo of a set and its truth, as paths within the set's folder.
fn files_of<'a>(photo: &'a str, held: &'a Manifest) -> impl Iterator<Item = PathBuf> + 'a {
    let objects = held.objects.iter().map(|object| object.name.as_str());
    let kinds = KINDS.into_iter().chain(objects);
    let images = kinds.map(move |kind| Path::new("truth").join(kind).join(photo));
    images.chain([Path::new("images").join(photo), depth_file(photo)])
}

/// Removes a file, if it is there.
fn remove(file: &Path) -> Result<(), SceneError> {
    match std::fs::remove_file(file) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(FileError::new("remove", file, e).into()),
        _ => Ok(()),
    }
}

/// Depth of a photo, as a path within the set's folder.
fn depth_file(photo: &str) -> PathBuf {
    Path::new("truth").join(DEPTH).join(photo).with_extension("pfm")
}

/// One file to write.
type FileJob<'a> = Box<dyn FnOnce() -> Result<(), SceneError> + Send + 'a>;

/// Writes a photo and its truth. `objects`: ids and names of the instances with masks.
fn write_photo(dir: &Path, objects: &[(u16, String)], photo: &SyntheticPhoto) -> Result<(), SceneError> {
    let named = |kind: &str| dir.join("truth").join(kind).join(&photo.name);
    let named = &named;
    let mut files: Vec<FileJob<'_>> = vec![
        Box::new(|| photo.photo.write_png(&dir.join("images").join(&photo.name))),
        Box::new(|| photo.clean.write_png(&named("clean"))),
        Box::new(|| write_atomic(&dir.join(depth_file(&photo.name)), &pfm(photo)).map_err(SceneError::from)),
        Box::new(|| ids(photo, &photo.instances).write_png(&named("instance"))),
        Box::new(|| ids(photo, &photo.parts).write_png(&named("part"))),
        Box::new(|| photo.sky().write_png(&named("sky"))),
        Box::new(|| photo.transients.write_png(&named("transient"))),
    ];
    for (id, name) in objects {
        files.push(Box::new(move || photo.mask(*id).write_png(&named(name))));
    }
    files.into_par_iter().try_for_each(|write| write())
}

/// A set as COLMAP's records.
fn reconstruction(photos: &[PhotoRecord], points: &[SyntheticPoint]) -> Reconstruction {
    let mut out = Reconstruction::default();
    for (i, photo) in photos.iter().enumerate() {
        let id = i as u32 + 1;
        let c = &photo.camera;
        out.cameras.push(CameraRecord {
            id,
            model: CameraModel::Pinhole,
            width: u64::from(c.width),
            height: u64::from(c.height),
            params: [c.fx, c.fy, c.cx, c.cy].map(f64::from).to_vec(),
        });
        let columns = photo.pose.rotation.to_cols_array().map(f64::from);
        let q = DQuat::from_mat3(&DMat3::from_cols_array(&columns)).normalize();
        out.images.push(ImageRecord {
            id,
            rotation: [q.w, q.x, q.y, q.z],
            translation: photo.translation.to_array(),
            camera_id: id,
            name: photo.name.clone(),
            keypoints: Vec::new(),
        });
    }
    for (i, point) in points.iter().enumerate() {
        let id = i as u64 + 1;
        let mut track = Vec::with_capacity(point.track.len());
        let mut error = 0.0;
        for seen in &point.track {
            let photo = &photos[seen.view as usize];
            let p = photo.pose.to_camera(point.position.as_vec3());
            let offset = photo.camera.pixel(p) - glam::Vec2::from(seen.pixel);
            error += f64::from(if p.z > 0.0 { offset.length() } else { 0.0 });
            let keypoints = &mut out.images[seen.view as usize].keypoints;
            track.push((seen.view + 1, keypoints.len() as u32));
            keypoints.push(Keypoint { pixel: seen.pixel.map(f64::from), point: Some(id) });
        }
        out.points.push(PointRecord {
            id,
            position: point.position.to_array(),
            colour: point.colour.map(|c| (c * 255.0).round() as u8),
            error: error / point.track.len().max(1) as f64,
            track,
        });
    }
    out
}

/// The split as a table of Photo Tourism.
fn split(photos: &[PhotoRecord]) -> String {
    let mut text = String::from("filename\tid\tsplit\tdataset\n");
    for (i, photo) in photos.iter().enumerate() {
        let part = if photo.test { "test" } else { "train" };
        text += &format!("{}\t{}\t{part}\tsynthetic\n", photo.name, i + 1);
    }
    text
}

/// Ids as an image whose 8-bit values are the ids; there are fewer than 256 of either kind.
fn ids(photo: &SyntheticPhoto, ids: &[u16]) -> Image {
    let data = ids.iter().map(|&id| f32::from(id) / 255.0).collect();
    Image { width: photo.photo.width, height: photo.photo.height, channels: 1, data }
}

/// Depth as a portable float map: little-endian, rows from the bottom up.
fn pfm(photo: &SyntheticPhoto) -> Vec<u8> {
    let (w, h) = (photo.photo.width, photo.photo.height);
    let mut out = format!("Pf\n{w} {h}\n-1.0\n").into_bytes();
    for row in photo.depth.chunks(w).rev() {
        out.extend(row.iter().flat_map(|d| d.to_le_bytes()));
    }
    out
}
