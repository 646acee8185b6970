//! Stereo initialisation: splats that start between the points of the reconstruction.

use crate::wall::*;
use segwild_scene::{Observation, Scene};
use segwild_trainer::{TrainError, TrainSettings, Trainer};

/// Views of the wall of which one point in `every` is known, with who saw it.
fn sparse(every: usize) -> Scene {
    let mut scene = scene(8);
    let mut kept = 0;
    scene.points.retain(|_| {
        kept += 1;
        kept % every == 0
    });
    for point in &mut scene.points {
        let seen = scene.views.iter().enumerate().filter_map(|(v, view)| {
            let pixel = view.camera.pixel(view.pose.to_camera(point.position));
            (!view.test && view.camera.contains(pixel))
                .then(|| Observation { view: v as u32, pixel: pixel.into() })
        });
        point.track = seen.collect();
    }
    scene
}

fn started(scene: &Scene, stereo: f32) -> Trainer {
    let settings = TrainSettings { stereo, ..settings(120) };
    Trainer::prepared(engine(), scene, photos(scene, true, |_, _| {}), settings, &|_| false).unwrap()
}

#[test]
fn a_wall_of_which_few_points_are_known_starts_more_splats() {
    let scene = sparse(6);
    let none = started(&scene, 0.0);
    assert_eq!(none.stereo_count(), 0);
    let mut some = started(&scene, 0.6);
    assert!(some.stereo_count() > 200, "{} points between {}", some.stereo_count(), scene.points.len());
    // No more than the share of the splats allowed, the reconstruction's included.
    assert!(some.stereo_count() + scene.points.len() <= (0.6 * 1500.0) as usize);
    let start = some.snapshot().unwrap().splats;
    assert!(start.len() > 2 * scene.points.len(), "{} splats", start.len());
    // The wall waves by .15 around 0; a pixel is .02 wide there.
    let off = |i: usize| (start.means[i][2] - 0.15 * (3.0 * start.means[i][0]).sin()).abs();
    let near = (0..start.len()).filter(|&i| off(i) < 0.08).count();
    assert!(near * 10 > start.len() * 9, "{near} of {} splats start on the wall", start.len());
}

#[test]
fn a_resumed_training_needs_no_second_stereo_initialisation() {
    let scene = sparse(6);
    let whole = started(&scene, 0.6).finish().unwrap();
    let mut first = started(&scene, 0.6);
    while first.steps_done() < 50 {
        first.step().unwrap();
    }
    let all = photos(&scene, true, |_, _| {});
    let rest = Trainer::resume(engine(), &scene, all, first.checkpoint().unwrap()).unwrap();
    assert_eq!(rest.stereo_count(), 0);
    assert_eq!(rest.finish().unwrap(), whole);
}

#[test]
fn stereo_initialisation_can_be_stopped() {
    let scene = sparse(6);
    let settings = TrainSettings { stereo: 0.6, ..settings(120) };
    let stopped = Trainer::prepared(engine(), &scene, photos(&scene, true, |_, _| {}), settings, &|_| true);
    assert!(matches!(stopped, Err(TrainError::Stopped)));
}
