//! The frame that most kernels are compared on.

use glam::Vec3;
use segwild_raster::{Frame, ProjectOptions};
use segwild_scene::{Camera, Pose, Random, Splats};

/// Width and height of the frame.
pub(crate) const SIZE: (u32, u32) = (100, 68);
/// Splats: more than a bucket in a tile, and more than a block of the sort.
pub(crate) const SPLATS: usize = 1500;
/// Projection options.
pub(crate) const OPTIONS: ProjectOptions =
    ProjectOptions { low_pass: 0.3, antialias: true, near: segwild_scene::NEAR, jacobian_limits: None };

/// A ball of splats before a camera, some beyond its edges.
pub(crate) fn scene() -> (Splats, Camera, Pose) {
    let random = &mut Random::new(12);
    let mut within = |from: f32, to: f32| from + (to - from) * random.uniform();
    let mut splats = Splats { sh_degree: 0, ..Splats::default() };
    for _ in 0..SPLATS {
        splats.means.push([0; 3].map(|_| within(-0.7, 0.7)));
        splats.log_scales.push([0; 3].map(|_| within(-5.3, -2.5)));
        splats.rotations.push([0; 4].map(|_| within(-1.0, 1.0)));
        splats.opacities.push(within(-3.0, 4.0));
        splats.sh.extend([0.0; 3]);
    }
    let (width, height) = SIZE;
    let (w, h) = (width as f32, height as f32);
    let camera = Camera { width, height, fx: 1.1 * w, fy: 1.05 * w, cx: 0.47 * w, cy: 0.52 * h };
    (splats, camera, Pose::look_at(Vec3::new(0.3, -0.4, -1.6), Vec3::ZERO, Vec3::new(0.1, -1.0, 0.0)))
}

/// Colour and alpha, pixel by pixel, as the device holds them.
pub(crate) fn interleaved(frame: &Frame) -> Vec<f32> {
    let planes = [frame.image.plane(0), frame.image.plane(1), frame.image.plane(2), &frame.alpha.data];
    (0..frame.alpha.data.len()).flat_map(|i| planes.map(|plane| plane[i])).collect()
}
