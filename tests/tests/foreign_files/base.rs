//! The good scene that every row starts from.

use segwild_scene::Image;
use segwild_scene::colmap::{
    self, CameraModel, CameraRecord, ImageRecord, Keypoint, PointRecord, Reconstruction,
};
use std::path::{Path, PathBuf};

/// Size of the photos in pixels.
pub const SIZE: (usize, usize) = (48, 36);
/// Number of photos.
pub const PHOTOS: u32 = 12;

/// A scene folder and what it was made from.
pub struct Files {
    /// The folder that is opened; a row may write another one inside of it.
    pub scene: PathBuf,
    /// The reconstruction in `sparse/0`.
    pub model: Reconstruction,
}

impl Files {
    /// Writes the good scene into `dir/scene`.
    pub fn new(dir: &Path) -> Files {
        let files = Files { scene: dir.join("scene"), model: reconstruction() };
        colmap::write(&files.scene.join("sparse/0"), &files.model).expect("the model is written");
        for image in &files.model.images {
            files.photo(&image.name);
        }
        files
    }

    /// A path inside the scene; its folder is made.
    pub fn path(&self, name: &str) -> PathBuf {
        let path = self.scene.join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder is made");
        path
    }

    /// Writes bytes to a file of the scene.
    pub fn write(&self, name: &str, bytes: impl AsRef<[u8]>) {
        std::fs::write(self.path(name), bytes).expect("a file is written");
    }

    /// Removes a file or folder of the scene.
    pub fn remove(&self, name: &str) {
        let path = self.scene.join(name);
        let gone = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        gone.expect("it is there");
    }

    /// Moves a file or folder within the scene.
    pub fn rename(&self, from: &str, to: &str) {
        std::fs::rename(self.scene.join(from), self.path(to)).expect("it is there");
    }

    /// Writes a good photo as PNG to `images/NAME`.
    pub fn photo(&self, name: &str) {
        test_image().write_png(&self.path(&format!("images/{name}"))).expect("a photo is written");
    }

    /// Writes the model again with a change, as `.bin`.
    pub fn remodel(&self, change: impl FnOnce(&mut Reconstruction)) {
        let mut model = self.model.clone();
        change(&mut model);
        colmap::write(&self.scene.join("sparse/0"), &model).expect("the model is written");
    }
}

/// A smooth image that differs at every pixel.
pub fn test_image() -> Image {
    let (width, height) = SIZE;
    let mut image = Image::zeros(width, height, 3);
    let n = width * height;
    for i in 0..n {
        let (u, v) = ((i % width) as f32 / width as f32, (i / width) as f32 / height as f32);
        image.data[i] = u;
        image.data[n + i] = v;
        image.data[2 * n + i] = 0.5 + 0.4 * (9.0 * u + 5.0 * v).sin();
    }
    image
}

/// Cameras on a line, facing along z a wall of points.
fn reconstruction() -> Reconstruction {
    let (width, height) = (SIZE.0 as f64, SIZE.1 as f64);
    let (focal, cx, cy) = (50.0, width / 2.0, height / 2.0);
    let camera = CameraRecord {
        id: 1,
        model: CameraModel::Pinhole,
        width: width as u64,
        height: height as u64,
        params: vec![focal, focal, cx, cy],
    };
    let x = |i: u32| f64::from(i) / f64::from(PHOTOS - 1);
    let wall: Vec<[f64; 3]> = (0..60)
        .map(|k| {
            [0.1 + 0.08 * f64::from(k % 10), -0.5 + 0.18 * f64::from(k / 10), 5.0 + 0.1 * f64::from(k % 7)]
        })
        .collect();
    let keypoints = |i: u32| {
        wall.iter()
            .enumerate()
            .map(|(k, p)| Keypoint {
                pixel: [focal * (p[0] - x(i)) / p[2] + cx, focal * p[1] / p[2] + cy],
                point: Some(k as u64 + 1),
            })
            .collect()
    };
    let images = (0..PHOTOS)
        .map(|i| ImageRecord {
            id: i + 1,
            rotation: [1.0, 0.0, 0.0, 0.0],
            translation: [-x(i), 0.0, 0.0],
            camera_id: 1,
            name: format!("photo{i:02}.png"),
            keypoints: keypoints(i),
        })
        .collect();
    let points = wall
        .iter()
        .enumerate()
        .map(|(k, p)| PointRecord {
            id: k as u64 + 1,
            position: *p,
            colour: [90 + k as u8, 120, 150],
            error: 0.5,
            track: (0..PHOTOS).map(|i| (i + 1, k as u32)).collect(),
        })
        .collect();
    Reconstruction { cameras: vec![camera], unknown_cameras: vec![], images, points }
}
