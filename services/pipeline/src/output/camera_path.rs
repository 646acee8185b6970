//! Cameras of a sequence of renders: through photos, or around an object.

use glam::{DVec3, Mat3, Quat, Vec3};
use segwild_nn::eigen;
use segwild_scene::statistics::{quantile, upper_median};
use segwild_scene::{Camera, NEAR, Pose, Splats, choice};
use std::f32::consts::TAU;

choice! {
    /// The way of the camera.
    pub enum CameraPath {
        /// Through the photos, in their order.
        Photos = "photos",
        /// Around the object, which stands alone: a full turn.
        Turntable = "turntable",
        /// Around the object in its scene: to and fro where photos were taken, a full turn where they were taken all around.
        Orbit = "orbit",
    }
}

/// Share of a turntable's image that the object's sphere fills.
const FILLED: f32 = 0.85;
/// Half the angle of view of a turntable, in degrees: that of a lens of 50 mm on a full frame.
const HALF_VIEW: f32 = 20.0;
/// Elevations of a turntable, in degrees: from below an object shows what nobody photographed, from high above its top alone.
const ELEVATIONS: (f32, f32) = (5.0, 35.0);
/// Photos all around an object leave no gap wider than this, in degrees.
const GAP: f32 = 60.0;
/// An orbit's distance and elevation are those of the photos within about so many degrees.
const NEARBY: f32 = 20.0;
/// Share of an object's splats within its sphere.
const NEARLY_ALL: f32 = 0.98;

/// A camera of a sequence.
#[derive(Clone, Copy, Debug)]
pub(super) struct PathCamera {
    pub camera: Camera,
    pub pose: Pose,
}

/// A camera on the way from a photo to the next.
#[derive(Clone, Copy, Debug)]
pub(super) struct InterpolatedCamera {
    pub at: PathCamera,
    /// The first of the two, by its index on the path, and the share of the way to the next, 0 to 1.
    pub first: usize,
    pub share: f32,
}

/// A smooth path through the cameras of two photos or more: centres along a Catmull-Rom spline, rotations slerped, intrinsics of the
/// first with the focal length blended. The long side of the images is `size` pixels.
///
/// # Panics
/// With fewer than two photos or frames.
pub(super) fn through_photos(photos: &[PathCamera], frames: u32, size: u32) -> Vec<InterpolatedCamera> {
    let key = |k: isize| &photos[k.clamp(0, photos.len() as isize - 1) as usize];
    let rotation = |pose: &Pose| Quat::from_mat3(&pose.rotation.transpose());
    let lens = key(0).camera.scaled_to(size);
    (0..frames)
        .map(|f| {
            let at = f as f32 / (frames - 1) as f32 * (photos.len() - 1) as f32;
            let k = (at as usize).min(photos.len() - 2) as isize;
            let t = at - k as f32;
            let c = |i: isize| key(k + i).pose.centre();
            let centre = catmull_rom(c(-1), c(0), c(1), c(2), t);
            let turn = rotation(&key(k).pose).slerp(rotation(&key(k + 1).pose), t);
            let rotation = Mat3::from_quat(turn).transpose();
            let relative = |i: isize| key(k + i).camera.fy / key(k + i).camera.height as f32;
            let focal = (relative(0) * (1.0 - t) + relative(1) * t) * lens.height as f32;
            let (cx, cy) = (lens.width as f32 / 2.0, lens.height as f32 / 2.0);
            let camera = Camera { fx: focal, fy: focal, cx, cy, ..lens };
            let pose = Pose { rotation, translation: -(rotation * centre) };
            InterpolatedCamera { at: PathCamera { camera, pose }, first: k as usize, share: t }
        })
        .collect()
}

fn catmull_rom(a: Vec3, b: Vec3, c: Vec3, d: Vec3, t: f32) -> Vec3 {
    0.5 * ((2.0 * b)
        + (c - a) * t
        + (2.0 * a - 5.0 * b + 4.0 * c - d) * t * t
        + (3.0 * b - a - 3.0 * c + d) * t * t * t)
}

/// A sphere that holds nearly all of an object.
#[derive(Clone, Copy, Debug)]
pub(super) struct ObjectSphere {
    pub centre: Vec3,
    pub radius: f32,
}

impl ObjectSphere {
    /// The sphere of the splats of an object; `None` where it has none.
    pub fn of(splats: &Splats, object: &[usize]) -> Option<ObjectSphere> {
        let middle = |axis: usize| {
            let values = || object.iter().map(|&i| splats.means[i][axis]).collect();
            Some(0.5 * (quantile(values(), 1.0 - NEARLY_ALL)? + quantile(values(), NEARLY_ALL)?))
        };
        let centre = Vec3::new(middle(0)?, middle(1)?, middle(2)?);
        let distances = object.iter().map(|&i| splats.mean(i).distance(centre)).collect();
        // A single point has no size: any will do.
        let radius = quantile(distances, NEARLY_ALL).filter(|r| *r > 0.0).unwrap_or(1.0);
        Some(ObjectSphere { centre, radius })
    }
}

