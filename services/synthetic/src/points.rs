//! The points a reconstruction of the photos would have.

use crate::cameras::CameraShot;
use crate::options::SyntheticOptions;
use crate::photo::SyntheticPhoto;
use crate::random::Rng;
use crate::world::SyntheticWorld;
use glam::{DVec3, Vec2, Vec3};
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

/// Samples points on what the training photos see; `shots` are the photos' in the world's own units.
pub fn reconstruct(
    world: &SyntheticWorld,
    options: &SyntheticOptions,
    photos: &[SyntheticPhoto],
    shots: &[CameraShot],
) -> Vec<SyntheticPoint> {
    let mut rng = Rng::new(options.seed, 7 << 20);
    let training: Vec<usize> = (0..photos.len()).filter(|&i| !photos[i].test).collect();
    let mut points = Vec::with_capacity(options.points);
    // Some samples hit the sky or what only one photo sees.
    for _ in 0..options.points * 12 {
        if points.len() >= options.points {
            break;
        }
        let home = training[rng.below(training.len())];
        let photo = &photos[home];
        let pixel =
            Vec2::new(rng.unit() * photo.camera.width as f32, rng.unit() * photo.camera.height as f32);
        let d = (photo.pose.rotation.transpose() * photo.camera.ray(pixel)).normalize();
        let eye = shots[home].eye;
        let Some(hit) = world.closest(eye, d) else { continue };
        let truth = eye + d * hit.t;
        if (truth - world.centre).length() > REACH * world.distance {
            continue;
        }
        let instance = world.parts[usize::from(world.part(&hit))].instance;
        let mut track = Vec::new();
        let mut colour = Vec3::ZERO;
        for &view in &training {
            let seen = sighting(world, &photos[view], &shots[view], truth);
            // Matching loses a third of what could be seen.
            let matched = rng.chance(0.67) || view == home;
            let noise = Vec2::new(rng.normal(), rng.normal()).clamp_length_max(3.5) * options.pixel_noise;
            let Some(exact) = seen.filter(|_| matched) else { continue };
            let image = &photos[view].photo;
            let (x, y) = (exact.x as usize, exact.y as usize);
            colour += Vec3::new(image.at(0, x, y), image.at(1, x, y), image.at(2, x, y));
            let within = Vec2::new(image.width as f32, image.height as f32) - 0.01;
            track.push(Observation {
                view: view as u32,
                pixel: (exact + noise).clamp(Vec2::ZERO, within).into(),
            });
        }
        if track.len() < 2 {
            continue;
        }
        colour /= track.len() as f32;
        let outlier = rng.chance(options.outliers);
        // A point's error grows with its distance and shrinks with the number of rays that meet in it.
        let blur = options.pixel_noise * hit.t / photo.camera.fx / (track.len() as f32).sqrt();
        let jitter = Vec3::new(rng.normal(), rng.normal(), rng.normal()).clamp_length_max(3.0);
        let wrong = rng.triple(-1.0, 1.0) * world.distance * 0.35;
        let position = truth + if outlier { wrong } else { jitter * blur };
        if outlier {
            track.truncate(3);
        }
        points.push(SyntheticPoint {
            position: position.as_dvec3() * options.units,
            colour: colour.to_array(),
            track,
            instance,
            outlier,
        });
    }
    points
}

/// Where a photo sees a point of a surface, if it does.
fn sighting(world: &SyntheticWorld, photo: &SyntheticPhoto, shot: &CameraShot, truth: Vec3) -> Option<Vec2> {
    let p = shot.pose.to_camera(truth);
    if p.z <= NEAR * world.distance {
        return None;
    }
    let pixel = shot.camera.pixel(p);
    if !shot.camera.contains(pixel) || photo.transients.at(pixel.x, pixel.y) {
        return None;
    }
    let slack = 2e-3 * (1.0 + p.length());
    world.sees(shot.eye, truth, slack).then_some(pixel)
}
