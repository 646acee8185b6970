//! Tiny scenes whose truth is known: a coloured wall with a bump, rendered by the engine itself.

use glam::Vec3;
use segwild_objective::Engine;
use segwild_raster::{Channels, CpuEngine, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, Image, Mask, Photo, Point, Pose, Scene, Splats, View};
use segwild_trainer::{AppearanceModel, Checkpoint, Model, Photos, TrainPhoto, TrainSettings, Trainer};
use std::convert::Infallible;
use std::sync::Arc;

pub const W: u32 = 72;
pub const H: u32 = 54;

pub fn engine() -> Arc<dyn Engine> {
    Arc::new(CpuEngine::new())
}

/// A number in [0, 1) from an index.
pub fn noise(i: usize, k: usize) -> f32 {
    let x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15)
        ^ (k as u64 + 7).wrapping_mul(0xd1b5_4a32_d192_ed03);
    ((x ^ (x >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 40) as f32 / (1u64 << 24) as f32
}

/// A wall of opaque splats that fills the lower two thirds of the cameras' view.
pub fn truth() -> Splats {
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for y in 0..22 {
        for x in 0..44 {
            let i = y * 44 + x;
            let (u, v) = (x as f32 / 43.0 * 2.0 - 1.0, y as f32 / 21.0 * 0.9 - 0.22);
            splats.means.push([u, v, 0.15 * (3.0 * u).sin()]);
            splats.log_scales.push([0.034f32.ln(); 3]);
            splats.rotations.push([1.0, 0.0, 0.0, 0.0]);
            splats.opacities.push(4.0);
            let patch = (x / 4) + 20 * (y / 4);
            let colour = [0, 1, 2].map(|k| 0.15 + 0.7 * noise(patch, k) + 0.1 * noise(i, k));
            splats.sh.extend(colour.map(|c| (c - 0.5) / 0.282_094_79));
        }
    }
    splats
}

pub fn camera() -> Camera {
    Camera { width: W, height: H, fx: 70.0, fy: 70.0, cx: 36.0, cy: 27.0 }
}

/// `views` cameras before the wall, the last one held out; every third splat of the truth is a point.
pub fn scene(views: usize) -> Scene {
    let truth = truth();
    let view = |i: usize| {
        let t = if views == 1 { 0.0 } else { i as f32 / (views - 1) as f32 * 2.0 - 1.0 };
        // The one held out stands between two others.
        let t = if views > 2 && i == views - 1 { 0.3 } else { t };
        let eye = Vec3::new(0.8 * t, 0.1 * (5.0 * t).cos(), -1.4 - 0.2 * t);
        View {
            name: format!("{i:02}.jpg"),
            camera: camera(),
            pose: Pose::look_at(eye, Vec3::new(0.1 * t, 0.1, 0.0), Vec3::NEG_Y),
            photo: Photo::new("none"),
            test: views > 2 && i == views - 1,
        }
    };
    let points = (0..truth.len())
        .step_by(3)
        .map(|i| Point {
            position: truth.mean(i) + 0.01 * Vec3::new(noise(i, 3), noise(i, 4), noise(i, 5)),
            colour: [0, 1, 2].map(|k| truth.sh[3 * i + k] * 0.282_094_79 + 0.5),
            track: vec![],
        })
        .collect();
    Scene::new((0..views).map(view).collect(), points)
}

pub const SKY: [f32; 3] = [0.5, 0.7, 0.95];

/// The render of the truth before a sky, and the mask of the sky.
pub fn photo_of(view: &View) -> (Image, Mask) {
    photo_lit(view, |_| 1.0)
}

/// The photo of a view under a light that depends on each splat's position.
pub fn photo_lit(view: &View, light: impl Fn([f32; 3]) -> f32) -> (Image, Mask) {
    let (splats, engine) = (truth(), CpuEngine::new());
    let projected = engine.project(&splats, &view.camera, &view.pose, &ProjectOptions::default()).unwrap();
    let mut colours = projected.shade();
    for (colour, at) in colours.chunks_exact_mut(3).zip(&splats.means) {
        colour.iter_mut().for_each(|v| *v *= light(*at));
    }
    let frame = projected.blend(&Channels { count: 3, values: &colours }).unwrap();
    let mut image = frame.image;
    let n = image.pixels();
    for c in 0..3 {
        for i in 0..n {
            image.data[c * n + i] += (1.0 - frame.alpha.data[i]) * SKY[c];
        }
    }
    let sky = Mask::from_fn(W, H, |x, y| frame.alpha.at(0, x as usize, y as usize) < 0.5);
    (image, sky)
}

/// All photos of a scene, each put through `change`.
pub fn photos(scene: &Scene, sky: bool, change: impl Fn(usize, &mut Image)) -> Arc<dyn Photos> {
    let all: Vec<TrainPhoto> = scene
        .views
        .iter()
        .enumerate()
        .map(|(i, view)| {
            let (mut image, mask) = photo_of(view);
            change(i, &mut image);
            TrainPhoto { image, valid: None, sky: sky.then_some(mask), transients: None }
        })
        .collect();
    Arc::new(move |i: usize| Ok::<_, Infallible>(all[i].clone()))
}

pub fn settings(steps: u32) -> TrainSettings {
    TrainSettings {
        steps,
        splats: 1500,
        sh_degree: 1,
        appearance_model: AppearanceModel::None,
        robust: false,
        ..TrainSettings::default()
    }
}

pub fn train(scene: &Scene, photos: Arc<dyn Photos>, settings: TrainSettings) -> Model {
    Trainer::new(engine(), scene, photos, settings).unwrap().finish().unwrap()
}

pub fn assert_sane(model: &Model, cap: usize) {
    let s = &model.splats;
    assert!(!s.is_empty() && s.len() <= cap, "{} splats", s.len());
    assert!(s.means.iter().flatten().chain(s.log_scales.iter().flatten()).all(|v| v.is_finite()));
    assert!(s.opacities.iter().chain(&s.sh).all(|v| v.is_finite()));
}

pub fn bytes(checkpoint: &Checkpoint) -> Vec<u8> {
    wincode::serialize(checkpoint).unwrap()
}
