//! What the points of a reconstruction say of a photo's pose: the pose by the points that the photo saw, and how sure it is
//! (robust resection; method, section 3).

use crate::camera_motion::{NormalEquations, TUKEY, flow, form, moved};
use glam::{DVec2, Vec2, Vec3};
use segwild_scene::statistics::upper_median;
use segwild_scene::{Camera, NEAR, Pose, Scene};

/// Most steps, and the root mean square of a step, as a share of the long side, at which they end.
const STEPS: usize = 20;
const SETTLED: f64 = 1e-6;
/// Fewest points that leave no other pose open.
const MIN_POINTS: usize = 6;
/// Least standard deviation of where a photo saw a point, as a share of its long side: a quarter of a pixel of 1,000.
const MIN_DEVIATION: f64 = 2.5e-4;
/// Standard deviations, along one axis, for the median of the distance in the plane.
const DEVIATION_OF_MEDIAN: f64 = 1.0 / 1.1774;
/// Pixels across and down at which a pose's deviation is measured.
const GRID: usize = 5;

/// A point that a photo saw, and where in it, in pixels.
pub(crate) type SeenPoint = (Vec3, Vec2);

/// The pose of a photo by the points that it saw.
pub(crate) struct Resection {
    pub pose: Pose,
    /// Median distance of the points from where the photo saw them, as a share of its long side.
    pub residual: f32,
    /// The same of the given pose.
    pub given_residual: f32,
    /// Root mean square over the photo of the standard deviation of where the pose has a pixel, as a share of the long side.
    pub deviation: f32,
    /// Root mean square of how far the given pose has the points from where this one has them, likewise.
    pub motion: f32,
}

/// The points that each view saw.
pub(crate) fn seen_points(scene: &Scene) -> Vec<Vec<SeenPoint>> {
    let mut seen = vec![Vec::new(); scene.views.len()];
    for point in &scene.points {
        for o in &point.track {
            if let Some(seen) = seen.get_mut(o.view as usize) {
                seen.push((point.position, Vec2::from(o.pixel)));
            }
        }
    }
    seen
}

/// Points in front of a camera: offset from where it saw them, where they lie, and their depth.
fn projected(camera: &Camera, pose: &Pose, seen: &[SeenPoint]) -> Vec<(DVec2, Vec2, f64)> {
    let of = |&(point, pixel): &SeenPoint| {
        let at = pose.to_camera(point);
        let lies = (at.z > NEAR).then(|| camera.pixel(at))?;
        Some(((lies - pixel).as_dvec2(), lies, f64::from(at.z)))
    };
    seen.iter().filter_map(of).collect()
}

/// The pose by the points that a photo saw; `None` where they are too few, or say nothing.
pub(crate) fn resect(camera: &Camera, given: &Pose, seen: &[SeenPoint]) -> Option<Resection> {
    let long = f64::from(camera.width.max(camera.height));
    let mut pose = *given;
    let (mut found, mut given_residual) = (None, None);
    for _ in 0..STEPS {
        let points = projected(camera, &pose, seen);
        if points.len() < MIN_POINTS {
            return None;
        }
        let residual = upper_median(points.iter().map(|(off, ..)| off.length()).collect())?;
        given_residual.get_or_insert(residual);
        let deviation = (DEVIATION_OF_MEDIAN * residual).max(MIN_DEVIATION * long);
        let limit = TUKEY * deviation;
        let mut equations = NormalEquations::default();
        for &(off, lies, depth) in &points {
            let inside = (1.0 - (off.length() / limit).powi(2)).max(0.0);
            let [across, down] = flow(camera, lies, depth);
            equations.add(inside * inside, &across, off.x);
            equations.add(inside * inside, &down, off.y);
        }
        let twist = equations.twist()?;
        let moves = |&(_, lies, depth): &(DVec2, Vec2, f64)| {
            flow(camera, lies, depth).map(|flow| (0..6).map(|k| flow[k] * twist[k]).sum::<f64>().powi(2))
        };
        let squares: f64 = points.iter().flat_map(moves).sum();
        let depth = upper_median(points.iter().map(|&(.., depth)| depth).collect())?;
        found = Some((equations, deviation, residual, depth));
        pose = moved(&pose, &twist);
        if (squares / points.len() as f64).sqrt() < SETTLED * long {
            break;
        }
    }
    let (equations, deviation, residual, depth) = found?;
    let covariance = equations.covariance()?;
    let across = |i: usize, side: u32| (i as f32 + 0.5) / GRID as f32 * side as f32;
    let variance = |i: usize| {
        let pixel = Vec2::new(across(i % GRID, camera.width), across(i / GRID, camera.height));
        flow(camera, pixel, depth).iter().map(|flow| form(flow, &covariance, flow)).sum::<f64>()
    };
    let mean = (0..GRID * GRID).map(variance).sum::<f64>() / (GRID * GRID) as f64;
    let (mut square, mut count) = (0.0, 0u32);
    for (point, _) in seen {
        let (from, to) = (given.to_camera(*point), pose.to_camera(*point));
        if from.z > NEAR && to.z > NEAR {
            square += f64::from((camera.pixel(from) - camera.pixel(to)).length_squared());
            count += 1;
        }
    }
    Some(Resection {
        pose,
        residual: (residual / long) as f32,
        given_residual: (given_residual? / long) as f32,
        deviation: (deviation * mean.max(0.0).sqrt() / long) as f32,
        motion: ((square / f64::from(count.max(1))).sqrt() / long) as f32,
    })
}
