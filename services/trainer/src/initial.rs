//! The splats training starts from (method, section 2).

use glam::{Mat3, Vec3};
use segwild_scene::Random;
use segwild_scene::knn;
use segwild_scene::ply::SH0;
use segwild_scene::statistics::upper_median;
use segwild_scene::{Camera, DARKEST, NEAR, Point, Pose, Scene, Splats, logit};

/// What training starts from.
pub(crate) struct Initial {
    pub splats: Splats,
    /// Scene units per pixel of a training photo at the scene's median depth.
    pub pixel: f32,
    pub warnings: Vec<String>,
}

/// One training camera at the size trained at.
pub(crate) type Eye = (Camera, Pose);

/// Splats from the reconstruction's points and those of `stereo` between them; from random ones where there are none.
///
/// `eyes` has an entry for every view of the scene that is trained on.
pub(crate) fn initial_splats(
    scene: &Scene,
    stereo: &[Point],
    eyes: &[Option<Eye>],
    sh_degree: u32,
    cap: usize,
    random: &mut Random,
) -> Initial {
    let mut warnings = Vec::new();
    let cameras: Vec<&Eye> = eyes.iter().flatten().collect();
    let mut positions: Vec<[f32; 3]> = Vec::new();
    let mut colours: Vec<[f32; 3]> = Vec::new();
    // Scene units per pixel at each point, from the nearest camera that saw it.
    let mut pixels: Vec<f32> = Vec::new();
    let mut lost = 0;
    for point in scene.points.iter().chain(stereo) {
        let tracked = point.track.iter().filter_map(|o| eyes.get(o.view as usize)?.as_ref());
        let pixel = pixel_size(point.position, tracked)
            .or_else(|| pixel_size(point.position, cameras.iter().copied()))
            .filter(|_| point.position.is_finite() && point.colour.iter().all(|c| c.is_finite()));
        match pixel {
            Some(pixel) => {
                positions.push(point.position.into());
                colours.push(point.colour);
                pixels.push(pixel);
            }
            None => lost += 1,
        }
    }
    if lost > 0 {
        warnings.push(format!(
            "{lost} of {} points lie before no training camera and are left out",
            scene.points.len() + stereo.len()
        ));
    }
    let mut distances = knn::nearest(&positions, 3).mean_distances();
    let outliers = drop_outliers(&mut positions, &mut colours, &mut pixels, &mut distances);
    if outliers > 0 {
        warnings.push(format!("{outliers} isolated points are left out"));
    }
    if positions.len() > cap {
        warnings.push(format!("{} points, but at most {cap} splats: a random part starts", positions.len()));
        let mut keep: Vec<usize> = (0..positions.len()).collect();
        random.shuffle(&mut keep);
        keep.truncate(cap);
        keep.sort_unstable();
        positions = keep.iter().map(|&i| positions[i]).collect();
        colours = keep.iter().map(|&i| colours[i]).collect();
        pixels = keep.iter().map(|&i| pixels[i]).collect();
        distances = knn::nearest(&positions, 3).mean_distances();
    }
    if positions.len() < 32 {
        let n = cap.clamp(1, 3000);
        warnings.push(format!(
            "only {} points: {n} random splats in the cameras' common view are added",
            positions.len()
        ));
        for p in random_points(&cameras, n, random) {
            pixels.push(pixel_size(p, cameras.iter().copied()).unwrap_or(1e-3));
            positions.push(p.into());
            colours.push([0.5; 3]);
        }
        distances = knn::nearest(&positions, 3).mean_distances();
    }
    let pixel = upper_median(pixels.clone()).expect("there are points, if random ones");
    let splats = first_splats(positions, &colours, &pixels, &distances, sh_degree);
    Initial { splats, pixel, warnings }
}

