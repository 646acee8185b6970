//! Photos that are cut out, and photos that cannot be used.

use crate::wall;
use segwild_raster::{Channels, ProjectOptions};
use segwild_scene::{LoadedPhoto, Point, ReaderError};
use segwild_trainer::{Photos, Sifted, TrainPhoto, TrainSettings, Trainer};
use std::sync::Arc;

/// Mean opacity in a held-out view where the photo is transparent, and PSNR on the object.
fn around_a_cut_out(empty: bool) -> (f32, f32) {
    let mut scene = wall::scene(9);
    // A reconstruction of cut-outs has strays beside the object.
    for i in 0..150 {
        let at = |k: usize, low: f32, high: f32| low + (high - low) * wall::noise(i, k + 20);
        scene.points.push(Point {
            position: glam::Vec3::new(at(0, -0.9, 0.9), at(1, -0.75, -0.45), at(2, -0.4, 0.4)),
            colour: [at(3, 0.0, 1.0), at(4, 0.0, 1.0), at(5, 0.0, 1.0)],
            track: vec![],
        });
    }
    let all: Vec<TrainPhoto> = scene
        .views
        .iter()
        .map(|view| {
            let (image, outside) = wall::photo_of(view);
            let (valid, empty) = (Some(outside.not()), empty.then_some(outside));
            TrainPhoto::new(LoadedPhoto { image, camera: view.camera, valid, empty }, None)
        })
        .collect();
    let photos: Arc<dyn Photos> =
        Arc::new(move |i: usize| -> Result<TrainPhoto, ReaderError> { Ok(all[i].clone()) });
    let settings = TrainSettings { splats: 1500, ..wall::settings(300) };
    let model = Trainer::new(wall::engine(), &scene, photos, settings).unwrap().finish().unwrap();
    let view = scene.views.last().unwrap();
    let (_, outside) = wall::photo_of(view);
    let engine = wall::engine();
    let projected =
        engine.project(&model.splats, &view.camera, &view.pose, &ProjectOptions::default()).unwrap();
    let values = projected.shade();
    let alpha = projected.blend(&Channels { count: 3, values: &values }).unwrap().alpha;
    let far = outside.eroded(3.0);
    let seen: f32 = far.pixels().map(|(x, y)| alpha.at(0, x as usize, y as usize)).sum();
    (seen / far.count() as f32, model.stats.psnr.unwrap())
}

#[test]
fn nothing_floats_around_an_object_whose_photos_are_cut_out() {
    let (ignored, _) = around_a_cut_out(false);
    let (empty, psnr) = around_a_cut_out(true);
    assert!(empty < 0.03 && ignored > 4.0 * empty, "opacity beside the object: {empty} for {ignored}");
    assert!(psnr > 24.0, "{psnr} dB on the object");
}

#[test]
fn a_photo_that_is_known_to_be_unusable_is_left_out_from_the_start() {
    let scene = wall::scene(6);
    let all = wall::photos(&scene, true, |_, _| {});
    let refused = vec![None, Some("its masks leave nothing of it".to_owned()), None, None, None, None];
    struct SharedPhotos(Arc<dyn Photos>);
    impl Photos for SharedPhotos {
        fn photo(&self, view: usize) -> Result<TrainPhoto, ReaderError> {
            self.0.photo(view)
        }
    }
    let photos = Arc::new(Sifted { photos: SharedPhotos(all), refused });
    let settings = wall::settings(20);
    let mut trainer = Trainer::new(wall::engine(), &scene, photos, settings).unwrap();
    assert_eq!(trainer.skipped().len(), 1);
    while !trainer.is_done() {
        trainer.step().unwrap();
    }
    let model = trainer.snapshot().unwrap();
    assert_eq!(model.trained_on, [0, 2, 3, 4], "neither the refused one nor the one held out");
    assert!(trainer.skipped()[0].reason.contains("leave nothing"));
}
