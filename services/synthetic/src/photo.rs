//! One photo of a set, with its truth per pixel.

use crate::light::PhotoLight;
use glam::DVec3;
use segwild_scene::{Camera, Image, Mask, Pose};

/// One photo and all that is true of it.
#[derive(Clone, Debug)]
pub struct SyntheticPhoto {
    /// File name.
    pub name: String,
    /// Intrinsics.
    pub camera: Camera,
    /// World to camera, in file units.
    pub pose: Pose,
    /// The translation of `pose` before it was rounded: what is written, so that units change nothing else.
    pub translation: DVec3,
    /// Whether it is held out.
    pub test: bool,
    /// Whether it was taken from the front: such photos never show the occluded wall.
    pub front: bool,
    /// What a visitor's camera recorded, three planes, exactly as an 8-bit file keeps it.
    pub photo: Image,
    /// The view under the canonical light with nobody in it.
    pub clean: Image,
    /// Distance along the optical axis at each pixel's centre, in file units; 0 where the sky is.
    pub depth: Vec<f32>,
    /// Instance at each pixel's centre, transients aside; 0 is the sky.
    pub instances: Vec<u16>,
    /// Part at each pixel's centre, transients aside; 0 is the sky.
    pub parts: Vec<u16>,
    /// Pixels that a transient touches.
    pub transients: Mask,
    /// Light and camera.
    pub photo_light: PhotoLight,
}

/// What a reconstruction keeps of a photo: no pixels.
#[derive(Clone, Debug)]
pub struct PhotoRecord {
    /// File name.
    pub name: String,
    /// Intrinsics.
    pub camera: Camera,
    /// World to camera, in file units.
    pub pose: Pose,
    /// The translation of `pose` before it was rounded.
    pub translation: DVec3,
    /// Whether it is held out.
    pub test: bool,
}

impl SyntheticPhoto {
    /// What a reconstruction keeps of it.
    pub(crate) fn record(&self) -> PhotoRecord {
        let SyntheticPhoto { ref name, camera, pose, translation, test, .. } = *self;
        PhotoRecord { name: name.clone(), camera, pose, translation, test }
    }

    /// The pixels of an instance, transients aside; id 0 gives the sky.
    pub fn mask(&self, instance: u16) -> Mask {
        select(&self.camera, &self.instances, instance)
    }

    /// The pixels of a part, transients aside.
    pub fn part_mask(&self, part: u16) -> Mask {
        select(&self.camera, &self.parts, part)
    }

    /// The sky's pixels, transients aside.
    pub fn sky(&self) -> Mask {
        self.mask(0)
    }

    /// The pixel position deepest inside what is seen of an instance, at least 2 px from its outline and from
    /// transients; `None` when there is no such pixel.
    pub fn click(&self, instance: u16) -> Option<[f32; 2]> {
        let seen = self.mask(instance).minus(&self.transients);
        if seen.is_empty() {
            return None;
        }
        let (w, h) = (self.camera.width, self.camera.height);
        let depth = seen.not().distances();
        let clear = |x: u32, y: u32| {
            let border = (x + 1).min(y + 1).min(w - x).min(h - y) as f32;
            depth[(y * w + x) as usize].min(border)
        };
        let mut best = (2.0, None);
        for (x, y) in seen.pixels() {
            let margin = clear(x, y);
            if margin > best.0 {
                best = (margin, Some([x as f32 + 0.5, y as f32 + 0.5]));
            }
        }
        best.1
    }
}

fn select(camera: &Camera, ids: &[u16], id: u16) -> Mask {
    Mask::from_fn(camera.width, camera.height, |x, y| ids[(y * camera.width + x) as usize] == id)
}
