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
//! Start reading at [`points`], then `sweep.rs`.

mod agree;
mod frame;
mod neighbours;
mod plane;
mod sweep;

pub use frame::StereoImage;

use frame::StereoFrame;
use rayon::prelude::*;
use segwild_scene::{Point, Scene};

/// Photos that a photo is compared with.
const SOURCES: usize = 5;
/// Photos whose depths are computed before `stopping` is polled again.
const BATCH: usize = 16;

/// Points on which the photos agree, in scene units; at most `most`, sampled at random where there are more.
///
/// `views` are indices of the views that take part; `images` are their photos in the same order. The same input gives the
/// same points, whatever the number of threads. The result is empty for fewer than two views, and for a scene without
/// points: planes have nowhere to start. Images of a few hundred pixels suffice; time and memory grow with their pixels.
/// Returns `None` if `stopping` returned true; it is polled every few images.
///
/// # Panics
/// If an image is more than 4096 pixels wide or high.
pub fn points(
    scene: &Scene,
    views: &[usize],
    images: Vec<StereoImage>,
    most: usize,
    seed: u64,
    stopping: &dyn Fn() -> bool,
) -> Option<Vec<Point>> {
    let fits = |p: &StereoImage| p.image.width.max(p.image.height) <= plane::LARGEST;
    assert!(images.iter().all(fits), "an image is at most {} pixels wide and high", plane::LARGEST);
    let frames: Vec<StereoFrame> =
        views.iter().zip(images).map(|(&view, image)| StereoFrame::new(scene, view, image)).collect();
    let sources = neighbours::sources(scene, &frames, SOURCES);
    let all: Vec<usize> = (0..frames.len()).collect();
    let mut depths = Vec::with_capacity(frames.len());
    for some in all.chunks(BATCH) {
        if stopping() {
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
