//! Training by blocks: two rooms side by side, with one wall through both.

use crate::wall::{assert_sane, bytes, engine, noise};
use glam::Vec3;
use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, DARKEST, NEAR, Observation, Photo, Point, Pose, Scene, Splats, View};
use segwild_trainer::{
    AppearanceModel, DensityKind, Photos, Protocol, TrainPhoto, TrainSettings, Trainer, evaluate,
    trained_share,
};
use std::collections::BTreeSet;
use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

const VIEWS: usize = 16;
/// Views held out: in either room, and where they meet.
const HELD_OUT: [usize; 3] = [3, 8, 13];

/// The wall, from x = -2 to x = 2; the second room starts at 0 and is darker.
fn rooms() -> Splats {
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for i in 0..56 * 16 {
        let (x, y) = (i % 56, i / 56);
        let at = [x as f32 / 55.0 * 4.0 - 2.0, y as f32 / 15.0 * 1.2 - 0.6, 0.05 * noise(i, 9)];
        splats.means.push(at);
        splats.log_scales.push([0.045f32.ln(); 3]);
        splats.rotations.push([1.0, 0.0, 0.0, 0.0]);
        splats.opacities.push(4.0);
        let light = if x < 28 { 1.0 } else { 0.85 };
        let patch = x / 4 + 20 * (y / 4);
        let colour = [0, 1, 2].map(|k| light * (0.15 + 0.7 * noise(patch, k)));
        splats.sh.extend(colour.map(|c| (c - 0.5) / 0.282_094_79));
    }
    splats
}

/// Cameras along the wall, each of which sees a quarter of it.
fn scene() -> Scene {
    let truth = rooms();
    let view = |i: usize| {
        let x = i as f32 / (VIEWS - 1) as f32 * 2.9 - 1.45;
        let eye = Vec3::new(x, 0.1 * (2.0 * x).cos(), -1.0 - 0.1 * (i % 3) as f32);
        let aside = if i.is_multiple_of(2) { 0.15 } else { -0.15 };
        View {
            name: format!("{i:02}.jpg"),
            camera: Camera { width: 48, height: 36, fx: 48.0, fy: 48.0, cx: 24.0, cy: 18.0 },
            pose: Pose::look_at(eye, Vec3::new(x + aside, 0.0, 0.0), Vec3::NEG_Y),
            photo: Photo::new("none"),
            test: HELD_OUT.contains(&i),
        }
    };
    let point = |i: usize| Point {
        position: truth.mean(i) + 0.01 * Vec3::new(noise(i, 3), noise(i, 4), noise(i, 5)),
        colour: [0, 1, 2].map(|k| truth.sh[3 * i + k] * 0.282_094_79 + 0.5),
        track: vec![],
    };
    Scene::new((0..VIEWS).map(view).collect(), (0..truth.len()).step_by(3).map(point).collect())
}

/// The same as it may come from another program: points without colours, of which every other one has a track, and a
/// pose that they find to be off.
fn colourless(mut scene: Scene) -> Scene {
    let seen = |view: &View, position: Vec3| {
        let at = view.pose.to_camera(position);
        let pixel = view.camera.pixel(at);
        (at.z > NEAR && view.camera.contains(pixel)).then(|| pixel.to_array())
    };
    for (i, point) in scene.points.iter_mut().enumerate() {
        point.colour = [DARKEST; 3];
        if i.is_multiple_of(2) {
            let views = scene.views.iter().enumerate();
            let saw = views.filter_map(|(view, of)| Some((view as u32, seen(of, point.position)?)));
            point.track = saw.map(|(view, pixel)| Observation { view, pixel }).collect();
        }
    }
    scene.views[6].pose.translation.x += 0.1;
    scene
}

