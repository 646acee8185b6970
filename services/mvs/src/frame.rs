//! A view and its photo, as stereo needs them.

use glam::Vec2;
use segwild_scene::{Camera, Image, Mask, Pose, Scene};

/// Farthest sample of a patch from its middle, along an axis.
pub(crate) const REACH: usize = 2;

/// A photo at the size it is compared at.
pub struct StereoImage {
    /// sRGB in [0, 1], three planes.
    pub image: Image,
    /// Pixels that show the scene; `None`: all.
    pub usable: Option<Mask>,
}

/// A view that takes part.
pub(crate) struct StereoFrame {
    /// Its index in the scene.
    pub view: usize,
    pub pose: Pose,
    pub image: Image,
    /// At the size of the photo given.
    pub fine: Grey,
    /// At half the size.
    pub coarse: Grey,
    pub usable: Option<Mask>,
    /// Points of its track: pixel, and inverse depth there.
    pub sightings: Vec<(Vec2, f32)>,
}

/// Brightness of a photo at one size, and the camera of that size.
pub(crate) struct Grey {
    pub camera: Camera,
    pub width: usize,
    pub height: usize,
    pub values: Vec<f32>,
}

impl Grey {
    fn of(image: &Image, camera: Camera) -> Grey {
        let values = (0..image.pixels())
            .map(|i| (image.plane(0)[i] + image.plane(1)[i] + image.plane(2)[i]) * (1.0 / 3.0))
            .collect();
        Grey { camera, width: image.width, height: image.height, values }
    }

    /// Whether the patch around a pixel lies inside.
    pub fn holds(&self, x: usize, y: usize) -> bool {
        x >= REACH && y >= REACH && x + REACH < self.width && y + REACH < self.height
    }

    /// At half the size: an odd last row or column is left out.
    fn halved(&self) -> Grey {
        let (w, h) = (self.width / 2, self.height / 2);
        let mean = |x: usize, y: usize| {
            let at = 2 * y * self.width + 2 * x;
            let v = |i: usize| self.values[at + i];
            0.25 * (v(0) + v(1) + v(self.width) + v(self.width + 1))
        };
        let values = (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).map(|(x, y)| mean(x, y)).collect();
        let c = self.camera;
        let camera = Camera {
            width: w as u32,
            height: h as u32,
            fx: 0.5 * c.fx,
            fy: 0.5 * c.fy,
            cx: 0.5 * c.cx,
            cy: 0.5 * c.cy,
        };
        Grey { camera, width: w, height: h, values }
    }
}

impl StereoFrame {
    pub fn new(scene: &Scene, view: usize, input: StereoImage) -> StereoFrame {
        let StereoImage { image, usable } = input;
        let of = &scene.views[view];
        let camera = of.camera.resized(image.width as u32, image.height as u32);
        let scale = image.width as f32 / of.camera.width as f32;
        let fine = Grey::of(&image, camera);
        let coarse = fine.halved();
        let mut sightings = Vec::new();
        for point in &scene.points {
            let z = of.pose.to_camera(point.position).z;
            for seen in point.track.iter().filter(|o| o.view as usize == view) {
                if z > segwild_scene::NEAR && z.is_finite() {
                    sightings.push((Vec2::from(seen.pixel) * scale, 1.0 / z));
                }
            }
        }
        StereoFrame { view, pose: of.pose, image, fine, coarse, usable, sightings }
    }

    /// Whether a pixel shows the scene.
    pub fn shows(&self, (x, y): (usize, usize)) -> bool {
        self.usable.as_ref().is_none_or(|mask| mask.get(x as u32, y as u32))
    }
}