/// Where a camera stands around an object: angles in radians, the distance in the scene's units.
#[derive(Clone, Copy, Debug, PartialEq)]
struct AroundObject {
    azimuth: f32,
    elevation: f32,
    distance: f32,
}

/// Axes around an object: azimuths run from the first towards the second, the third points up.
#[derive(Clone, Copy, Debug)]
struct ObjectAxes {
    centre: Vec3,
    ahead: Vec3,
    across: Vec3,
    up: Vec3,
}

impl ObjectAxes {
    fn new(centre: Vec3, up: Vec3) -> ObjectAxes {
        let ahead = up.any_orthonormal_vector();
        ObjectAxes { centre, ahead, across: up.cross(ahead), up }
    }

    fn of(&self, point: Vec3) -> AroundObject {
        let offset = point - self.centre;
        let distance = offset.length();
        let height = if distance > 0.0 { (offset.dot(self.up) / distance).clamp(-1.0, 1.0) } else { 0.0 };
        AroundObject {
            azimuth: offset.dot(self.across).atan2(offset.dot(self.ahead)),
            elevation: height.asin(),
            distance,
        }
    }

    /// Where photos were taken from.
    fn of_photos(&self, photos: &[PathCamera]) -> Vec<AroundObject> {
        photos.iter().map(|photo| self.of(photo.pose.centre())).collect()
    }

    /// The pose of a camera that faces the object.
    fn pose(&self, at: &AroundObject) -> Pose {
        let level = self.ahead * at.azimuth.cos() + self.across * at.azimuth.sin();
        let direction = level * at.elevation.cos() + self.up * at.elevation.sin();
        Pose::look_at(self.centre + direction * at.distance, self.centre, self.up)
    }
}

/// Up in a scene: people hold cameras level, so it is the direction across which cameras are turned least. Where all are turned
/// alike this leaves a choice, and the mean of what is up in the photos decides.
pub(crate) fn scene_up<'a>(poses: impl Iterator<Item = &'a Pose> + Clone) -> Vec3 {
    /// What the photos' own up weighs against cameras turned by a right angle: as much as those that hands tilt by three degrees.
    const OWN_UP: f64 = 0.003;
    let own = poses.clone().map(|pose| -pose.rotation.row(1)).sum::<Vec3>();
    let Some(up) = own.try_normalize() else { return Vec3::NEG_Y };
    let across = poses.map(|pose| (pose.rotation.row(0), 1.0));
    let mut moments = [0.0; 9];
    for (axis, weight) in across.chain([(up, -OWN_UP * f64::from(own.length()))]) {
        let axis: [f64; 3] = axis.as_dvec3().into();
        for (k, moment) in moments.iter_mut().enumerate() {
            *moment += weight * axis[k / 3] * axis[k % 3];
        }
    }
    // The eigenvector of the least eigenvalue is the last row.
    let (_, vectors) = eigen::symmetric(moments.to_vec(), 3);
    let level = DVec3::from_slice(&vectors[6..]).as_vec3();
    (level * level.dot(up).signum()).normalize_or(up)
}

/// The cameras that have the object in their frame; all where none has.
fn showing(photos: &[PathCamera], sphere: &ObjectSphere) -> Vec<PathCamera> {
    let shows = |photo: &&PathCamera| {
        let at = photo.pose.to_camera(sphere.centre);
        at.z > NEAR && photo.camera.contains(photo.camera.pixel(at))
    };
    let shown: Vec<PathCamera> = photos.iter().filter(shows).copied().collect();
    if shown.is_empty() { photos.to_vec() } else { shown }
}

