//! Posed photos and the scene they belong to.

use crate::decode::{MEGAPIXELS, pixels_of};
use crate::names::{key, last_part, stem};
use crate::naming::first_named;
use crate::{Camera, ImportedSplats, NEAR, Pose, SceneFrame, Seal};
use glam::{DVec3, Vec2, Vec3};
use std::collections::HashMap;
use std::path::PathBuf;

/// Where a photo's pixels come from and what must be done to them on load.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    /// The file.
    pub path: PathBuf,
    /// Mask of things to ignore, if one was given (white = ignore).
    pub ignore: Option<PathBuf>,
    /// Mask of the pixels to use, if the reconstruction names one (black = ignore; nerfstudio's `mask_path`).
    pub usable: Option<PathBuf>,
    /// The lens as the reconstruction saw it, when the photo has to be undistorted on load.
    pub lens: Option<crate::lens::Lens>,
    /// The files as they were when the scene was opened.
    pub seal: Seal,
    /// How the file is read.
    pub reading: Reading,
}

impl Photo {
    /// The photo of a file without masks and without a lens. Its seal is on no file: it may change while it is used.
    pub fn new(path: impl Into<PathBuf>) -> Photo {
        let (seal, reading) = (Seal::default(), Reading::default());
        Photo { path: path.into(), ignore: None, usable: None, lens: None, seal, reading }
    }
}

/// How a photo's file is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reading {
    /// Most bytes that decoding the photo or one of its masks takes, at the size that the scene was opened for.
    pub bytes: u64,
    /// What is transparent is empty, not ignored: nothing of the scene stands before it.
    pub empty: bool,
    /// It is turned by its EXIF orientation though its size does not ask for it: the points' colours fit it so.
    pub turned: bool,
    /// Most pixels that the photo's file or one of its masks may have, as the scene's settings say.
    pub most_pixels: u64,
}

impl Default for Reading {
    fn default() -> Reading {
        Reading { bytes: 0, empty: false, turned: false, most_pixels: pixels_of(MEGAPIXELS) }
    }
}

/// One posed photo.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// File name relative to the photo folder; unique in a scene, and how a person names the photo.
    pub name: String,
    /// Intrinsics at the photo's full size, after undistortion.
    pub camera: Camera,
    /// World to camera, in the scene's normalised frame.
    pub pose: Pose,
    /// The pixels.
    pub photo: Photo,
    /// Whether the split holds this photo out for testing.
    pub test: bool,
}

/// One sighting of a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    /// Index into [`Scene::views`].
    pub view: u32,
    /// Pixel position at full size, after undistortion.
    pub pixel: [f32; 2],
}

/// One reconstructed point.
#[derive(Clone, Debug, PartialEq)]
pub struct Point {
    /// Position in the scene's normalised frame.
    pub position: Vec3,
    /// sRGB in [0, 1], no channel under [`crate::DARKEST`] where it comes from a file.
    pub colour: [f32; 3],
    /// The views that saw it, in order; only views of the scene, each at most once, and only pixels inside the frame.
    /// Empty where the file gives no tracks.
    pub track: Vec<Observation>,
}

/// A photo that takes no part, and why.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Skipped {
    /// Name of the photo.
    pub name: String,
    /// The reason, in words.
    pub reason: String,
}

/// Photos named one by one for one reason; more of them are counted.
const NAMED: usize = 5;

impl Skipped {
    /// Who takes no part and why, a sentence each; many photos with one reason are one sentence.
    ///
    /// ```
    /// use segwild_scene::Skipped;
    /// let of = |i: usize| Skipped { name: format!("{i}.jpg"), reason: "it has no pose".into() };
    /// let many: Vec<Skipped> = (0..900).map(of).collect();
    /// assert_eq!(Skipped::in_words(&many), ["900 photos are left out (0.jpg, 1.jpg, 2.jpg, ...): it has no pose"]);
    /// assert_eq!(Skipped::in_words(&many[..1]), ["photo 0.jpg is left out: it has no pose"]);
    /// ```
    pub fn in_words(all: &[Skipped]) -> Vec<String> {
        let mut reasons: Vec<(&str, Vec<&str>)> = Vec::new();
        let mut known: HashMap<&str, usize> = HashMap::new();
        for Skipped { name, reason } in all {
            let at = *known.entry(reason).or_insert(reasons.len());
            match reasons.get_mut(at) {
                Some((_, names)) => names.push(name),
                None => reasons.push((reason, vec![name])),
            }
        }
        let words = |(reason, names): (&str, Vec<&str>)| match names.len() {
            0..=NAMED => names.iter().map(|n| format!("photo {n} is left out: {reason}")).collect(),
            n => vec![format!("{n} photos are left out ({}): {reason}", first_named(&names))],
        };
        reasons.into_iter().flat_map(words).collect()
    }
}

