//! Points without a colour of their own.

use crate::wall::*;
use segwild_scene::{DARKEST, Scene};
use segwild_trainer::{AppearanceModel, Protocol, TrainSettings, Trainer, evaluate};

fn painted(scene: &Scene, colour: [f32; 3]) -> Scene {
    let mut scene = scene.clone();
    scene.points.iter_mut().for_each(|p| p.colour = colour);
    scene
}

#[test]
fn points_without_colour_train_as_well_as_coloured_ones() {
    let coloured = scene(8);
    let photos = photos(&coloured, false, |_, _| ());
    let score = |scene: &Scene| {
        let model = train(scene, photos.clone(), settings(150));
        evaluate(&model, &*engine(), scene, photos.clone(), &[7], Protocol::Plain, None).unwrap().psnr
    };
    let right = score(&coloured);
    for (name, colour) in [("black", DARKEST), ("white", 1.0), ("grey", 0.5)] {
        let found = score(&painted(&coloured, [colour; 3]));
        assert!(found > right - 0.5, "{name}: {found} dB instead of {right}");
    }
}

#[test]
fn a_training_without_point_colours_goes_on_in_the_same_bytes() {
    let scene = painted(&scene(6), [DARKEST; 3]);
    let photos = photos(&scene, true, |_, _| ());
    let run = |stops: &[u32]| {
        let settings = TrainSettings { appearance_model: AppearanceModel::Affine, ..settings(20) };
        let mut trainer = Trainer::new(engine(), &scene, photos.clone(), settings).unwrap();
        for &stop in stops {
            while trainer.steps_done() < stop {
                trainer.step().unwrap();
            }
            trainer =
                Trainer::resume(engine(), &scene, photos.clone(), trainer.checkpoint().unwrap()).unwrap();
        }
        while !trainer.is_done() {
            trainer.step().unwrap();
        }
        bytes(&trainer.checkpoint().unwrap())
    };
    assert!(run(&[]) == run(&[1, 3]));
}
