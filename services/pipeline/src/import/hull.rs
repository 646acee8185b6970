//! Cameras for splats that come without photos. They stand on shells around the splats and look at their centre, or stand in the
//! middle and look out. Those from which the splats fill the frame and none stands close before the camera are kept, spread over
//! all directions: outside an object, inside a room, and between an object and its surroundings.

use crate::RunError;
use glam::{Quat, Vec3};
use segwild_objective::Engine;
use segwild_raster::{Channels, ProjectOptions, Rasterizer};
use segwild_scene::knn::NearestPoint;
use segwild_scene::{Camera, NEAR, Pose, Splats};

/// Cameras that are kept, at most.
const VIEWS: usize = 48;
/// Distances of cameras from the centre: in median distances of splats, and one in that within which nearly all lie.
const SHELLS: [f32; 3] = [0.6, 1.0, 1.6];
const OUTER_SHELL: f32 = 2.5;
/// Directions of the cameras around the up axis, and their elevations in degrees.
const AROUND: usize = 12;
const ELEVATIONS: [f32; 4] = [-10.0, 10.0, 30.0, 60.0];
/// Degrees between a camera and its neighbour above it.
const ELEVATION_STEP: f32 = 10.0;
/// Elevations at which the cameras in the middle look out, in degrees.
const OUTWARD: [f32; 2] = [-10.0, 15.0];
/// Size of the renders by which cameras are compared, in pixels, and their focal length as a share of their width: 60 degrees.
const SIZE: (u32, u32) = (96, 72);
const FOCAL: f32 = 0.866;
/// A splat nearer than this share of the distance to the centre stands in the way.
const CLOSE: f32 = 0.25;
/// Splats by which it is decided whether a camera stands free, at most: with few, what floats alone hardly counts.
const SURFACES: usize = 20_000;
/// Largest radius of a splat on such a render, in pixels: what is larger is blurred, for no photo was taken from so near.
const FINE: f32 = 6.0;
/// Spread of the depths in a pixel, as a share of the depth, from which it shows no surface: from behind, surfaces are seen
/// through. Weight of such a pixel.
const SEEN_THROUGH: f32 = 0.1;
const UNCLEAR: f32 = 0.25;
/// Least share of the best camera's score.
const GOOD: f32 = 0.6;
/// Good cameras around which more are tried.
const SEEDS: usize = 24;
/// Share of the splats, by their distance from the centre, that the outer shell encloses.
const NEARLY_ALL: f32 = 0.98;
/// Opacity from which a splat counts as a surface.
const OPAQUE: f32 = 0.3;

/// Where splats lie.
#[derive(Clone, Copy, Debug)]
pub(super) struct SplatExtent {
    pub centre: Vec3,
    /// Median distance of splats from the centre, and that within which nearly all lie.
    pub median: f32,
    pub outer: f32,
}

impl SplatExtent {
    /// The extent of the opaque splats; of all where there is none.
    pub fn of(splats: &Splats) -> SplatExtent {
        let opaque = opaque(splats);
        let at = |share: f32, mut values: Vec<f32>| {
            values.sort_by(f32::total_cmp);
            values.get((share * values.len() as f32) as usize).or(values.last()).copied().unwrap_or(0.0)
        };
        let coordinate = |k: usize| at(0.5, opaque.iter().map(|&i| splats.means[i][k]).collect());
        let centre = Vec3::new(coordinate(0), coordinate(1), coordinate(2));
        let distances = || opaque.iter().map(|&i| splats.mean(i).distance(centre)).collect();
        // A single point has no size: any will do.
        let size = |share: f32| Some(at(share, distances())).filter(|d| *d > 0.0).unwrap_or(1.0);
        SplatExtent { centre, median: size(0.5), outer: size(NEARLY_ALL) }
    }
}

impl SplatExtent {
    /// The distance from an eye within which a splat stands in the way.
    fn near(&self, eye: Vec3) -> f32 {
        // In the middle there is no distance to the centre.
        (CLOSE * eye.distance(self.centre).max(0.5 * self.median)).max(NEAR)
    }
}

/// The splats that count as surfaces; all where there is none.
fn opaque(splats: &Splats) -> Vec<usize> {
    let opaque: Vec<usize> = (0..splats.len()).filter(|&i| splats.opacity(i) > OPAQUE).collect();
    if opaque.is_empty() { (0..splats.len()).collect() } else { opaque }
}

/// The camera of a render of this size.
pub(super) fn camera(width: u32, height: u32) -> Camera {
    let f = FOCAL * width as f32;
    Camera { width, height, fx: f, fy: f, cx: 0.5 * width as f32, cy: 0.5 * height as f32 }
}

