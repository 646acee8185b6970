//! A wall and a floor whose depths are known, seen by photos of different brightness.

use glam::{Vec2, Vec3};
use segwild_mvs::{StereoImage, points};
use segwild_scene::{Camera, Image, Mask, Observation, Photo, Point, Pose, Random, Scene, View};

const W: u32 = 144;
const H: u32 = 108;

/// The wall stands at z = 1, the floor lies at y = 0.5 before it; y points down.
fn surface(eye: Vec3, ray: Vec3) -> Vec3 {
    let wall = eye + ray * ((1.0 - eye.z) / ray.z);
    if wall.y <= 0.5 { wall } else { eye + ray * ((0.5 - eye.y) / ray.y) }
}

fn off_surface(p: Vec3) -> f32 {
    (p.z - 1.0).abs().min((p.y - 0.5).abs())
}

/// A pattern that is nowhere the same twice.
fn pattern(p: Vec3) -> f32 {
    let mut sum = 0.5;
    for (k, f) in [7.0f32, 13.0, 23.0, 37.0].into_iter().enumerate() {
        let k = k as f32;
        sum += 0.11 * (f * p.x + 2.0 * k + 3.0 * (f * 0.61 * (p.y + p.z) + k).sin()).sin();
    }
    sum
}

fn camera() -> Camera {
    Camera { width: W, height: H, fx: 120.0, fy: 120.0, cx: 72.0, cy: 54.0 }
}

/// Six views from left to right, some points that they observe, and their photos; `light` gives a photo's brightness.
fn world(light: impl Fn(usize) -> f32) -> (Scene, Vec<StereoImage>) {
    let views: Vec<View> = (0..6)
        .map(|i| {
            let eye = Vec3::new(0.25 * i as f32 - 0.6, -0.1, -1.2);
            View {
                name: format!("{i}.jpg"),
                camera: camera(),
                pose: Pose::look_at(eye, Vec3::new(0.0, 0.2, 0.8), Vec3::NEG_Y),
                photo: Photo::new("none"),
                test: false,
            }
        })
        .collect();
    let ray = |view: &View, pixel: Vec2| view.pose.rotation.transpose() * view.camera.ray(pixel);
    let mut random = Random::new(3);
    let mut sown = Vec::new();
    for _ in 0..60 {
        let pixel = Vec2::new(W as f32 * random.uniform(), H as f32 * random.uniform());
        let home = &views[random.below(6)];
        let position = surface(home.pose.centre(), ray(home, pixel));
        let track = views.iter().enumerate().filter_map(|(v, view)| {
            let pixel = view.camera.pixel(view.pose.to_camera(position));
            view.camera.contains(pixel).then(|| Observation { view: v as u32, pixel: pixel.into() })
        });
        sown.push(Point { position, colour: [0.5; 3], track: track.collect() });
    }
    let images = views
        .iter()
        .enumerate()
        .map(|(v, view)| {
            let mut image = Image::zeros(W as usize, H as usize, 3);
            for i in 0..(W * H) as usize {
                let pixel = Vec2::new((i % W as usize) as f32 + 0.5, (i / W as usize) as f32 + 0.5);
                let value = light(v) * pattern(surface(view.pose.centre(), ray(view, pixel)));
                (0..3).for_each(|c| image.plane_mut(c)[i] = value);
            }
            StereoImage { image, usable: None }
        })
        .collect();
    (Scene::new(views, sown), images)
}

fn found(scene: &Scene, images: Vec<StereoImage>, most: usize) -> Vec<Point> {
    let views: Vec<usize> = (0..scene.views.len()).collect();
    points(scene, &views, images, most, 1, &|_, _| false).expect("nobody stops it")
}