fn photos(scene: &Scene) -> Arc<dyn Photos> {
    let (splats, engine) = (rooms(), CpuEngine::new());
    let photo = |view: &View| {
        let projected =
            engine.project(&splats, &view.camera, &view.pose, &ProjectOptions::default()).unwrap();
        let colours = projected.shade();
        let image = projected.blend(&Channels { count: 3, values: &colours }).unwrap().image;
        TrainPhoto { image, valid: None, sky: None, transients: None }
    };
    let all: Vec<TrainPhoto> = scene.views.iter().map(photo).collect();
    Arc::new(move |i: usize| Ok::<_, Infallible>(all[i].clone()))
}

fn settings(blocks: usize) -> TrainSettings {
    TrainSettings {
        blocks,
        effort: 1.0,
        splats: 900,
        sh_degree: 1,
        appearance_model: AppearanceModel::None,
        robust: false,
        ..TrainSettings::default()
    }
}

#[test]
fn two_blocks_show_what_one_shows_and_the_seam_does_not_stand_out() {
    let scene = scene();
    let photos = photos(&scene);
    let train = |blocks: usize| {
        let mut trainer = Trainer::new(engine(), &scene, photos.clone(), settings(blocks)).unwrap();
        let mut trained = Vec::new();
        while !trainer.is_done() {
            trained.push(trainer.step().unwrap().view);
        }
        let seams = trainer.seam_check(&|| false).unwrap();
        let model = trainer.snapshot().unwrap();
        assert_sane(&model, 900);
        assert_eq!(model.trained_on.len(), VIEWS - HELD_OUT.len());
        assert!(model.stats.psnr.is_some());
        let score =
            evaluate(&model, &*engine(), &scene, photos.clone(), &HELD_OUT, Protocol::Plain, None).unwrap();
        (score, seams, trained)
    };
    let (whole, none, _) = train(1);
    assert_eq!(none, None, "a whole scene has no seams");
    let (divided, seams, trained) = train(2);
    assert!(divided.psnr > whole.psnr - 0.5, "{} dB in two blocks, {} in one", divided.psnr, whole.psnr);
    let seams = seams.unwrap();
    assert_eq!(seams.blocks, 2);
    assert!(seams.photos >= 2 && !seams.stands_out(), "{}", seams.in_words());
    // In the turn of a block the photos of the other room alone do not come.
    let during = |from: f32, to: f32| -> BTreeSet<usize> {
        let at = |share: f32| (share * trained.len() as f32) as usize;
        trained[at(from)..at(to)].iter().copied().collect()
    };
    let (first, second) = (during(0.3, 0.5), during(0.65, 0.85));
    assert!(!first.is_superset(&second) && !second.is_superset(&first), "{first:?}, {second:?}");
}

#[test]
fn a_training_by_blocks_that_stops_anywhere_ends_in_the_same_bytes() {
    let coloured = scene();
    let photos = photos(&coloured);
    let colourless = colourless(coloured.clone());
    for (scene, appearance_model, density, robust) in [
        (&coloured, AppearanceModel::None, DensityKind::Budget, false),
        (&coloured, AppearanceModel::Embed, DensityKind::Budget, false),
        (&colourless, AppearanceModel::Affine, DensityKind::Mcmc, true),
    ] {
        let settings =
            TrainSettings { steps: 60, splats: 400, appearance_model, density, robust, ..settings(3) };
        let run = |stops: &[u32]| {
            let mut trainer = Trainer::new(engine(), scene, photos.clone(), settings.clone()).unwrap();
            for &stop in stops {
                while trainer.steps_done() < stop {
                    trainer.step().unwrap();
                }
                let held = wincode::deserialize(&bytes(&trainer.checkpoint().unwrap())).unwrap();
                trainer = Trainer::resume(engine(), scene, photos.clone(), held).unwrap();
            }
            // Past the end the blocks take further turns.
            while trainer.steps_done() < 80 {
                trainer.step().unwrap();
            }
            bytes(&trainer.checkpoint().unwrap())
        };
        // The whole scene is trained up to step 15, the last block up to step 54.
        assert!(run(&[]) == run(&[1, 15, 16, 31, 54, 60, 67]), "{appearance_model}: stopping matters");
    }
}