/// The poses of cameras from which splats are seen well. `up` points up.
///
/// # Errors
/// When the engine fails, or no camera sees any splat.
pub(super) fn poses(
    engine: &dyn Engine,
    splats: &Splats,
    extent: &SplatExtent,
    up: Vec3,
) -> Result<Vec<Pose>, RunError> {
    let resident = engine.upload_splats(splats).map_err(raster)?;
    let engine: &dyn Rasterizer = resident.as_deref().unwrap_or(engine);
    let opaque = opaque(splats);
    let every = opaque.len().div_ceil(SURFACES).max(1);
    let centres: Vec<[f32; 3]> = opaque.iter().step_by(every).map(|&i| splats.means[i]).collect();
    let surfaces = NearestPoint::of(&centres);
    let scored = |stands: Vec<Stand>| -> Result<Vec<Scored>, RunError> {
        let of = |stand: Stand| {
            let pose = stand.pose(extent, up);
            let near = extent.near(pose.centre());
            let stands_free = surfaces.to(pose.centre().into()).is_none_or(|(_, distance)| distance >= near);
            let score = if stands_free { score(engine, splats, near, &pose)? } else { 0.0 };
            Ok(Scored { score, stand, pose })
        };
        stands.into_iter().map(of).collect()
    };
    let mut all = scored(stands(extent))?;
    all.sort_by(|a, b| b.score.total_cmp(&a.score));
    let best = all[0].score;
    if best <= 0.0 {
        return Err(RunError::Request("no camera around the splats sees any of them".into()));
    }
    let seeds = all.iter().take(SEEDS).filter(|seed| seed.score >= GOOD * best);
    let more = scored(seeds.flat_map(|seed| seed.stand.neighbours()).collect())?;
    all.extend(more);
    let best = all.iter().map(|camera| camera.score).fold(0.0, f32::max);
    all.retain(|camera| camera.score >= GOOD * best);
    Ok(spread(&all, extent))
}

/// Where a camera stands and looks.
#[derive(Clone, Copy)]
struct Stand {
    /// Radians around the up axis, and above the plane across it.
    azimuth: f32,
    elevation: f32,
    /// Distance from the centre, to which the camera looks; 0: it stands there and looks out.
    distance: f32,
}

/// A camera with its score.
struct Scored {
    score: f32,
    stand: Stand,
    pose: Pose,
}

impl Stand {
    fn pose(&self, extent: &SplatExtent, up: Vec3) -> Pose {
        let turned = Quat::from_axis_angle(up, self.azimuth) * up.any_orthonormal_vector();
        let direction = turned * self.elevation.cos() + up * self.elevation.sin();
        let centre = extent.centre;
        match self.distance {
            0.0 => Pose::look_at(centre, centre + direction, up),
            distance => Pose::look_at(centre + direction * distance, centre, up),
        }
    }

    /// The cameras between this one and the next.
    fn neighbours(&self) -> [Stand; 6] {
        let (across, upward) = (0.5 * std::f32::consts::TAU / AROUND as f32, ELEVATION_STEP.to_radians());
        let turned = |azimuth: f32, elevation: f32| Stand {
            azimuth: self.azimuth + azimuth,
            elevation: self.elevation + elevation,
            ..*self
        };
        let moved = |factor: f32| Stand { distance: self.distance * factor, ..turned(across, 0.5 * upward) };
        [
            turned(across, 0.0),
            turned(-across, 0.0),
            turned(0.0, upward),
            turned(0.0, -upward),
            moved(0.8),
            moved(1.25),
        ]
    }
}

fn stands(extent: &SplatExtent) -> Vec<Stand> {
    let shells = SHELLS.map(|shell| shell * extent.median).into_iter().chain([OUTER_SHELL * extent.outer]);
    let inward = shells.flat_map(|distance| ELEVATIONS.map(|elevation| (distance, elevation)));
    let all = inward.chain(OUTWARD.map(|elevation| (0.0, elevation)));
    let around = |(distance, elevation): (f32, f32)| {
        (0..AROUND).map(move |k| Stand {
            azimuth: std::f32::consts::TAU * k as f32 / AROUND as f32,
            elevation: elevation.to_radians(),
            distance,
        })
    };
    all.flat_map(around).collect()
}

pub(super) fn raster(error: segwild_raster::RasterError) -> RunError {
    RunError::Stage { stage: "geometry", reason: error.to_string() }
}

