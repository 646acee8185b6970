//! Multi-view stereo: points that several photos agree on, between those of the reconstruction.
//!
//! A reconstruction from keypoints says little of a lawn, a pavement or a plain wall, and splats only grow where there
//! are some already. So each photo is asked how deep each of its pixels lies: planes start at the points it saw, spread
//! from pixel to pixel and are kept where other photos look alike on them (PatchMatch stereo: Bleyer, Rhemann and Rother
//! 2011; other views chosen by their points as in Schoenberger et al. 2016). What stays are points on which the depths of
//! several photos agree; transients, whom each photo shows elsewhere, drop out.
//!
//! Photos are compared by normalised cross-correlation, which does not ask how bright each is.

mod agree;
mod frame;
mod neighbours;
mod plane;
mod sweep;

pub use frame::Picture;

use frame::Frame;
use rayon::prelude::*;
use segwild_scene::{Point, Scene};

/// Photos that a photo is compared with.
const SOURCES: usize = 5;
/// Photos that are asked between two questions whether to stop.
const BATCH: usize = 16;

/// Points of the scene that the pictures agree on, at most `most`, drawn at random where there are more.
///
/// `views` are those that take part, with their pictures in the same order. The same input gives the same points, whatever
/// the number of threads. None come of fewer than two views, nor of a scene without points: planes have nowhere to start.
/// Pictures of a few hundred pixels do: time and memory grow with what they have.
/// `None` if `stopping` said so, which is asked every few pictures.
///
/// # Panics
/// If a picture is more than 4096 pixels wide or high.
pub fn points(
    scene: &Scene,
    views: &[usize],
    pictures: Vec<Picture>,
    most: usize,
    seed: u64,
    stopping: &dyn Fn() -> bool,
) -> Option<Vec<Point>> {
    let fits = |p: &Picture| p.image.width.max(p.image.height) <= plane::LARGEST;
    assert!(pictures.iter().all(fits), "a picture is at most {} pixels wide and high", plane::LARGEST);
    let frames: Vec<Frame> =
        views.iter().zip(pictures).map(|(&view, picture)| Frame::new(scene, view, picture)).collect();
    let sources = neighbours::sources(scene, &frames, SOURCES);
    let all: Vec<usize> = (0..frames.len()).collect();
    let mut depths = Vec::with_capacity(frames.len());
    for some in all.chunks(BATCH) {
        if stopping() {
            return None;
        }
        let asked = some.par_iter().map(|&i| {
            let others: Vec<&Frame> = sources[i].iter().map(|&j| &frames[j]).collect();
            sweep::depths(&frames[i], &others, seed ^ views[i] as u64)
        });
        depths.extend(asked.collect::<Vec<_>>());
    }
    Some(agree::points(scene, &frames, &sources, &depths, most, seed))
}
