//! Writes a set as a COLMAP scene with its truth beside it.

use crate::error::SyntheticError;
use crate::options::SyntheticOptions;
use crate::photo::SyntheticPhoto;
use crate::scene::SyntheticScene;
use crate::world::{Instance, ObjectKind, WorldPart};
use glam::{DMat3, DQuat};
use segwild_files as files;
use segwild_scene::colmap::{
    self, CameraModel, CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction,
};
use segwild_scene::{Image, SceneError};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What `truth.json` says.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The options that it was made with.
    pub options: SyntheticOptions,
    /// The photos, in order.
    pub photos: Vec<PhotoTruth>,
    /// The named things; an id is an index, 0 is the sky.
    pub instances: Vec<Instance>,
    /// The parts; an id is an index, 0 is the sky.
    pub parts: Vec<WorldPart>,
    /// The instances with masks in `truth/<name>/`, in the order of their ids.
    pub objects: Vec<ObjectTruth>,
}

/// One photo in `truth.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotoTruth {
    /// File name.
    pub name: String,
    /// Whether it is held out.
    pub test: bool,
    /// Whether it was taken from the front.
    pub front: bool,
    /// Share of its pixels that transients touch.
    pub covered: f32,
}

/// One instance in `truth.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObjectTruth {
    /// Its id.
    pub id: u16,
    /// Its name.
    pub name: String,
    /// What it is good for.
    pub kind: ObjectKind,
    /// Photos to click on it, the best first, at most [`CLICKS`].
    pub clicks: Vec<Click>,
}

/// A click deep inside an object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Click {
    /// The photo.
    pub photo: String,
    /// Pixel position, x.
    pub x: f32,
    /// Pixel position, y.
    pub y: f32,
    /// Pixels of the object that the photo shows.
    pub visible: usize,
}

/// Most clicks that `truth.json` gives for an object.
pub const CLICKS: usize = 6;

/// Share of what a photo shows of an object that transients must leave uncovered for the photo to show it well.
const UNCOVERED: f32 = 0.9;

impl SyntheticScene {
    /// Writes the set into a folder, which is made if it is not there:
    ///
    /// - `images/*.png`, `sparse/0/*.bin`, `split.tsv`: the scene, as a user has one;
    /// - `truth.json`: [`Manifest`];
    /// - `truth/<object>/<stem>.png`: where the object is (transients aside), for each photo that shows it or could;
    /// - `truth/clean`, `truth/sky`, `truth/transient`, `truth/instance` and `truth/part` (8-bit ids), `truth/depth`
    ///   (`.pfm`, file units, 0 = sky).
    pub fn write(&self, dir: &Path) -> Result<Manifest, SyntheticError> {
        let manifest = self.manifest();
        let truth = dir.join("truth");
        let folder = |path: &Path| std::fs::create_dir_all(path).map_err(SceneError::io(path));
        folder(&dir.join("images"))?;
        for name in ["clean", "sky", "transient", "instance", "part", "depth"] {
            folder(&truth.join(name))?;
        }
        for object in &manifest.objects {
            folder(&truth.join(&object.name))?;
        }
        for photo in &self.photos {
            let named = |kind: &str| truth.join(kind).join(&photo.name);
            photo.photo.write_png(&dir.join("images").join(&photo.name))?;
            photo.clean.write_png(&named("clean"))?;
            photo.sky().write_png(&named("sky"))?;
            photo.transients.write_png(&named("transient"))?;
            ids(photo, &photo.instances).write_png(&named("instance"))?;
            ids(photo, &photo.parts).write_png(&named("part"))?;
            let depth = named("depth").with_extension("pfm");
            files::write_plain(&depth, pfm(photo)).map_err(SceneError::io(&depth))?;
            for object in &manifest.objects {
                photo.mask(object.id).write_png(&named(&object.name))?;
            }
        }
        colmap::write(&dir.join("sparse/0"), &self.reconstruction())?;
        let split = dir.join("split.tsv");
        files::write_plain(&split, self.split()).map_err(SceneError::io(&split))?;
        let path = dir.join("truth.json");
        let text = serde_json::to_string_pretty(&manifest)
            .map_err(|e| SceneError::invalid(&path, "manifest", e.to_string()))?;
        files::write_plain(&path, text + "\n").map_err(SceneError::io(&path))?;
        Ok(manifest)
    }

