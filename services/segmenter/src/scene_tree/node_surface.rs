//! Where the surface of each splat lies in the views that show it, and which way it faces (method, section 13).

use glam::{DVec3, Vec2, Vec3};
use segwild_scene::{Camera, Pose};

/// Pixels on each side over which the slope of a surface is measured. By choice, as for the bend of inverse depth.
const SLOPE_STEP: usize = 2;

/// Sides of the long side of a view by which surfaces are measured (method, section 13): a pixel of the size at which views are
/// compared, or of as much of a smaller view.
const SIDES: f32 = 320.0;

/// Sums over the pixels, of all views, whose front a splat is. Splat centres do not do: they lie under the surface, or before it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct FrontSums {
    /// A background splat may be the front of a million pixels: in f32 their mean would drift.
    point: DVec3,
    normal: Vec3,
    /// Sides, at the depth of the surface, in scene units.
    side: f32,
    pixels: f32,
}

impl FrontSums {
    /// Those of two splats together.
    pub fn and(self, other: FrontSums) -> FrontSums {
        FrontSums {
            point: self.point + other.point,
            normal: self.normal + other.normal,
            side: self.side + other.side,
            pixels: self.pixels + other.pixels,
        }
    }
}

/// The surface of a node of the graph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct NodeSurface {
    /// Its middle, in the scene's frame.
    pub point: Vec3,
    /// Its unit normal, towards the cameras; `None` where no view shows which way it faces.
    pub normal: Option<Vec3>,
    /// Mean side there, in scene units; over 0.
    pub side: f32,
}

impl NodeSurface {
    /// The mean of what the views show; `None` where none does.
    pub fn of(sums: &FrontSums) -> Option<NodeSurface> {
        let FrontSums { point, normal, side, pixels } = *sums;
        let surface = NodeSurface {
            point: (point / f64::from(pixels)).as_vec3(),
            normal: normal.try_normalize(),
            side: side / pixels,
        };
        (pixels > 0.0 && surface.side > 0.0 && surface.point.is_finite()).then_some(surface)
    }
}

/// The surfaces of one view: `depths`, row by row, 0 where a pixel shows no splat, and the `splats` that it shows.
pub(super) fn add_view(sums: &mut [FrontSums], splats: &[u32], depths: &[f32], camera: &Camera, pose: &Pose) {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let to_world = pose.rotation.transpose();
    let point = |x: usize, y: usize| {
        let depth = depths[y * width + x];
        (depth > 0.0).then(|| camera.ray(Vec2::new(x as f32 + 0.5, y as f32 + 0.5)) * depth)
    };
    let normal = |x: usize, y: usize, at: Vec3| {
        let s = SLOPE_STEP;
        if x < s || y < s || x + s >= width || y + s >= height {
            return None;
        }
        let across = point(x + s, y)? - point(x - s, y)?;
        let down = point(x, y + s)? - point(x, y - s)?;
        let normal = across.cross(down).try_normalize()?;
        Some(if normal.dot(at) > 0.0 { -normal } else { normal })
    };
    for y in 0..height {
        for x in 0..width {
            let Some(at) = point(x, y) else { continue };
            let sums = &mut sums[splats[y * width + x] as usize];
            sums.point += (to_world * (at - pose.translation)).as_dvec3();
            sums.normal += normal(x, y, at).map_or(Vec3::ZERO, |normal| to_world * normal);
            sums.side += at.z / camera.fx * width.max(height) as f32 / SIDES;
            sums.pixels += 1.0;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slanted_wall_has_its_points_and_its_normal() {
        // The plane z = 4 + x / 2 of the camera's frame, all of it the front of one splat.
        let camera = Camera { width: 12, height: 10, fx: 20.0, fy: 20.0, cx: 6.0, cy: 5.0 };
        let pose =
            Pose::look_at(Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 1.0, -2.0), Vec3::new(0.0, 0.0, 1.0));
        let ray = |i: usize| camera.ray(Vec2::new((i % 12) as f32 + 0.5, (i / 12) as f32 + 0.5));
        let depths: Vec<f32> = (0..120).map(|i| 4.0 / (1.0 - ray(i).x / 2.0)).collect();
        let mut sums = vec![FrontSums::default(); 2];
        add_view(&mut sums, &[1; 120], &depths, &camera, &pose);
        assert_eq!(NodeSurface::of(&sums[0]), None);
        let found = NodeSurface::of(&sums[1]).unwrap();
        let at = pose.to_camera(found.point);
        assert!((at.z - 4.0 - at.x / 2.0).abs() < 1e-4, "{at}");
        let facing = pose.rotation * found.normal.unwrap();
        assert!(facing.abs_diff_eq(Vec3::new(0.5, 0.0, -1.0).normalize(), 1e-4), "{facing}");
    }
}
