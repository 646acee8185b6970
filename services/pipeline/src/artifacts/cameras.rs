//! `cameras.json`: the cameras of a run's photos in the space of its `scene.ply`, for programs that read a run folder.
//!
//! The scene's own files are not in the run folder, and each kind of scene has another format for cameras, lenses and
//! orientations. Here they are as the run uses them: pinholes, after undistortion.

use crate::artifacts::images::ImageFiles;
use crate::{RunError, RunFolder};
use segwild_scene::{Scene, SceneFrame, View};
use serde::Serialize;

/// The file in the run folder.
const FILE: &str = "cameras.json";

/// The cameras of a run.
#[derive(Serialize)]
struct RunCameras<'a> {
    /// Added to a position of `scene.ply`, it gives the position in the reconstruction.
    offset: [f64; 3],
    /// The photos, in the order of `scene.json`.
    photos: Vec<PhotoCamera<'a>>,
}

/// The camera of a photo.
#[derive(Serialize)]
struct PhotoCamera<'a> {
    /// Name of the photo.
    photo: &'a str,
    /// File of its images in `masks/`, `amodal/`, `prompted/`, `transients/` and `held_out/`.
    image: &'a str,
    /// Size of the photo in pixels.
    width: u32,
    height: u32,
    /// Intrinsics in pixels of the undistorted photo, at full size.
    fx: f32,
    fy: f32,
    cx: f32,
    cy: f32,
    /// Rows of the rotation from the world to the camera.
    rotation: [[f64; 3]; 3],
    /// `x_camera = rotation * x + translation`, where `x` is a position of `scene.ply`.
    translation: [f64; 3],
    /// Whether the photo as taken is distorted: masks have its pixels, and the intrinsics do not.
    distorted: bool,
}

impl<'a> PhotoCamera<'a> {
    fn new(view: &'a View, image: &'a str, frame: &SceneFrame) -> PhotoCamera<'a> {
        let rotation = view.pose.rotation.as_dmat3();
        // The pose is of the normalised frame: file = normalised * scale + origin.
        let translation =
            rotation * (frame.offset() - frame.origin) + frame.scale * view.pose.translation.as_dvec3();
        let c = view.camera;
        PhotoCamera {
            photo: &view.name,
            image,
            width: c.width,
            height: c.height,
            fx: c.fx,
            fy: c.fy,
            cx: c.cx,
            cy: c.cy,
            rotation: rotation.transpose().to_cols_array_2d(),
            translation: translation.to_array(),
            distorted: view.photo.lens.is_some(),
        }
    }
}

/// Writes the cameras of a scene into its run folder.
///
/// # Errors
/// When the file cannot be written.
pub(crate) fn write(folder: &RunFolder, scene: &Scene) -> Result<(), RunError> {
    let files = ImageFiles::of(scene.views.iter().map(|v| v.name.as_str()));
    let cameras = scene.views.iter().zip(files.names());
    let photos = cameras.map(|(view, image)| PhotoCamera::new(view, image, &scene.frame)).collect();
    folder.write_json(FILE, &RunCameras { offset: scene.frame.offset().to_array(), photos })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec3};
    use segwild_scene::{Camera, Photo, Pose};

    #[test]
    fn a_position_of_the_exported_splats_has_the_pixel_that_it_has_in_the_normalised_frame() {
        let photo = Photo::new("a.jpg");
        let camera = Camera { width: 100, height: 80, fx: 90.0, fy: 95.0, cx: 49.0, cy: 41.0 };
        let pose = Pose::look_at(Vec3::new(0.3, -0.2, -2.0), Vec3::ZERO, Vec3::NEG_Y);
        let view = View { name: "a.jpg".into(), camera, pose, photo, test: false };
        for (origin, scale) in [
            (DVec3::new(1.0, 2.0, 3.0), 4.0),
            // So far off that exports have an offset.
            (DVec3::new(448_262.3, 5_411_932.7, 35.0), 4.0),
        ] {
            let frame = SceneFrame { origin, scale };
            let written = PhotoCamera::new(&view, "a.png", &frame);
            let rotation = DMat3::from_cols_array_2d(&written.rotation).transpose();
            for normalised in [Vec3::new(0.1, 0.2, 0.3), Vec3::new(-0.4, 0.1, 0.9)] {
                let exported = normalised.as_dvec3() * scale + (origin - frame.offset());
                let at = rotation * exported + DVec3::from(written.translation);
                let wanted = pose.to_camera(normalised);
                assert!((at / scale - wanted.as_dvec3()).length() < 1e-5, "{at} {wanted}");
                let pixel = camera.pixel(wanted);
                let x = f64::from(written.fx) * at.x / at.z + f64::from(written.cx);
                let y = f64::from(written.fy) * at.y / at.z + f64::from(written.cy);
                assert!((x - f64::from(pixel.x)).hypot(y - f64::from(pixel.y)) < 1e-3);
            }
        }
    }
}
