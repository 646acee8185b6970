//! Multi-view stereo: adds points to those of the reconstruction where several photos agree on the depth.
//!
//! A reconstruction from keypoints has few points on a lawn, a pavement or a plain wall, and splats only grow where there
//! are some already. So the depth of each photo's pixels is estimated by PatchMatch stereo (Bleyer, Rhemann and Rother
//! 2011): planes start at the points that the photo observes, propagate from pixel to pixel and are kept where other photos
//! match on them. The other views are selected by shared points as in Schoenberger et al. 2016. Only points remain on which
//! the depths of several photos agree. Transients drop out: each photo shows them elsewhere.
//!
//! Photos are compared by normalised cross-correlation, which does not depend on their brightness.
//!
//! It makes points, no meshes and no depth maps to keep.
//!
//! ```
//! use glam::{Vec2, Vec3};
//! use segwild_mvs::{StereoImage, points};
//! use segwild_scene::{Camera, Image, Observation, Photo, Point, Pose, Scene, View};
//!
//! // Four cameras before a wall at z = 1, on which no two spots look alike.
//! let camera = Camera { width: 72, height: 54, fx: 60.0, fy: 60.0, cx: 36.0, cy: 27.0 };
//! let wall = |p: Vec3| 0.5 + 0.2 * (19.0 * p.x + 3.0 * (9.0 * p.y).sin()).sin() + 0.2 * (29.0 * p.y + 5.0 * p.x).sin();
//! let views: Vec<View> = (0..4)
//!     .map(|i| {
//!         let eye = Vec3::new(0.2 * i as f32 - 0.3, 0.0, -0.5);
//!         let pose = Pose::look_at(eye, eye + Vec3::Z, Vec3::NEG_Y);
//!         View { name: format!("{i}.jpg"), camera, pose, photo: Photo::new(""), test: false }
//!     })
//!     .collect();
//! let on_wall = |view: &View, pixel: Vec2| {
//!     let (eye, ray) = (view.pose.centre(), view.pose.rotation.transpose() * view.camera.ray(pixel));
//!     eye + ray * ((1.0 - eye.z) / ray.z)
//! };
//! let images = views.iter().map(|view| {
//!     let pixel = |i: usize| wall(on_wall(view, Vec2::new((i % 72) as f32 + 0.5, (i / 72) as f32 + 0.5)));
//!     let data = (0..3 * 72 * 54).map(|i| pixel(i % (72 * 54))).collect();
//!     StereoImage { image: Image { width: 72, height: 54, channels: 3, data }, usable: None }
//! });
//! let images = images.collect();
//! // The reconstruction has a dozen points.
//! let few = (0..12).map(|i| {
//!     let position = Vec3::new(0.2 * (i % 4) as f32 - 0.3, 0.3 * (i / 4) as f32 - 0.3, 1.0);
//!     let track = views.iter().zip(0..).filter_map(|(of, view)| {
//!         let pixel = camera.pixel(of.pose.to_camera(position));
//!         camera.contains(pixel).then(|| Observation { view, pixel: pixel.into() })
//!     });
//!     Point { position, colour: [0.5; 3], track: track.collect() }
//! });
//! let few = few.collect();
//! let scene = Scene::new(views, few);
//!
//! let found = points(&scene, &[0, 1, 2, 3], images, 1000, 1, &|_, _| false).expect("nobody stops it");
//! assert!(found.len() > 300, "{}", found.len());
//! assert!(found.iter().filter(|p| (p.position.z - 1.0).abs() < 0.03).count() * 10 > found.len() * 9);
//! ```
//!
//! Start reading at [`points`], then `sweep.rs`.

mod agree;
mod frame;
mod neighbours;
mod plane;
mod sweep;

pub use frame::StereoImage;
pub use plane::LONGEST_SIDE;

use frame::StereoFrame;
use rayon::prelude::*;
use segwild_scene::{Point, Scene};

/// Photos that a photo is compared with.
const SOURCES: usize = 5;
/// Photos whose depths are computed before `follow` is called again.
const BATCH: usize = 16;

/// Points on which the photos agree, in scene units; at most `most`, sampled at random where there are more.
///
/// `views` are indices of the views that take part; `images` are their photos in the same order. The same input gives the
/// same points, whatever the number of threads. The result is empty for fewer than two views, and for a scene without
/// points: planes have nowhere to start. Images of a few hundred pixels suffice; time and memory grow with their pixels.
/// `follow` receives the images done and their number every few images. Returns `None` if it returned true.
///
/// # Panics
/// If an image is more than [`LONGEST_SIDE`] pixels wide or high.
pub fn points(
    scene: &Scene,
    views: &[usize],
    images: Vec<StereoImage>,
    most: usize,
    seed: u64,
    follow: &dyn Fn(usize, usize) -> bool,
) -> Option<Vec<Point>> {
    let fits = |p: &StereoImage| p.image.width.max(p.image.height) <= LONGEST_SIDE;
    assert!(images.iter().all(fits), "an image is at most {LONGEST_SIDE} pixels wide and high");
    let frames: Vec<StereoFrame> =
        views.iter().zip(images).map(|(&view, image)| StereoFrame::new(scene, view, image)).collect();
    let sources = neighbours::sources(scene, &frames, SOURCES);
    let all: Vec<usize> = (0..frames.len()).collect();
    let mut depths = Vec::with_capacity(frames.len());
    for some in all.chunks(BATCH) {
        if follow(depths.len(), frames.len()) {
            return None;
        }
        let batch_depths = some.par_iter().map(|&i| {
            let others: Vec<&StereoFrame> = sources[i].iter().map(|&j| &frames[j]).collect();
            sweep::depths(&frames[i], &others, seed ^ views[i] as u64)
        });
        depths.extend(batch_depths.collect::<Vec<_>>());
    }
    Some(agree::points(scene, &frames, &sources, &depths, most, seed))
}
