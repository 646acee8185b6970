//! Colours for points that come without any ([`Scene::colourless`]), from the photos that show them.
//!
//! A point's colour is the median over at most [`SIGHTINGS`] training photos: those of its track or, where the file gives no
//! tracks, those in which no other point occludes it. A point that no photo shows is grey.

use crate::TrainError;
use crate::photos::{Stored, TrainPhotoCache};
use rayon::prelude::*;
use segwild_scene::{Camera, DARKEST, NEAR, Pose, Scene};
use std::borrow::Cow;

/// Photos that a point is looked up in, at most.
const SIGHTINGS: usize = 9;
/// Cells along the long side of a photo in which the nearest point occludes those behind it.
const CELLS: f32 = 48.0;
/// Depth, as a multiple of that of the nearest point of its cell, beyond which a point counts as occluded.
const OCCLUDED: f32 = 1.1;
/// The colour of a point that no photo shows.
const GREY: [f32; 3] = [0.5; 3];

/// The colours that photos show of one point, a byte per value.
#[derive(Clone, Copy, Default)]
struct PointColours {
    count: u8,
    colours: [[u8; 3]; SIGHTINGS],
}

impl PointColours {
    fn add(&mut self, colour: [f32; 3]) {
        if let Some(free) = self.colours.get_mut(usize::from(self.count)) {
            *free = colour.map(|c| (c * 255.0 + 0.5) as u8);
            self.count += 1;
        }
    }

    fn is_full(&self) -> bool {
        usize::from(self.count) == SIGHTINGS
    }

    /// The median of each channel.
    fn colour(&self) -> [f32; 3] {
        let seen = &self.colours[..usize::from(self.count)];
        if seen.is_empty() {
            return GREY;
        }
        [0, 1, 2].map(|c| {
            let mut values: Vec<u8> = seen.iter().map(|colour| colour[c]).collect();
            values.sort_unstable();
            (f32::from(values[values.len() / 2]) / 255.0).max(DARKEST)
        })
    }
}

/// The scene with a colour for every point; itself where its points have one. `follow` receives the photos read and their
/// number, and returns whether to stop.
pub(crate) fn coloured<'a>(
    scene: &'a Scene,
    photos: &mut TrainPhotoCache,
    follow: &dyn Fn(usize, usize) -> bool,
) -> Result<Cow<'a, Scene>, TrainError> {
    let Some(none) = scene.colourless() else { return Ok(Cow::Borrowed(scene)) };
    let mut seen = vec![PointColours::default(); scene.points.len()];
    let wanted: Vec<bool> = scene.points.iter().map(|p| p.colour == none).collect();
    let tracked = tracked(scene, &wanted);
    let untracked: Vec<usize> =
        (0..seen.len()).filter(|&i| wanted[i] && scene.points[i].track.is_empty()).collect();
    let views = spread(scene);
    for (read, &view) in views.iter().enumerate() {
        // A photo may have to wait for its sky.
        if follow(read, views.len()) {
            return Err(TrainError::Stopped);
        }
        let Some(stored) = photos.usable(view)? else { continue };
        let camera = &scene.views[view].camera;
        for &(point, pixel) in &tracked[view] {
            sample_colour(&mut seen[point as usize], &stored, camera, pixel);
        }
        if untracked.iter().any(|&i| !seen[i].is_full()) {
            let pixels = unoccluded(scene, camera, &scene.views[view].pose);
            for &i in &untracked {
                if let Some(pixel) = pixels[i] {
                    sample_colour(&mut seen[i], &stored, camera, pixel);
                }
            }
        }
    }
    let mut coloured = scene.clone();
    for ((point, seen), _) in
        coloured.points.iter_mut().zip(&seen).zip(&wanted).filter(|(_, wanted)| **wanted)
    {
        point.colour = seen.colour();
    }
    Ok(Cow::Owned(coloured))
}

/// The views trained on, far apart ones first: the first few are spread over all.
fn spread(scene: &Scene) -> Vec<usize> {
    let train: Vec<usize> = (0..scene.views.len()).filter(|&v| !scene.views[v].test).collect();
    let every = train.len().div_ceil(SIGHTINGS).max(1);
    (0..every).flat_map(|first| train.iter().copied().skip(first).step_by(every)).collect()
}

/// Per view, the points that it saw and where: of each point at most [`SIGHTINGS`], evenly over its track.
fn tracked(scene: &Scene, wanted: &[bool]) -> Vec<Vec<(u32, [f32; 2])>> {
    let mut of_view = vec![Vec::new(); scene.views.len()];
    for (i, point) in scene.points.iter().enumerate().filter(|(i, _)| wanted[*i]) {
        let track: Vec<_> = point.track.iter().filter(|o| !scene.views[o.view as usize].test).collect();
        let every = track.len().div_ceil(SIGHTINGS).max(1);
        for o in track.into_iter().step_by(every) {
            of_view[o.view as usize].push((i as u32, o.pixel));
        }
    }
    of_view
}

