//! Where the photos are taken from.

use crate::error::SyntheticError;
use crate::options::SyntheticOptions;
use crate::random::Rng;
use crate::world::{ObjectKind, SyntheticWorld};
use glam::{Vec2, Vec3};
use segwild_scene::{Camera, Pose};

/// Focal length, in long sides of the photo, of a camera with factor 1.
const FOCAL: f32 = 0.95;
/// Steepest elevation, in radians.
const STEEPEST: f32 = 0.66;
/// Photos taken within this azimuth of the front count as front photos, in radians.
const FRONT: f32 = 1.05;

/// One photo about to be taken, in the world's own units.
#[derive(Clone, Debug)]
pub struct CameraShot {
    /// Intrinsics.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
    /// Camera centre.
    pub eye: Vec3,
    /// Whether it is taken from the front.
    pub front: bool,
}

/// Samples the camera of one photo: the `index`-th of its split (each split has a `stream` of its own).
pub fn sample_camera(
    world: &SyntheticWorld,
    options: &SyntheticOptions,
    stream: u64,
    index: usize,
) -> Result<CameraShot, SyntheticError> {
    let mut rng = Rng::new(options.seed, stream + index as u64);
    // The golden sequence spreads any number of photos evenly over the sectors.
    let start = Rng::new(options.seed, stream).unit();
    let turn = (start + index as f32 * 0.618_034).fract();
    for attempt in 0..80 {
        let shot = draw(world, options, &mut rng, turn, attempt >= 60)?;
        if acceptable(world, &shot) {
            return Ok(shot);
        }
    }
    Err(SyntheticError::NoViewpoint { seed: options.seed, index })
}

fn draw(
    world: &SyntheticWorld,
    options: &SyntheticOptions,
    rng: &mut Rng,
    turn: f32,
    tame: bool,
) -> Result<CameraShot, SyntheticError> {
    let tau = std::f32::consts::TAU;
    // 70 % from the front, 16 % from the sides, 14 % from the back.
    let azimuth = match turn {
        t if t < 0.70 => (t / 0.70 - 0.5) * 2.0 * FRONT,
        t => {
            let (t, from, to) =
                if t < 0.86 { ((t - 0.70) / 0.16, FRONT, 2.0) } else { ((t - 0.86) / 0.14, 2.0, tau / 2.0) };
            let side = if t < 0.5 { -1.0 } else { 1.0 };
            side * (from + (to - from) * (t * 2.0).fract())
        }
    };
    let azimuth = azimuth + rng.range(-0.06, 0.06);
    let low = rng.chance(0.62);
    let elevation = if low { rng.range(0.01, 0.14) } else { rng.range(0.14, STEEPEST) };
    let factor = if tame { 1.2 } else { log_range(rng, 0.6, 2.5) };
    let focal = (factor.powf(0.55) * rng.range(0.72, 1.3)).clamp(0.7, 1.6);

    let outward =
        Vec3::new(azimuth.sin() * elevation.cos(), -azimuth.cos() * elevation.cos(), elevation.sin());
    let mut eye = Vec3::new(world.centre.x, world.centre.y, 0.0) + outward * (world.distance * factor);
    eye.z = eye.z.max(rng.range(0.45, 0.75));
    let spread = if tame { 0.0 } else { 1.0 };
    let target = world.centre
        + Vec3::new(rng.range(-1.0, 1.0) * rng.unit() * 4.2, rng.range(-1.0, 1.0), rng.range(-0.9, 1.3))
            * spread;
    let roll = rng.range(-0.025, 0.025);
    let up = Vec3::new(azimuth.cos() * roll, azimuth.sin() * roll, 1.0).normalize();

    let long = options.long_side as f32;
    let short = (long * [0.75, 0.75, 2.0 / 3.0][rng.below(3)]).round();
    let (w, h) = if rng.chance(0.34) { (short, long) } else { (long, short) };
    let f = FOCAL * focal * long;
    let camera = Camera { width: w as u32, height: h as u32, fx: f, fy: f, cx: w / 2.0, cy: h / 2.0 };
    Ok(CameraShot { camera, pose: Pose::look_at(eye, target, up), eye, front: azimuth.abs() <= FRONT + 0.07 })
}

fn log_range(rng: &mut Rng, low: f32, high: f32) -> f32 {
    low * (high / low).powf(rng.unit())
}

/// Whether a shot stands free, has something of the scene in it and is not mostly sky.
fn acceptable(world: &SyntheticWorld, shot: &CameraShot) -> bool {
    const GRID: (u32, u32) = (18, 14);
    if world.nearest(shot.eye).1 < 0.4 {
        return false;
    }
    let (mut named, mut close, mut sky, mut trees) = (0, 0, 0, 0);
    let mut seen = vec![false; world.instances.len()];
    for gy in 0..GRID.1 {
        for gx in 0..GRID.0 {
            let pixel = Vec2::new(
                (gx as f32 + 0.5) / GRID.0 as f32 * shot.camera.width as f32,
                (gy as f32 + 0.5) / GRID.1 as f32 * shot.camera.height as f32,
            );
            let d = (shot.pose.rotation.transpose() * shot.camera.ray(pixel)).normalize();
            match world.closest(shot.eye, d) {
                None => sky += 1,
                Some(hit) => {
                    let part = &world.parts[world.part(&hit) as usize];
                    let instance = &world.instances[part.instance as usize];
                    let built = instance.kind != ObjectKind::Surface
                        || matches!(instance.name.as_str(), "facade" | "hall");
                    seen[usize::from(part.instance)] |= built;
                    named += usize::from(built);
                    trees += usize::from(instance.name == "trees");
                    close += usize::from(hit.t < 1.6 && hit.solid.is_some());
                }
            }
        }
    }
    let all = (GRID.0 * GRID.1) as usize;
    let kinds = seen.iter().filter(|k| **k).count();
    kinds >= 3 && named * 5 >= all && close * 50 < all && trees * 8 < all && sky * 20 <= all * 13
}