/// First splats at points. `pixels`: scene units per pixel of the nearest photo at each; `distances`: its mean distance
/// to its three neighbours.
pub(crate) fn first_splats(
    positions: Vec<[f32; 3]>,
    colours: &[[f32; 3]],
    pixels: &[f32],
    distances: &[f32],
    sh_degree: u32,
) -> Splats {
    let n = positions.len();
    let stride = 3 * (sh_degree as usize + 1).pow(2);
    let mut sh = vec![0.0; n * stride];
    for (i, c) in colours.iter().enumerate() {
        for k in 0..3 {
            sh[i * stride + k] = (c[k].clamp(DARKEST, 1.0) - 0.5) / SH0;
        }
    }
    let log_scales = distances
        .iter()
        .zip(pixels)
        .map(|(&d, &px)| [(d * INITIAL_SCALE).clamp(0.3 * px, 16.0 * px).ln(); 3])
        .collect();
    Splats {
        means: positions,
        log_scales,
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacities: vec![logit(INITIAL_OPACITY); n],
        sh_degree,
        sh,
    }
}

/// Standard deviation of a first splat, in mean distances to its three neighbours.
const INITIAL_SCALE: f32 = 0.7;
/// Opacity of a first splat. Twice the usual 0.1: short trainings have little time to fill in.
const INITIAL_OPACITY: f32 = 0.2;

/// Scene units per pixel at a point, for the camera where it is least.
fn pixel_size<'a>(p: Vec3, eyes: impl Iterator<Item = &'a Eye>) -> Option<f32> {
    eyes.filter_map(|(camera, pose)| {
        let z = pose.to_camera(p).z;
        (z > NEAR).then(|| z / camera.fx.max(camera.fy))
    })
    .min_by(f32::total_cmp)
}

/// Drops points that stand alone: more than 40 pixels from their neighbours and more than 8 times the
/// upper quartile, as long as they are few (5 %).
fn drop_outliers(
    positions: &mut Vec<[f32; 3]>,
    colours: &mut Vec<[f32; 3]>,
    pixels: &mut Vec<f32>,
    distances: &mut Vec<f32>,
) -> usize {
    let n = positions.len();
    if n < 100 {
        return 0;
    }
    let spread: Vec<f32> = distances.iter().zip(pixels.iter()).map(|(d, p)| d / p).collect();
    let mut sorted = spread.clone();
    sorted.sort_by(f32::total_cmp);
    let limit = (8.0 * sorted[n * 3 / 4]).max(40.0).max(sorted[n * 19 / 20]);
    let keep: Vec<usize> = (0..n).filter(|&i| spread[i] <= limit).collect();
    let pick = |v: &mut Vec<[f32; 3]>| *v = keep.iter().map(|&i| v[i]).collect();
    pick(positions);
    pick(colours);
    *pixels = keep.iter().map(|&i| pixels[i]).collect();
    *distances = keep.iter().map(|&i| distances[i]).collect();
    n - keep.len()
}

/// The point nearest to all optical axes; one extent ahead where they do not determine it.
fn focus(eyes: &[&Eye]) -> Vec3 {
    let (mut a, mut b) = (Mat3::ZERO, Vec3::ZERO);
    let mut ahead = Vec3::ZERO;
    for (_, pose) in eyes {
        let d = pose.rotation.row(2);
        let m = Mat3::IDENTITY - Mat3::from_cols(d * d.x, d * d.y, d * d.z);
        a += m;
        b += m * pose.centre();
        ahead += pose.centre() + d;
    }
    let n = eyes.len().max(1) as f32;
    let ridge = 0.02 * n;
    (a + Mat3::from_diagonal(Vec3::splat(ridge))).inverse() * (b + ahead / n * ridge)
}