/// How much of the frame fine splats fill with surfaces, without what stands close before the camera.
fn score(engine: &dyn Rasterizer, splats: &Splats, near: f32, pose: &Pose) -> Result<f32, RunError> {
    const CHANNELS: usize = 3;
    let camera = camera(SIZE.0, SIZE.1);
    let projected = engine.project(splats, &camera, pose, &ProjectOptions::default()).map_err(raster)?;
    let radii = projected.radii();
    // Depth, its square, and whether the splat is fine.
    let values = |i: usize| {
        let z = pose.to_camera(splats.mean(i)).z;
        [z, z * z, f32::from(u8::from(radii[i] <= FINE))]
    };
    let values: Vec<f32> = (0..splats.len()).flat_map(values).collect();
    let frame = projected.blend(&Channels { count: CHANNELS, values: &values }).map_err(raster)?;
    let n = frame.alpha.data.len();
    let filled = (0..n).map(|i| {
        let alpha = frame.alpha.data[i];
        let [depth, square, fine] = [0, 1, 2].map(|c| frame.image.data[c * n + i] / alpha.max(1e-6));
        let spread = (square - depth * depth).max(0.0).sqrt();
        match depth {
            _ if depth < near => 0.0,
            _ if spread > SEEN_THROUGH * depth => UNCLEAR * alpha * fine,
            _ => alpha * fine,
        }
    });
    Ok(filled.sum::<f32>() / n as f32)
}

/// Those cameras that stand and look farthest from one another, the best first.
fn spread(cameras: &[Scored], extent: &SplatExtent) -> Vec<Pose> {
    let ahead = |pose: &Pose| pose.rotation.row(2);
    // By how many times one stands nearer than the other, and by their directions.
    let distance = |pose: &Pose| pose.centre().distance(extent.centre).max(0.1 * extent.median);
    let apart = |a: &Pose, b: &Pose| (distance(a) / distance(b)).ln().abs() + ahead(a).distance(ahead(b));
    let Some(best) = cameras.iter().max_by(|a, b| a.score.total_cmp(&b.score)) else { return Vec::new() };
    let mut kept = vec![best.pose];
    let mut distances: Vec<f32> = cameras.iter().map(|camera| apart(&camera.pose, &best.pose)).collect();
    while kept.len() < VIEWS {
        let far = distances.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
        let Some((i, _)) = far.filter(|(_, distance)| **distance > 0.0) else { break };
        kept.push(cameras[i].pose);
        for (distance, camera) in distances.iter_mut().zip(cameras) {
            *distance = distance.min(apart(&camera.pose, &cameras[i].pose));
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_raster::CpuEngine;

    /// Opaque splats of a size, on a sphere around the origin.
    fn sphere(count: usize, size: f32) -> Splats {
        let point = |i: usize| {
            let z = 1.0 - (2.0 * i as f32 + 1.0) / count as f32;
            let (sin, cos) = (2.4 * i as f32).sin_cos();
            let r = (1.0 - z * z).sqrt();
            [r * cos, r * sin, z]
        };
        Splats {
            means: (0..count).map(point).collect(),
            log_scales: vec![[size.ln(); 3]; count],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
            opacities: vec![4.0; count],
            sh_degree: 0,
            sh: vec![0.5; 3 * count],
        }
    }

    /// Distances of the cameras from the centre.
    fn stand(splats: &Splats) -> Vec<f32> {
        let extent = SplatExtent::of(splats);
        let poses = poses(&CpuEngine::new(), splats, &extent, Vec3::NEG_Y).unwrap();
        assert!((12..=VIEWS).contains(&poses.len()), "{}", poses.len());
        let nearest = poses.iter().flat_map(|a| poses.iter().map(move |b| (a, b)));
        assert!(nearest.filter(|(a, b)| a == b).count() == poses.len(), "no camera stands twice");
        poses.iter().map(|pose| pose.centre().distance(extent.centre)).collect()
    }

    #[test]
    fn cameras_stand_where_photos_of_so_fine_splats_were_taken() {
        let object = stand(&sphere(6000, 0.03));
        assert!(object.iter().all(|distance| *distance > 1.5), "an object is seen from outside: {object:?}");
        let interior = stand(&sphere(20_000, 0.015));
        assert!(
            interior.iter().any(|distance| *distance < 0.1),
            "a room from the inside as well: {interior:?}"
        );
    }

    #[test]
    fn splats_that_no_camera_sees_are_refused() {
        let mut splats = sphere(6000, 0.03);
        splats.opacities.fill(-20.0);
        let extent = SplatExtent::of(&splats);
        assert!(poses(&CpuEngine::new(), &splats, &extent, Vec3::NEG_Y).is_err());
    }

    #[test]
    fn a_single_splat_has_an_extent() {
        let one = sphere(6000, 0.03).select(&[7]);
        let extent = SplatExtent::of(&one);
        assert_eq!((extent.centre, extent.median, extent.outer), (one.mean(0), 1.0, 1.0));
    }
}