/// Adds the photo's colour at a pixel of its full size, unless that is masked or sky.
fn sample_colour(seen: &mut PointColours, stored: &Stored, camera: &Camera, pixel: [f32; 2]) {
    let (_, photo) = stored.level(1);
    let at = |p: f32, full: u32, side: usize| ((p / full as f32 * side as f32) as usize).min(side - 1);
    let (x, y) = (at(pixel[0], camera.width, photo.width), at(pixel[1], camera.height, photo.height));
    let i = y * photo.width + x;
    if photo.counts(i) {
        seen.add(photo.colour(i));
    }
}

/// Per point, its pixel in a view, if it lies in the frame and no other point occludes it.
fn unoccluded(scene: &Scene, camera: &Camera, pose: &Pose) -> Vec<Option<[f32; 2]>> {
    let size = camera.width.max(camera.height) as f32 / CELLS;
    let columns = (camera.width as f32 / size) as usize + 1;
    let cell = |pixel: glam::Vec2| (pixel.y / size) as usize * columns + (pixel.x / size) as usize;
    let lies: Vec<_> = scene
        .points
        .par_iter()
        .map(|p| {
            let at = pose.to_camera(p.position);
            let pixel = (at.z > NEAR).then(|| camera.pixel(at)).filter(|&pixel| camera.contains(pixel))?;
            Some((pixel, at.z))
        })
        .collect();
    let rows = (camera.height as f32 / size) as usize + 1;
    let mut nearest = vec![f32::INFINITY; columns * rows];
    for &(pixel, z) in lies.iter().flatten() {
        let least = &mut nearest[cell(pixel)];
        *least = least.min(z);
    }
    let open = |&(pixel, z): &(glam::Vec2, f32)| z <= OCCLUDED * nearest[cell(pixel)];
    lies.into_iter().map(|at| at.filter(open).map(|(pixel, _)| pixel.to_array())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TrainPhoto;
    use glam::Vec3;
    use segwild_scene::{Image, Observation, Photo, Point, View};
    use std::convert::Infallible;
    use std::sync::Arc;

    const SIZE: (u32, u32) = (64, 48);

    fn camera() -> Camera {
        Camera { width: SIZE.0, height: SIZE.1, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 }
    }

    fn scene(points: Vec<Point>, views: usize) -> Scene {
        let view = |i: usize| View {
            name: format!("{i}.jpg"),
            camera: camera(),
            pose: Pose::look_at(Vec3::new(0.1 * i as f32, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y),
            photo: Photo::new("none"),
            test: false,
        };
        Scene::new((0..views).map(view).collect(), points)
    }

    fn point(position: Vec3, colour: [f32; 3], track: &[u32]) -> Point {
        let track = track.iter().map(|&view| Observation { view, pixel: [32.0, 24.0] }).collect();
        Point { position, colour, track }
    }

    /// Photos of one colour each; the third cannot be read.
    fn photos(views: usize) -> TrainPhotoCache {
        let of = |view: usize| match view {
            2 => Err("it is broken".to_owned()),
            _ => {
                let image = Image::filled(SIZE.0 as usize, SIZE.1 as usize, 3, 0.1 * (view + 1) as f32);
                Ok(TrainPhoto { image, valid: None, sky: None, transients: None })
            }
        };
        TrainPhotoCache::new(Arc::new(of), (0..views).map(|i| i.to_string()).collect(), 1 << 20)
    }

    #[test]
    fn black_points_take_the_median_colour_of_their_track() {
        let black = [DARKEST; 3];
        let points = vec![point(Vec3::ZERO, black, &[0, 1, 2, 4]), point(Vec3::X, [0.7; 3], &[0])];
        let scene = scene(points, 5);
        let got = coloured(&scene, &mut photos(5), &|_, _| false).unwrap();
        assert!((got.points[0].colour[0] - 0.2).abs() < 0.005, "{:?}", got.points[0].colour);
        assert_eq!(got.points[1].colour, [0.7; 3], "a colour of its own stays");
    }

    #[test]
    fn points_without_tracks_take_colours_where_nothing_occludes_them() {
        let points = vec![
            point(Vec3::ZERO, [DARKEST; 3], &[]),
            point(Vec3::new(0.0, 0.0, 3.0), [DARKEST; 3], &[]),
            point(Vec3::new(0.0, 0.0, -9.0), [DARKEST; 3], &[]),
        ];
        let scene = scene(points, 1);
        let got = coloured(&scene, &mut photos(1), &|_, _| false).unwrap();
        assert!((got.points[0].colour[0] - 0.1).abs() < 0.005, "{:?}", got.points[0].colour);
        assert_eq!(got.points[1].colour, GREY, "it stands behind the first");
        assert_eq!(got.points[2].colour, GREY, "it stands behind the camera");
    }

    #[test]
    fn coloured_points_are_left_alone_and_no_photo_is_read() {
        let points = (0..20).map(|i| point(Vec3::ZERO, [0.04 * i as f32; 3], &[2])).collect();
        let scene = scene(points, 3);
        let refuse = |_: usize| -> Result<TrainPhoto, Infallible> { panic!("no photo is needed") };
        let mut photos = TrainPhotoCache::new(Arc::new(refuse), vec![String::new(); 3], 1 << 20);
        assert!(matches!(coloured(&scene, &mut photos, &|_, _| false), Ok(Cow::Borrowed(_))));
    }
}
