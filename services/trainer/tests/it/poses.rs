//! Camera poses that are a little off: refined by points, refined by photos, or left as they are.

use crate::wall::{engine, noise, photos, scene, settings};
use glam::{Mat3, Vec2, Vec3};
use segwild_scene::{Observation, Pose, Scene};
use segwild_trainer::{AppearanceModel, Model, RefinedBy, RefinedPose, TrainSettings, Trainer};

/// Each view saw the points that lie in its frame; every fifth one it saw elsewhere.
fn with_tracks(mut scene: Scene) -> Scene {
    for (p, point) in scene.points.iter_mut().enumerate() {
        for (v, view) in scene.views.iter().enumerate() {
            let pixel = view.camera.pixel(view.pose.to_camera(point.position));
            let wrong = if (p + v).is_multiple_of(5) { Vec2::new(20.0, -9.0) } else { Vec2::ZERO };
            if view.camera.contains(pixel) {
                point.track.push(Observation { view: v as u32, pixel: (pixel + wrong).into() });
            }
        }
    }
    scene
}

/// Turns and moves the camera of a view: three pixels of 72, and two.
fn shake(scene: &mut Scene, view: usize) {
    let pose = &mut scene.views[view].pose;
    let sign = if view.is_multiple_of(2) { 1.0 } else { -1.0 };
    pose.rotation = Mat3::from_rotation_y(sign * 0.04) * Mat3::from_rotation_x(0.02) * pose.rotation;
    pose.translation =
        Mat3::from_rotation_y(sign * 0.04) * pose.translation + Vec3::new(0.0, sign * 0.03, 0.0);
}

/// How far apart two poses have the middle of the wall, in pixels.
fn apart(scene: &Scene, view: usize, pose: &Pose) -> f32 {
    let (camera, given) = (scene.views[view].camera, &scene.views[view].pose);
    let corners = [[-0.5, 0.0], [0.5, 0.0], [0.0, 0.4], [0.0, 0.0]].map(|[x, y]| Vec3::new(x, y, 0.0));
    let off = corners.map(|p| (camera.pixel(pose.to_camera(p)) - camera.pixel(given.to_camera(p))).length());
    off.into_iter().fold(0.0, f32::max)
}

fn refined(model: &Model, view: usize) -> RefinedPose {
    model.refined_poses[view].unwrap_or_else(|| panic!("the pose of view {view} is as given"))
}

#[test]
fn poses_that_do_not_fit_their_points_are_refined_by_them() {
    let truth = with_tracks(scene(6));
    let mut off = truth.clone();
    [1, 2, 5].into_iter().for_each(|view| shake(&mut off, view));
    let mut trainer = Trainer::new(engine(), &off, photos(&truth, false, |_, _| ()), settings(3)).unwrap();
    let words = trainer.poses_by_points_in_words();
    assert!(words[0].contains("3 photos were off") && words[0].contains("01.jpg"), "{words:?}");
    let model = trainer.snapshot().unwrap();
    for view in 0..6 {
        if [1, 2, 5].contains(&view) {
            let found = refined(&model, view);
            assert_eq!(found.by, RefinedBy::Points);
            assert!(apart(&truth, view, &off.views[view].pose) > 2.0);
            assert!(
                apart(&truth, view, &found.pose()) < 0.1,
                "{view}: {}",
                apart(&truth, view, &found.pose())
            );
        } else {
            assert_eq!(model.refined_poses[view], None, "{view}");
        }
    }
    let none = TrainSettings { refine_poses: false, ..settings(3) };
    let model =
        Trainer::new(engine(), &off, photos(&truth, false, |_, _| ()), none).unwrap().snapshot().unwrap();
    assert!(model.refined_poses.iter().all(Option::is_none));
}

#[test]
fn points_that_photos_saw_with_noise_move_no_pose_that_is_right() {
    let mut truth = with_tracks(scene(6));
    for (p, point) in truth.points.iter_mut().enumerate() {
        for seen in &mut point.track {
            let off = |k: usize| 3.0 * (noise(p, 10 + 2 * seen.view as usize + k) - 0.5);
            seen.pixel = [seen.pixel[0] + off(0), seen.pixel[1] + off(1)];
        }
        // Few points: the pose that they give is off by more than a good one may be.
        if !p.is_multiple_of(9) {
            point.track.clear();
        }
    }
    let model = Trainer::new(engine(), &truth, photos(&truth, false, |_, _| ()), settings(3));
    let model = model.unwrap().snapshot().unwrap();
    assert!(model.refined_poses.iter().all(Option::is_none), "{:?}", model.refined_poses);
}

#[test]
fn a_photo_without_points_is_aligned_to_the_scene_and_the_others_stay() {
    let truth = scene(7);
    let mut off = truth.clone();
    shake(&mut off, 2);
    let trainer = Trainer::new(engine(), &off, photos(&truth, false, |_, _| ()), settings(300)).unwrap();
    let model = trainer.finish().unwrap();
    let found = refined(&model, 2);
    assert_eq!(found.by, RefinedBy::Photo);
    let (before, after) = (apart(&truth, 2, &off.views[2].pose), apart(&truth, 2, &found.pose()));
    assert!(before > 2.0 && after < 0.25 * before, "{before} px, then {after}");
    let moved = (0..7).filter(|&view| model.refined_poses[view].is_some()).count();
    assert_eq!(moved, 1, "{:?}", model.refined_poses);
    assert!(model.is_aligned());
}

#[test]
fn photos_of_many_lights_are_not_aligned() {
    let truth = scene(6);
    let mut off = truth.clone();
    shake(&mut off, 2);
    let lights = TrainSettings { appearance_model: AppearanceModel::Affine, ..settings(60) };
    let trainer = Trainer::new(engine(), &off, photos(&truth, false, |_, _| ()), lights).unwrap();
    let model = trainer.finish().unwrap();
    assert!(model.refined_poses.iter().all(Option::is_none));
}

#[test]
fn a_training_that_was_interrupted_goes_on_with_its_refined_poses() {
    let truth = scene(6);
    let mut off = truth.clone();
    shake(&mut off, 2);
    let start = || Trainer::new(engine(), &off, photos(&truth, false, |_, _| ()), settings(120)).unwrap();
    let whole = start().finish().unwrap();
    let mut half = start();
    (0..70).for_each(|_| drop(half.step().unwrap()));
    let checkpoint = half.checkpoint().unwrap();
    let rest = Trainer::resume(engine(), &off, photos(&truth, false, |_, _| ()), checkpoint).unwrap();
    assert!(rest.finish().unwrap() == whole);
}
