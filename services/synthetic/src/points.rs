//! The points a reconstruction of the photos would have.

use crate::cameras::CameraShot;
use crate::options::SyntheticOptions;
use crate::planned::PlannedPhoto;
use crate::random::Rng;
use crate::world::SyntheticWorld;
use glam::{DVec3, Vec2, Vec3};
use rayon::prelude::*;
use segwild_scene::{NEAR, Observation};

/// A reconstructed point and the truth about it.
#[derive(Clone, Debug, PartialEq)]
pub struct SyntheticPoint {
    /// Position in file units, noise included.
    pub position: DVec3,
    /// Mean sRGB of the photos that saw it, in [0, 1].
    pub colour: [f32; 3],
    /// Who saw it where, noise included; `view` is an index into the photos.
    pub track: Vec<Observation>,
    /// Instance it lies on; for an outlier, the one it was meant to lie on.
    pub instance: u16,
    /// Whether its position is wrong.
    pub outlier: bool,
}

/// Farthest distance, in distances of a full view, at which photos agree well enough on a point.
const REACH: f32 = 3.5;

/// Who sees a point where: a photo by its index, and the exact position.
type Sighted = Vec<(usize, Vec2)>;

/// Fewest photos that a thread of its own searches for a point.
const VIEWS_AT_ONCE: usize = 64;

/// Samples points on what the training photos will show.
pub fn reconstruct(
    world: &SyntheticWorld,
    options: &SyntheticOptions,
    photos: &[PlannedPhoto],
) -> Vec<SyntheticPoint> {
    let mut rng = Rng::new(options.seed, 7 << 20);
    let training: Vec<usize> = (0..photos.len()).filter(|&i| !photos[i].record.test).collect();
    let mut points = Vec::with_capacity(options.points);
    let mut seen_by: Vec<Sighted> = Vec::with_capacity(options.points);
    // Some samples hit the sky or what only one photo sees.
    for _ in 0..options.points * 12 {
        if points.len() >= options.points {
            break;
        }
        let home = training[rng.below(training.len())];
        let CameraShot { camera, pose, eye, .. } = photos[home].shot;
        let pixel = Vec2::new(rng.unit() * camera.width as f32, rng.unit() * camera.height as f32);
        let d = (pose.rotation.transpose() * camera.ray(pixel)).normalize();
        let Some(hit) = world.closest(eye, d) else { continue };
        let truth = eye + d * hit.t;
        if (truth - world.centre).length() > REACH * world.distance {
            continue;
        }
        let instance = world.parts[usize::from(world.part(&hit))].instance;
        let views = training.par_iter().with_min_len(VIEWS_AT_ONCE);
        let seen: Vec<Option<Vec2>> = views.map(|&view| sighting(world, &photos[view], truth)).collect();
        let mut track = Vec::new();
        let mut sighted = Sighted::new();
        for (&view, seen) in training.iter().zip(seen) {
            // Matching loses a third of what could be seen.
            let matched = rng.chance(0.67) || view == home;
            let noise = Vec2::new(rng.normal(), rng.normal()).clamp_length_max(3.5) * options.pixel_noise;
            let Some(exact) = seen.filter(|_| matched) else { continue };
            sighted.push((view, exact));
            let camera = photos[view].shot.camera;
            let within = Vec2::new(camera.width as f32, camera.height as f32) - 0.01;
            track.push(Observation {
                view: view as u32,
                pixel: (exact + noise).clamp(Vec2::ZERO, within).into(),
            });
        }
        if track.len() < 2 {
            continue;
        }
        let outlier = rng.chance(options.outliers);
        // A point's error grows with its distance and shrinks with the number of rays that meet in it.
        let blur = options.pixel_noise * hit.t / camera.fx / (track.len() as f32).sqrt();
        let jitter = Vec3::new(rng.normal(), rng.normal(), rng.normal()).clamp_length_max(3.0);
        let wrong = rng.triple(-1.0, 1.0) * world.distance * 0.35;
        let position = truth + if outlier { wrong } else { jitter * blur };
        if outlier {
            track.truncate(3);
        }
        seen_by.push(sighted);
        points.push(SyntheticPoint {
            position: position.as_dvec3() * options.units,
            colour: [0.0; 3],
            track,
            instance,
            outlier,
        });
    }
    points.par_iter_mut().zip(&seen_by).for_each(|(point, sighted)| {
        point.colour = mean_colour(world, photos, sighted).to_array();
    });
    points
}

/// Where a photo sees a point of a surface, if it does.
fn sighting(world: &SyntheticWorld, photo: &PlannedPhoto, truth: Vec3) -> Option<Vec2> {
    let shot = &photo.shot;
    let p = shot.pose.to_camera(truth);
    if p.z <= NEAR * world.distance {
        return None;
    }
    let pixel = shot.camera.pixel(p);
    if !shot.camera.contains(pixel) || photo.is_covered(pixel) {
        return None;
    }
    let slack = 2e-3 * (1.0 + p.length());
    world.sees(shot.eye, truth, slack).then_some(pixel)
}

/// Mean sRGB of the photos where they see a point.
fn mean_colour(world: &SyntheticWorld, photos: &[PlannedPhoto], sighted: &[(usize, Vec2)]) -> Vec3 {
    let colours = sighted.iter().map(|&(view, exact)| photos[view].colour_at(world, exact));
    colours.fold(Vec3::ZERO, |sum, colour| sum + colour) / sighted.len() as f32
}