/// A pile of posed photos and the points they share, in a normalised frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Scene {
    /// The usable photos, sorted by name.
    pub views: Vec<View>,
    /// The reconstructed points.
    pub points: Vec<Point>,
    /// The photos that cannot be used.
    pub skipped: Vec<Skipped>,
    /// What else is odd about the reconstruction, in words.
    pub notes: Vec<String>,
    /// Back to the file's units, for export.
    pub frame: SceneFrame,
    /// Splats that another program trained from the photos, which take the place of a training.
    pub imported: Option<ImportedSplats>,
}

impl Scene {
    /// The scene of these photos and points, which lie in the normalised frame. That frame is the file's as well: nothing is
    /// moved or scaled on export.
    pub fn new(views: Vec<View>, points: Vec<Point>) -> Scene {
        let frame = SceneFrame { origin: DVec3::ZERO, scale: 1.0 };
        Scene { views, points, skipped: Vec::new(), notes: Vec::new(), frame, imported: None }
    }

    /// Where points of the reconstruction lie in a view, whether it saw them or not, in pixels of its photo at a size of
    /// `width` x `height`: of at most 8,192, taken evenly, those that three photos and more saw and agree on. Something
    /// stands there, if only before them.
    pub fn points_in(&self, view: usize, width: usize, height: usize) -> Vec<[f32; 2]> {
        let View { camera, pose, .. } = &self.views[view];
        let (sx, sy) = (width as f32 / camera.width as f32, height as f32 / camera.height as f32);
        let lies = |p: &Point| {
            let at = pose.to_camera(p.position);
            let pixel = (at.z > NEAR).then(|| camera.pixel(at)).filter(|&pixel| camera.contains(pixel))?;
            Some([pixel.x * sx, pixel.y * sy])
        };
        let every = self.points.len().div_ceil(8192).max(1);
        self.points.iter().step_by(every).filter(|p| self.agreed(p)).filter_map(lies).collect()
    }

    /// Whether at least three photos saw a point, each within 1 % of its long side of where it lies.
    fn agreed(&self, point: &Point) -> bool {
        point.track.len() >= 3 && point.track.iter().all(|seen| self.astray(point, seen) < 0.01)
    }

    /// How far from where a point lies a photo saw it, as a share of the photo's long side; 1 where it lies behind the camera,
    /// which is as wrong as it can be.
    pub fn astray(&self, point: &Point, seen: &Observation) -> f32 {
        let View { camera, pose, .. } = &self.views[seen.view as usize];
        let at = pose.to_camera(point.position);
        let long = camera.width.max(camera.height).max(1) as f32;
        if at.z > NEAR { (camera.pixel(at) - Vec2::from(seen.pixel)).length() / long } else { 1.0 }
    }

    /// Index of the view a person means by `name`: its full name; else that without its folders and ending, or with other slashes or
    /// other case, if only one view has it.
    pub fn view_named(&self, name: &str) -> Option<usize> {
        let exact = self.views.iter().position(|v| v.name == name);
        let only = |fits: &dyn Fn(&str) -> bool| {
            let mut hits = self.views.iter().enumerate().filter(|(_, v)| fits(&v.name));
            match (hits.next(), hits.next()) {
                (Some((i, _)), None) => Some(i),
                _ => None,
            }
        };
        let wanted = key(name);
        exact
            .or_else(|| only(&|view| stem(last_part(view)) == name))
            .or_else(|| only(&|view| key(view) == wanted))
            .or_else(|| only(&|view| last_part(&key(view)) == wanted))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_lie_in_photos_that_did_not_see_them_where_three_others_agree() {
        let camera = Camera { width: 100, height: 80, fx: 90.0, fy: 90.0, cx: 50.0, cy: 40.0 };
        let views: Vec<View> = (0..4)
            .map(|i| View {
                name: format!("{i}.jpg"),
                camera,
                pose: Pose::look_at(Vec3::new(0.2 * i as f32, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y),
                photo: Photo::new(""),
                test: false,
            })
            .collect();
        let point = |at: Vec3, seen: usize, off: f32| {
            let see = |view: u32| {
                let View { camera, pose, .. } = &views[view as usize];
                let pixel = camera.pixel(pose.to_camera(at)) + Vec2::new(off, 0.0);
                Observation { view, pixel: pixel.into() }
            };
            Point { position: at, colour: [0.5; 3], track: (0..seen as u32).map(see).collect() }
        };
        let points = vec![
            point(Vec3::new(0.1, 0.2, 0.0), 3, 0.4),
            // Two are too few, and three that do not agree no better; what lies behind or beside the camera lies in no photo.
            point(Vec3::new(0.1, -0.2, 0.0), 2, 0.0),
            point(Vec3::new(0.2, 0.2, 0.0), 3, 1.4),
            point(Vec3::new(0.0, 0.0, -9.0), 3, 0.0),
            point(Vec3::new(9.0, 0.0, 0.0), 3, 0.0),
        ];
        let scene = Scene::new(views, points);
        let [at] = scene.points_in(3, 200, 160)[..] else { panic!("{:?}", scene.points_in(3, 200, 160)) };
        let wanted = camera.pixel(scene.views[3].pose.to_camera(scene.points[0].position)) * 2.0;
        assert!((Vec2::from(at) - wanted).length() < 1e-3);
    }
}