#[test]
fn points_lie_on_what_the_photos_show_whatever_their_light() {
    let (scene, images) = world(|v| 0.5 + 0.1 * v as f32);
    let all = found(&scene, images, usize::MAX);
    assert!(all.len() > 1500, "only {} points", all.len());
    let mut off: Vec<f32> = all.iter().map(|p| off_surface(p.position)).collect();
    off.sort_by(f32::total_cmp);
    // A pixel is 0.018 wide at the wall.
    let (middle, most) = (off[off.len() / 2], off[off.len() * 19 / 20]);
    assert!(middle < 0.01 && most < 0.04, "half of them lie {middle} off, 95 % {most}");
    let floor = all.iter().filter(|p| p.position.z < 0.9).count();
    assert!(floor * 10 > all.len(), "{floor} of {} on the floor", all.len());
    for point in &all {
        assert!(point.track.len() >= 3 && point.track.is_sorted_by(|a, b| a.view < b.view));
        for o in &point.track {
            let view = &scene.views[o.view as usize];
            let there = view.camera.pixel(view.pose.to_camera(point.position));
            assert!(there.distance(o.pixel.into()) < 1.5, "{there} for {:?}", o.pixel);
        }
    }
}

#[test]
fn a_transient_in_one_photo_and_what_may_not_be_used_start_nothing() {
    let (scene, mut images) = world(|_| 1.0);
    // A rectangle of another pattern covers part of the third photo, and half of every other is not to be used.
    let covered = |x: u32, y: u32| (50..80).contains(&x) && (30..70).contains(&y);
    for i in 0..(W * H) as usize {
        let (x, y) = (i as u32 % W, i as u32 / W);
        if covered(x, y) {
            let v = 0.5 + 0.4 * ((x * 7 + y * 3) as f32).sin();
            (0..3).for_each(|c| images[2].image.plane_mut(c)[i] = v);
        }
    }
    for (v, input) in images.iter_mut().enumerate() {
        input.usable = (v != 2).then(|| Mask::from_fn(W, H, |_, y| y < H / 2));
    }
    let all = found(&scene, images, usize::MAX);
    assert!(all.len() > 300, "only {} points", all.len());
    for o in all.iter().flat_map(|p| &p.track) {
        let (x, y) = (o.pixel[0] as u32, o.pixel[1] as u32);
        // A patch reaches two pixels beyond its middle.
        assert!(o.view == 2 || y <= H / 2 + 2, "({x}, {y}) of photo {} is not to be used", o.view);
        let within = (53..77).contains(&x) && (33..67).contains(&y);
        assert!(o.view != 2 || !within, "({x}, {y}) is the transient's");
    }
}

#[test]
fn the_same_points_come_of_any_number_of_threads_and_they_are_spread() {
    let (scene, _) = world(|_| 1.0);
    let by = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| found(&scene, world(|_| 1.0).1, 400))
    };
    let one = by(1);
    assert_eq!(one, by(3));
    assert_eq!(one.len(), 400);
    // Every sixth of the first photo's width has its part.
    let mut parts = [0; 6];
    for o in one.iter().flat_map(|p| &p.track).filter(|o| o.view == 0) {
        parts[(o.pixel[0] as u32 * 6 / W) as usize] += 1;
    }
    assert!(parts.iter().all(|&n| n > 5), "{parts:?}");
}

#[test]
fn nothing_to_compare_gives_no_points_and_a_stop_none_at_all() {
    let (scene, images) = world(|_| 1.0);
    assert_eq!(
        points(&scene, &[0], vec![images.into_iter().next().unwrap()], 10, 1, &|_, _| false),
        Some(vec![])
    );
    assert_eq!(points(&scene, &[], vec![], 10, 1, &|_, _| false), Some(vec![]));
    let (mut bare, images) = world(|_| 1.0);
    bare.points.clear();
    assert_eq!(found(&bare, images, 10), vec![]);
    for (w, h) in [(1, 1), (3, 70), (5, 5), (9, 4)] {
        let tiny = |_| StereoImage { image: Image::filled(w, h, 3, 0.5), usable: None };
        assert_eq!(found(&scene, (0..6).map(tiny).collect(), 10), vec![]);
    }
    let plain = |_| StereoImage { image: Image::filled(W as usize, H as usize, 3, 0.5), usable: None };
    assert_eq!(found(&scene, (0..6).map(plain).collect(), 10), vec![], "nothing determines depths");
    let poison = |_| StereoImage { image: Image::filled(W as usize, H as usize, 3, f32::NAN), usable: None };
    assert_eq!(found(&scene, (0..6).map(poison).collect(), 10), vec![]);
    let (scene, images) = world(|_| 1.0);
    assert_eq!(points(&scene, &[0, 1, 2, 3, 4, 5], images, 10, 1, &|_, _| true), None);
}