    /// What `truth.json` says.
    pub fn manifest(&self) -> Manifest {
        let photos = self.photos.iter().map(|p| PhotoTruth {
            name: p.name.clone(),
            test: p.test,
            front: p.front,
            covered: p.transients.count() as f32 / p.instances.len() as f32,
        });
        let objects = (1..self.instances.len() as u16).map(|id| {
            let instance = &self.instances[usize::from(id)];
            ObjectTruth { id, name: instance.name.clone(), kind: instance.kind, clicks: self.clicks(id) }
        });
        Manifest {
            options: self.options.clone(),
            photos: photos.collect(),
            instances: self.instances.clone(),
            parts: self.parts.clone(),
            objects: objects.collect(),
        }
    }

    /// Clicks on an instance in the training photos that show it best: first those in which no part of it is out of
    /// the frame and transients cover little of it, the largest first, then the others.
    pub fn clicks(&self, instance: u16) -> Vec<Click> {
        let mut clicks: Vec<(bool, Click)> = self
            .photos
            .iter()
            .filter(|p| !p.test)
            .filter_map(|p| {
                let whole = p.mask(instance);
                let visible = whole.minus(&p.transients).count();
                if visible * 250 < p.instances.len() {
                    return None;
                }
                let [x, y] = p.click(instance)?;
                let (w, h) = (whole.width(), whole.height());
                let cut_off = whole.pixels().any(|(x, y)| x == 0 || y == 0 || x + 1 == w || y + 1 == h);
                let well = !cut_off && visible as f32 >= UNCOVERED * whole.count() as f32;
                Some((well, Click { photo: p.name.clone(), x, y, visible }))
            })
            .collect();
        clicks.sort_by(|(a_well, a), (b_well, b)| {
            b_well.cmp(a_well).then(b.visible.cmp(&a.visible)).then_with(|| a.photo.cmp(&b.photo))
        });
        let mut clicks: Vec<Click> = clicks.into_iter().map(|(_, click)| click).collect();
        clicks.truncate(CLICKS);
        clicks
    }

    /// The scene as COLMAP's records.
    pub fn reconstruction(&self) -> Reconstruction {
        let mut out = Reconstruction::default();
        for (i, photo) in self.photos.iter().enumerate() {
            let id = i as u32 + 1;
            let c = &photo.camera;
            out.cameras.push(CameraRecord {
                id,
                model: CameraModel::Pinhole,
                width: u64::from(c.width),
                height: u64::from(c.height),
                params: [c.fx, c.fy, c.cx, c.cy].map(f64::from).to_vec(),
            });
            let q = DQuat::from_mat3(&DMat3::from_cols_array(
                &photo.pose.rotation.to_cols_array().map(f64::from),
            ))
            .normalize();
            out.images.push(ImageRecord {
                id,
                rotation: [q.w, q.x, q.y, q.z],
                translation: photo.translation.to_array(),
                camera_id: id,
                name: photo.name.clone(),
                keypoints: Vec::new(),
            });
        }
        for (i, point) in self.points.iter().enumerate() {
            let id = i as u64 + 1;
            let mut track = Vec::with_capacity(point.track.len());
            let mut error = 0.0;
            for seen in &point.track {
                let photo = &self.photos[seen.view as usize];
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

    fn split(&self) -> String {
        let mut text = String::from("filename\tid\tsplit\tdataset\n");
        for (i, photo) in self.photos.iter().enumerate() {
            let part = if photo.test { "test" } else { "train" };
            text += &format!("{}\t{}\t{part}\tsynthetic\n", photo.name, i + 1);
        }
        text
    }
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