/// Random points where as many cameras as possible look: in front of a random camera at a random pixel,
/// at a third to three times the distance of the focus.
fn random_points(eyes: &[&Eye], n: usize, random: &mut Random) -> Vec<Vec3> {
    let focus = focus(eyes);
    let mut wanted = eyes.len().div_ceil(2);
    let mut out = Vec::with_capacity(n);
    let mut misses = 0;
    while out.len() < n {
        let (camera, pose) = eyes[random.below(eyes.len())];
        let far = (focus - pose.centre()).length().max(10.0 * NEAR);
        let depth = far * 3f32.powf(2.0 * random.uniform() - 1.0);
        let pixel =
            glam::Vec2::new(random.uniform() * camera.width as f32, random.uniform() * camera.height as f32);
        let p = pose.rotation.transpose() * (camera.ray(pixel) * depth - pose.translation);
        let seen = eyes
            .iter()
            .filter(|(c, pose)| {
                let q = pose.to_camera(p);
                q.z > NEAR && c.contains(c.pixel(q))
            })
            .count();
        if seen >= wanted {
            out.push(p);
        } else {
            misses += 1;
            if misses > 20 * n {
                misses = 0;
                wanted = wanted.saturating_sub(1).max(1);
            }
        }
        // A camera can fail to see even the points it drew, by rounding at its border: let those through
        // when nothing else is left.
        if wanted == 1 && seen == 0 && misses > 10 * n {
            out.push(p);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use segwild_scene::{Observation, Point};

    fn scene(points: Vec<Point>) -> Scene {
        Scene::new(vec![], points)
    }

    fn eye(x: f32) -> Option<Eye> {
        let camera = Camera { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        Some((camera, Pose::look_at(Vec3::new(x, 0.0, -2.0), Vec3::ZERO, Vec3::NEG_Y)))
    }

    #[test]
    fn without_points_random_splats_stand_in_the_cameras_view() {
        for eyes in [vec![eye(0.0)], vec![eye(-0.5), None, eye(0.5), eye(0.0)]] {
            let start = initial_splats(&scene(vec![]), &[], &eyes, 1, 500, &mut Random::new(1));
            assert_eq!(start.splats.len(), 500);
            assert!(start.warnings.iter().any(|w| w.contains("random")));
            let cameras: Vec<Eye> = eyes.into_iter().flatten().collect();
            for i in 0..500 {
                let seen = cameras.iter().filter(|(c, p)| {
                    let q = p.to_camera(start.splats.mean(i));
                    q.z > NEAR && c.contains(c.pixel(q))
                });
                assert!(seen.count() * 2 >= cameras.len());
            }
        }
    }

    #[test]
    fn a_black_point_starts_where_its_colour_can_learn() {
        let point = Point { position: Vec3::ZERO, colour: [0.0, 1.0, 0.5], track: vec![] };
        let start = initial_splats(&scene(vec![]), &[point], &[eye(0.0)], 1, 10, &mut Random::new(1));
        let raw: Vec<f32> = (0..3).map(|c| start.splats.sh[c] * SH0 + 0.5).collect();
        assert!(raw.iter().all(|&c| c > 1e-3), "a colour of 0 takes no gradient: {raw:?}");
    }

    #[test]
    fn points_become_splats_of_their_colour_and_outliers_go() {
        let mut r = Random::new(2);
        let mut points: Vec<Point> = (0..400)
            .map(|_| Point {
                position: Vec3::new(r.normal(), r.normal(), r.normal()) * 0.1,
                colour: [0.2, 0.5, 0.9],
                track: vec![Observation { view: 0, pixel: [0.0; 2] }],
            })
            .collect();
        points.push(Point { position: Vec3::new(80.0, 0.0, 5.0), ..points[0].clone() });
        points.push(Point { position: Vec3::new(0.0, 0.0, -9.0), ..points[0].clone() });
        points.push(Point { position: Vec3::NAN, ..points[0].clone() });
        let start = initial_splats(&scene(points), &[], &[eye(0.0)], 2, 10_000, &mut Random::new(1));
        assert_eq!(start.splats.len(), 400, "{:?}", start.warnings);
        let stride = start.splats.sh_stride();
        assert!((start.splats.sh[5 * stride + 2] * SH0 + 0.5 - 0.9).abs() < 1e-6);
        assert!((start.pixel - 2.0 / 60.0).abs() < 0.01);
    }
}
