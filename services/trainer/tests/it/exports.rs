//! What other programs show of an exported scene: plain 3D Gaussian splatting in f64, on the file's own splats.

use crate::wall::*;
use glam::DVec3;
use segwild_objective::psnr;
use segwild_raster::ProjectOptions;
use segwild_raster::reference::{Parameters, Reference, shade};
use segwild_scene::{Export, ply};
use segwild_scene::{Image, Pose, SceneFrame, View};
use segwild_trainer::{Model, TrainSettings, render_view};

/// The position of a georeferenced scene, in metres.
const UTM: SceneFrame = SceneFrame { origin: DVec3::new(448_262.3, 5_411_932.7, 35.0), scale: 20.0 };

/// A view of an exported file, rendered as by a viewer that knows the offset of the header.
fn viewed(model: &Model, view: &View, viewer_compensates: bool) -> Image {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("scene.ply");
    Export { frame: &UTM, antialias: model.antialias, extra: &[], provenance: None }
        .write(&path, &model.splats)
        .unwrap();
    let (splats, offset) = (ply::read(&path).unwrap(), offset_of(&path));
    let centre = view.pose.centre().as_dvec3() * UTM.scale + UTM.origin - offset;
    let rotation = view.pose.rotation;
    let pose = Pose { rotation, translation: -(rotation * centre.as_vec3()) };
    let near = ProjectOptions::default().near * UTM.scale as f32;
    let options = ProjectOptions { antialias: viewer_compensates, near, ..ProjectOptions::default() };
    let parameters = Parameters::of(&splats);
    let colours = shade(&parameters, &pose);
    let reference = Reference { camera: view.camera, pose, options, cutoffs: true };
    let render = reference.render(&parameters, &colours, 3);
    let background = model.background(None).paint(&view.camera, &view.pose);
    let pixels = render.alpha.len();
    let data = (0..3 * pixels)
        .map(|i| (render.image[i] + (1.0 - render.alpha[i % pixels]) * f64::from(background.data[i])) as f32);
    Image {
        width: W as usize,
        height: H as usize,
        channels: 3,
        data: data.map(|v| v.clamp(0.0, 1.0)).collect(),
    }
}

fn offset_of(path: &std::path::Path) -> DVec3 {
    let bytes = std::fs::read(path).unwrap();
    let head = String::from_utf8_lossy(&bytes[..400]).into_owned();
    let line = head.lines().find_map(|line| line.strip_prefix("comment offset ")).unwrap();
    let numbers: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
    DVec3::new(numbers[0], numbers[1], numbers[2])
}

#[test]
fn an_exported_scene_renders_right_in_viewers_of_its_mode_and_fat_in_others() {
    let scene = scene(8);
    let photos = photos(&scene, false, |_, _| ());
    for antialias in [true, false] {
        let model = train(&scene, photos.clone(), TrainSettings { antialias, ..settings(200) });
        assert_eq!(model.options().antialias, antialias, "renders of the run do as the training did");
        let view = &scene.views[7];
        let own = render_view(&model, &*engine(), &view.camera, &view.pose, None).unwrap();
        let alike = |compensates: bool| psnr(&own, &viewed(&model, view, compensates), None);
        assert!(alike(antialias) > 50.0, "antialias {antialias}: {} dB", alike(antialias));
        assert!(alike(!antialias) < alike(antialias) - 10.0, "the modes differ: {} dB", alike(!antialias));
    }
}
