//! Intrinsics and poses.

use glam::{Mat3, Vec2, Vec3};
use serde::{Deserialize, Serialize};
use wincode::{SchemaRead, SchemaWrite};

/// Pinhole intrinsics in pixels. Distorted photos are undistorted on load, so every camera is a pinhole.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SchemaRead, SchemaWrite)]
pub struct Camera {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x, in pixels.
    pub fx: f32,
    /// Focal length along y, in pixels.
    pub fy: f32,
    /// Principal point, x.
    pub cx: f32,
    /// Principal point, y.
    pub cy: f32,
}

impl Camera {
    /// The same camera for a photo resized to `width` x `height`.
    pub fn resized(&self, width: u32, height: u32) -> Camera {
        let (sx, sy) = (width as f32 / self.width as f32, height as f32 / self.height as f32);
        Camera { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// The size a photo of this camera has when its long side is at most `long_side` (never enlarged).
    pub fn size_for(&self, long_side: u32) -> (u32, u32) {
        let long = self.width.max(self.height);
        if long <= long_side {
            return (self.width, self.height);
        }
        let scale = f64::from(long_side) / f64::from(long);
        let side = |n: u32| ((f64::from(n) * scale).round() as u32).max(1);
        (side(self.width), side(self.height))
    }

    /// This camera scaled down so that its long side is at most `long_side`.
    pub fn scaled_to(&self, long_side: u32) -> Camera {
        let (w, h) = self.size_for(long_side);
        self.resized(w, h)
    }

    /// Pixel of a point in the camera frame. The caller has checked that `p.z` is in front.
    pub fn pixel(&self, p: Vec3) -> Vec2 {
        Vec2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy)
    }

    /// Direction in the camera frame (z = 1) of the ray through a pixel position.
    pub fn ray(&self, pixel: Vec2) -> Vec3 {
        Vec3::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy, 1.0)
    }

    /// Whether a pixel position lies inside the frame.
    pub fn contains(&self, pixel: Vec2) -> bool {
        pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < self.width as f32 && pixel.y < self.height as f32
    }
}

/// World to camera: `x_cam = rotation * x + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// World-to-camera rotation.
    pub rotation: Mat3,
    /// World-to-camera translation.
    pub translation: Vec3,
}

impl Pose {
    /// A world point in the camera frame.
    pub fn to_camera(&self, p: Vec3) -> Vec3 {
        self.rotation * p + self.translation
    }

    /// Camera centre in the world.
    pub fn centre(&self) -> Vec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// The pose of a camera at `eye` that looks at `target`; `up` is the world's up direction.
    pub fn look_at(eye: Vec3, target: Vec3, up: Vec3) -> Pose {
        let forward = (target - eye).normalize();
        let right = forward.cross(up).normalize();
        let down = forward.cross(right);
        let rotation = Mat3::from_cols(right, down, forward).transpose();
        Pose { rotation, translation: -(rotation * eye) }
    }
}
