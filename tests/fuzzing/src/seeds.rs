//! Good inputs: a scene of three photos in every form that is read, and what a small run of it left.

use crate::yard::{copy, folder, put, take};
use image::{DynamicImage, ImageFormat, Rgb, RgbImage};
use segwild_pipeline::{RunFolder, RunOptions, Settings};
use segwild_scene::colmap::{
    self, CameraModel, CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction,
};
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Size of the photos in pixels.
pub const SIZE: (u32, u32) = (32, 24);
const PHOTOS: u32 = 3;

/// A smooth photo.
pub fn photo(shift: u32) -> DynamicImage {
    let level = |x: u32| (128.0 + 100.0 * (f64::from(x) / 7.0).sin()) as u8;
    let pixel = |x: u32, y: u32| Rgb([level(x + shift), level(y * 2 + x), level(x * y / 9 + shift)]);
    RgbImage::from_fn(SIZE.0, SIZE.1, pixel).into()
}

/// The photo as a file.
///
/// # Panics
/// Where the format is not one that is written.
pub fn encoded(photo: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    photo.write_to(&mut bytes, format).unwrap_or_else(|e| panic!("{format:?}: {e}"));
    bytes.into_inner()
}

fn reconstruction(model: CameraModel, params: &[f64]) -> Reconstruction {
    let (width, height) = (u64::from(SIZE.0), u64::from(SIZE.1));
    let camera = CameraRecord { id: 1, model, width, height, params: params.to_vec() };
    let wall: Vec<[f64; 3]> = (0..48)
        .map(|k| {
            [-1.0 + 0.3 * f64::from(k % 8), -0.6 + 0.25 * f64::from(k / 8), 4.0 + 0.1 * f64::from(k % 5)]
        })
        .collect();
    let centre = |i: u32| f64::from(i) * 0.4 - 0.4;
    let pixel = |i: u32, p: &[f64; 3]| [30.0 * (p[0] - centre(i)) / p[2] + 16.0, 30.0 * p[1] / p[2] + 12.0];
    let seen = |i: u32| -> Vec<Keypoint> {
        let keypoint =
            |(k, p): (usize, &[f64; 3])| Keypoint { pixel: pixel(i, p), point: Some(k as u64 + 1) };
        wall.iter().enumerate().map(keypoint).collect()
    };
    let images = (0..PHOTOS).map(|i| ImageRecord {
        id: i + 1,
        rotation: [1.0, 0.0, 0.0, 0.0],
        translation: [-centre(i), 0.0, 0.0],
        camera_id: 1,
        name: format!("photo{i}.png"),
        keypoints: seen(i),
    });
    let points = wall.iter().enumerate().map(|(k, p)| PointRecord {
        id: k as u64 + 1,
        position: *p,
        colour: [90, 120, 150],
        error: 0.5,
        track: (0..PHOTOS).map(|i| (i + 1, k as u32)).collect(),
    });
    Reconstruction {
        cameras: vec![camera],
        unknown_cameras: vec![],
        images: images.collect(),
        points: points.collect(),
    }
}

/// The scene as COLMAP's files, under two lens models, in a folder of this name: `0` and `1`, each with `.bin` and `.txt`.
pub(crate) fn models() -> &'static Path {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    MADE.get_or_init(|| {
        let root = folder("models");
        let pinhole = reconstruction(CameraModel::Pinhole, &[30.0, 30.0, 16.0, 12.0]);
        let bent = reconstruction(CameraModel::OpenCv, &[30.0, 30.0, 16.0, 12.0, 0.01, -0.01, 0.001, 0.001]);
        for (name, model) in [("0", pinhole), ("1", bent)] {
            let dir = root.join(name);
            colmap::write(&dir, &model).unwrap_or_else(|e| panic!("{e}"));
            colmap::write_text(&dir, &model).unwrap_or_else(|e| panic!("{e}"));
        }
        root
    })
}

/// A scene folder of its own for a target: photos, and no reconstruction yet.
pub(crate) fn photos_for(target: &str) -> PathBuf {
    let scene = folder(target);
    std::fs::create_dir_all(scene.join("images")).unwrap_or_else(|e| panic!("{e}"));
    for i in 0..PHOTOS {
        put(&scene.join(format!("images/photo{i}.png")), &encoded(&photo(i * 3), ImageFormat::Png));
    }
    scene
}

/// As [`photos_for`], with the reconstruction in `sparse/0` as files of an ending.
pub(crate) fn scene_for(target: &str, ending: &str) -> PathBuf {
    let scene = photos_for(target);
    let sparse = scene.join("sparse/0");
    std::fs::create_dir_all(&sparse).unwrap_or_else(|e| panic!("{e}"));
    for file in ["cameras", "images", "points3D"] {
        let name = format!("{file}.{ending}");
        put(&sparse.join(&name), &take(&models().join("0").join(&name)));
    }
    scene
}

/// nerfstudio's file of the same scene.
pub fn transforms(more: &str) -> Vec<u8> {
    let frame = |i: u32| {
        let x = f64::from(i) * 0.4 - 0.4;
        format!(
            "{{\"file_path\": \"images/photo{i}.png\", \"transform_matrix\": \
             [[1, 0, 0, {x}], [0, -1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]}}"
        )
    };
    let frames: Vec<String> = (0..PHOTOS).map(frame).collect();
    format!(
        "{{\"camera_model\": \"OPENCV\", \"fl_x\": 30.0, \"fl_y\": 30.0, \"cx\": 16.0, \"cy\": 12.0, \"w\": 32, \"h\": 24, \
         \"k1\": 0.01, \"k2\": 0.0, \"p1\": 0.0, \"p2\": 0.0, {more}\"frames\": [{}]}}",
        frames.join(", ")
    )
    .into_bytes()
}

/// The folder of a small run with a selection, made once.
pub(crate) fn run() -> &'static Path {
    static MADE: OnceLock<PathBuf> = OnceLock::new();
    MADE.get_or_init(|| {
        let (scene, run) = (scene_for("run-scene", "bin"), folder("run"));
        let given = [
            ("preset", "draft"),
            ("size", "32"),
            ("steps", "12"),
            ("splats", "60"),
            ("refine_steps", "2"),
            ("prompt_budget", "4"),
            ("threads", "1"),
            ("checkpoint_every", "1"),
        ];
        let given = given.map(|(name, value)| (name.to_owned(), value.to_owned()));
        let settings = Settings::layered(None, &given).unwrap_or_else(|e| panic!("{e}"));
        let folder = RunFolder::create(&run).unwrap_or_else(|e| panic!("{e}"));
        let done = segwild_pipeline::run(&scene, &folder, &settings, &RunOptions::default());
        done.unwrap_or_else(|e| panic!("the run that makes inputs fails: {e}"));
        run
    })
}

/// A copy of the run for a target that changes files in it.
pub(crate) fn run_for(target: &str) -> PathBuf {
    let own = folder(target);
    copy(run(), &own);
    own
}