/// A full turn around an object that stands alone: square images of `size` pixels, from the elevation of the photos that show it.
///
/// # Panics
/// Without photos.
pub(super) fn turntable(
    photos: &[PathCamera],
    up: Vec3,
    sphere: &ObjectSphere,
    frames: u32,
    size: u32,
) -> Vec<PathCamera> {
    let axes = ObjectAxes::new(sphere.centre, up);
    let positions = axes.of_photos(&showing(photos, sphere));
    let (low, high) = (ELEVATIONS.0.to_radians(), ELEVATIONS.1.to_radians());
    let elevations = positions.iter().map(|at| at.elevation).collect();
    let elevation = upper_median(elevations).expect("there are photos").clamp(low, high);
    // It begins where most photos were taken.
    let sum = |of: fn(f32) -> f32| positions.iter().map(|at| of(at.azimuth)).sum::<f32>();
    let start = sum(f32::sin).atan2(sum(f32::cos));
    let half = HALF_VIEW.to_radians();
    let distance = sphere.radius / half.sin() / FILLED;
    let side = size as f32;
    let f = 0.5 * side / half.tan();
    let camera = Camera { width: size, height: size, fx: f, fy: f, cx: 0.5 * side, cy: 0.5 * side };
    let at = |frame: u32| {
        let azimuth = start + TAU * frame as f32 / frames as f32;
        PathCamera { camera, pose: axes.pose(&AroundObject { azimuth, elevation, distance }) }
    };
    (0..frames).map(at).collect()
}

/// The widest of the gaps between azimuths, as its end and its width, in radians.
fn widest_gap(mut azimuths: Vec<f32>) -> (f32, f32) {
    azimuths.sort_by(f32::total_cmp);
    let count = azimuths.len();
    let gap = |k: usize| {
        let next = azimuths[(k + 1) % count] + if k + 1 == count { TAU } else { 0.0 };
        (next, next - azimuths[k])
    };
    (0..count).map(gap).max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0.0, TAU))
}

/// Around an object in its scene, so that the last image leads to the first. Distance and elevation are those of the photos
/// nearby, the lens is the median one. The long side of the images is `size` pixels.
///
/// # Panics
/// Without photos.
pub(super) fn orbit(
    photos: &[PathCamera],
    up: Vec3,
    sphere: &ObjectSphere,
    frames: u32,
    size: u32,
) -> Vec<PathCamera> {
    let axes = ObjectAxes::new(sphere.centre, up);
    let mut shown = showing(photos, sphere);
    let positions = axes.of_photos(&shown);
    let (start, gap) = widest_gap(positions.iter().map(|at| at.azimuth).collect());
    let full = gap <= GAP.to_radians();
    let swing = 0.5 * (TAU - gap);
    let relative = |photo: &PathCamera| photo.camera.fx / photo.camera.width.max(photo.camera.height) as f32;
    shown.sort_by(|a, b| relative(a).total_cmp(&relative(b)));
    let camera = shown[shown.len() / 2].camera.scaled_to(size);
    let at = |frame: u32| {
        let turn = TAU * frame as f32 / frames as f32;
        let azimuth = if full { start + turn } else { start + swing + swing * turn.sin() };
        PathCamera { camera, pose: axes.pose(&nearby(&positions, azimuth)) }
    };
    (0..frames).map(at).collect()
}