#[test]
fn photos_keep_appearance_background_and_pose_once_blocks_are_trained() {
    let mut scene = scene();
    let photos = photos(&scene);
    // No point confirms the poses, and this one is off: it is aligned to the splats where photos share an appearance.
    scene.views[6].pose.translation.x += 0.03;
    for appearance_model in [AppearanceModel::None, AppearanceModel::Affine] {
        let settings =
            TrainSettings { steps: 80, splats: 400, robust: true, appearance_model, ..settings(2) };
        let mut trainer = Trainer::new(engine(), &scene, photos.clone(), settings).unwrap();
        let mut model_at = |step: u32| {
            while trainer.steps_done() < step {
                trainer.step().unwrap();
            }
            trainer.snapshot().unwrap()
        };
        // The coarse training ends at step 20; the blocks, the seams and further turns of the blocks follow.
        let coarse = model_at(20);
        assert_eq!(coarse.backgrounds.iter().flatten().count(), VIEWS - HELD_OUT.len());
        let end = model_at(100);
        assert!(end.splats != coarse.splats, "{appearance_model}: the blocks are trained");
        assert!(end.appearance == coarse.appearance, "{appearance_model}: an appearance changed");
        assert!(end.backgrounds == coarse.backgrounds, "{appearance_model}: a background changed");
        assert_eq!(end.refined_poses, coarse.refined_poses, "{appearance_model}");
    }
}

#[test]
fn a_block_whose_photos_are_gone_stays_as_it_is_and_the_training_goes_on() {
    let scene = scene();
    let (all, gone) = (photos(&scene), Arc::new(AtomicBool::new(false)));
    let are_gone = gone.clone();
    // The first two photos show nothing of the second block and of the seams.
    let source = move |view: usize| match view >= 2 && are_gone.load(Ordering::Relaxed) {
        true => Err("it is gone".into()),
        false => all.photo(view),
    };
    let settings = TrainSettings { steps: 80, splats: 400, photo_cache_mib: 0, ..settings(2) };
    let mut trainer = Trainer::new(engine(), &scene, Arc::new(source), settings).unwrap();
    let mut model_at = |step: u32| {
        while trainer.steps_done() < step {
            trainer.step().unwrap();
        }
        trainer.snapshot().unwrap()
    };
    let coarse = model_at(20);
    gone.store(true, Ordering::Relaxed);
    let (first_block, second_block, end) = (model_at(55), model_at(70), model_at(80));
    assert!(first_block.splats != coarse.splats && first_block.splats == second_block.splats);
    assert_sane(&end, 400);
    assert_eq!(end.trained_on, [0, 1], "photos that are gone are not counted");
}

#[test]
fn a_scene_that_cannot_be_divided_has_one_block_and_its_steps() {
    let mut one = scene();
    let (pose, divided) = (one.views[0].pose, settings(4).decided(&one));
    one.views.iter_mut().for_each(|view| view.pose = pose);
    one.points.clear();
    let (whole, undivided) = (settings(1).decided(&one), settings(4).decided(&one));
    assert_eq!((undivided.blocks, undivided.steps), (1, whole.steps));
    assert!(divided.blocks == 4 && divided.steps > whole.steps, "{} steps", divided.steps);
}

#[test]
fn a_block_is_a_part_of_the_scene_and_too_many_blocks_are_refused() {
    let scene = scene();
    assert!((0.5..0.7).contains(&trained_share(&scene, 2)), "{}", trained_share(&scene, 2));
    let many = TrainSettings { blocks: 1000, ..settings(1) };
    let refused = Trainer::new(engine(), &scene, photos(&scene), many).err().unwrap().to_string();
    assert!(refused.contains("blocks"), "{refused}");
}
