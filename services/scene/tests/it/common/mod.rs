//! What the tests of this crate share.

use segwild_scene::colmap::{CameraModel, CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction};
use segwild_scene::{Image, Scene, SceneError, SceneSettings};
use std::path::{Path, PathBuf};

/// A folder of the shared data, or `None` with a line on stderr where it is missing.
pub fn shared(test: &str, part: &str) -> Option<PathBuf> {
    let root = std::env::var_os("SEGWILD_SHARED")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared"), PathBuf::from);
    let path = root.join("data").join(part);
    if path.exists() {
        return Some(path);
    }
    eprintln!("skipped: {test}: {} is missing", path.display());
    None
}

pub fn open(path: &Path) -> Result<Scene, SceneError> {
    Scene::open(path, &SceneSettings::default())
}

/// A smooth image that differs at every pixel.
pub fn test_image(width: usize, height: usize) -> Image {
    let mut image = Image::zeros(width, height, 3);
    for y in 0..height {
        for x in 0..width {
            let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
            let i = y * width + x;
            let n = width * height;
            image.data[i] = u;
            image.data[n + i] = v;
            image.data[2 * n + i] = 0.5 + 0.4 * (9.0 * u + 5.0 * v).sin();
        }
    }
    image
}

pub const SIZE: (usize, usize) = (40, 30);

/// `n` cameras on a line that look at four points, one PINHOLE camera.
pub fn line(n: u32) -> Reconstruction {
    let camera = CameraRecord {
        id: 7,
        model: CameraModel::Pinhole,
        width: SIZE.0 as u64,
        height: SIZE.1 as u64,
        params: vec![50.0, 50.0, 20.0, 15.0],
    };
    let positions: [[f64; 3]; 4] = [[0.0, 0.0, 5.0], [0.5, 0.2, 6.0], [-0.4, 0.3, 5.5], [0.1, -0.5, 4.5]];
    let shift = |i: u32| f64::from(i) / f64::from(n.max(5) - 1);
    let images = (0..n).map(|i| ImageRecord {
        id: 100 + i,
        rotation: [1.0, 0.0, 0.0, 0.0],
        translation: [-shift(i), 0.0, 0.0],
        camera_id: 7,
        name: format!("photo{i:02}.png"),
        keypoints: positions
            .iter()
            .enumerate()
            .map(|(k, p)| Keypoint {
                pixel: [50.0 * (p[0] - shift(i)) / p[2] + 20.0, 50.0 * p[1] / p[2] + 15.0],
                point: Some(k as u64 + 1),
            })
            .collect(),
    });
    let images: Vec<_> = images.collect();
    let points = positions.iter().enumerate().map(|(k, p)| PointRecord {
        id: k as u64 + 1,
        position: *p,
        colour: [10, 20, 30],
        error: 0.5,
        track: (0..n).map(|i| (100 + i, k as u32)).collect(),
    });
    Reconstruction { cameras: vec![camera], unknown_cameras: vec![], points: points.collect(), images }
}

/// Writes a scene folder: `sparse/0` and a photo for every image.
pub fn write(dir: &Path, reconstruction: &Reconstruction) {
    segwild_scene::colmap::write(&dir.join("sparse/0"), reconstruction).unwrap();
    for image in &reconstruction.images {
        write_photo(dir, &image.name);
    }
}

pub fn write_photo(dir: &Path, name: &str) {
    let path = dir.join("images").join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    test_image(SIZE.0, SIZE.1).write_png(&path).unwrap();
}