/// Where photos near an azimuth were taken from: the mean of the logarithms of their distances, and of their elevations.
fn nearby(positions: &[AroundObject], azimuth: f32) -> AroundObject {
    let apart = |at: &AroundObject| (at.azimuth - azimuth + 0.5 * TAU).rem_euclid(TAU) - 0.5 * TAU;
    let nearest = positions.iter().map(|at| apart(at).abs()).fold(f32::INFINITY, f32::min);
    let (mut sum, mut elevation, mut log_distance) = (0.0, 0.0, 0.0);
    for at in positions {
        // Relative to the nearest, so that one counts wherever the camera is.
        let weight = (0.5 * (nearest.powi(2) - apart(at).powi(2)) / NEARBY.to_radians().powi(2)).exp();
        sum += weight;
        elevation += weight * at.elevation;
        log_distance += weight * at.distance.max(NEAR).ln();
    }
    AroundObject { azimuth, elevation: elevation / sum, distance: (log_distance / sum).exp() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Camera = Camera { width: 300, height: 200, fx: 320.0, fy: 320.0, cx: 150.0, cy: 100.0 };
    const SPHERE: ObjectSphere = ObjectSphere { centre: Vec3::new(3.0, -1.0, 2.0), radius: 0.5 };
    /// Up is the negative second axis, as in COLMAP's photos.
    const UP: Vec3 = Vec3::NEG_Y;

    /// Photos of the object, from azimuths in degrees.
    fn photos(degrees: impl Iterator<Item = f32>) -> Vec<PathCamera> {
        let axes = ObjectAxes::new(SPHERE.centre, UP);
        let photo = |(k, azimuth): (usize, f32)| {
            let distance = 3.0 + 0.2 * (k % 3) as f32;
            let at = AroundObject { azimuth: azimuth.to_radians(), elevation: 0.5, distance };
            PathCamera { camera: CAMERA, pose: axes.pose(&at) }
        };
        degrees.enumerate().map(photo).collect()
    }

    fn up_of(photos: &[PathCamera]) -> Vec3 {
        scene_up(photos.iter().map(|photo| &photo.pose))
    }

    /// Where the cameras of a path stand around the object.
    fn around(path: &[PathCamera]) -> Vec<AroundObject> {
        let axes = ObjectAxes::new(SPHERE.centre, UP);
        path.iter().map(|at| axes.of(at.pose.centre())).collect()
    }

    #[test]
    fn up_is_across_the_turns_of_level_cameras_that_all_face_down() {
        let part = photos((0..8).map(|k| 10.0 * k as f32));
        assert!(up_of(&part).dot(UP) > 0.9998, "{}", up_of(&part));
        // Of a single direction the photos' own up is taken.
        let one = photos([20.0; 5].into_iter());
        assert!(up_of(&one).dot(-one[0].pose.rotation.row(1)) > 0.9999);
        assert_eq!(up_of(&[]), Vec3::NEG_Y);
    }

    #[test]
    fn a_turntable_turns_once_with_the_whole_object_in_the_frame() {
        let part = photos((0..8).map(|k| 100.0 + 10.0 * k as f32));
        let path = turntable(&part, up_of(&part), &SPHERE, 36, 64);
        let at = around(&path);
        assert!((at[0].azimuth.to_degrees() - 135.0).abs() < 1.0, "{:?}", at[0]);
        for (k, (PathCamera { camera, pose }, position)) in path.iter().zip(&at).enumerate() {
            let apart = (position.azimuth - at[0].azimuth).rem_euclid(TAU).to_degrees();
            assert!((apart - 10.0 * k as f32).abs() < 0.5, "{apart} in frame {k}");
            assert!((position.elevation - 0.5).abs() < 0.03, "{position:?}");
            let centre = pose.to_camera(SPHERE.centre);
            assert!(centre.x.abs() < 1e-4 && centre.y.abs() < 1e-4, "{centre}");
            let radius = camera.fx * (SPHERE.radius / centre.z).asin().tan();
            assert!((0.75..0.95).contains(&(radius / 32.0)), "{radius}");
            assert!((pose.rotation * UP).y < 0.0, "it stands upright");
        }
    }

    #[test]
    fn an_orbit_keeps_to_where_photos_were_taken() {
        // From 300 to 50 degrees, through north.
        let part = photos((0..12).map(|k| 300.0 + 10.0 * k as f32));
        let at = around(&orbit(&part, up_of(&part), &SPHERE, 48, 300));
        let off = |at: &AroundObject| (at.azimuth.to_degrees() - 355.0 + 180.0).rem_euclid(360.0) - 180.0;
        let reach = at.iter().map(off).fold(0.0f32, |most, off| most.max(off.abs()));
        assert!((50.0..55.1).contains(&reach), "{reach}");
        let step = at.iter().zip(at.iter().cycle().skip(1)).map(|(a, b)| (off(a) - off(b)).abs());
        assert!(step.fold(0.0, f32::max) < 8.0, "it leads back to its beginning");
        assert!(at.iter().all(|at| (2.9..3.5).contains(&at.distance) && (at.elevation - 0.5).abs() < 0.03));
    }

    #[test]
    fn an_orbit_turns_fully_where_photos_were_taken_all_around() {
        let all = photos((0..18).map(|k| 20.0 * k as f32));
        let at = around(&orbit(&all, up_of(&all), &SPHERE, 36, 300));
        for (a, b) in at.iter().zip(at.iter().cycle().skip(1)) {
            let step = (b.azimuth - a.azimuth).rem_euclid(TAU).to_degrees();
            assert!((step - 10.0).abs() < 0.1, "{step}");
        }
    }

    #[test]
    fn one_photo_is_enough_for_a_path_around_an_object() {
        let one = photos([30.0].into_iter());
        for path in [turntable, orbit] {
            let path = path(&one, up_of(&one), &SPHERE, 5, 64);
            assert!(path.len() == 5 && path.iter().all(|at| at.pose.centre().is_finite()));
        }
    }

    #[test]
    fn stray_splats_do_not_enlarge_an_objects_sphere() {
        let mut means: Vec<[f32; 3]> = (0..200).map(|k| [0.01 * k as f32, 0.0, 5.0]).collect();
        means.push([500.0, 0.0, 0.0]);
        let splats = Splats { means, ..Splats::default() };
        let object: Vec<usize> = (0..201).collect();
        let sphere = ObjectSphere::of(&splats, &object).unwrap();
        assert!((0.9..1.1).contains(&sphere.radius) && (sphere.centre.x - 1.0).abs() < 0.1, "{sphere:?}");
        assert!(ObjectSphere::of(&splats, &[]).is_none());
        assert_eq!(ObjectSphere::of(&splats, &[3]).unwrap().radius, 1.0);
    }
}
