//! Planes before a photo, and how alike two photos are on them.

use crate::frame::{Grey, REACH};
use glam::{Mat3, Vec3, Vec4};
use segwild_scene::{Camera, Pose};

/// Samples of a patch, to the right and down of its middle, four at a time: every other pixel of 5 x 5 but the middle.
const OFFSETS: [(Vec4, Vec4); 3] = [
    (Vec4::new(-2.0, 0.0, 2.0, -1.0), Vec4::new(-2.0, -2.0, -2.0, -1.0)),
    (Vec4::new(1.0, -2.0, 2.0, -1.0), Vec4::new(-1.0, 0.0, 0.0, 1.0)),
    (Vec4::new(1.0, -2.0, 0.0, 2.0), Vec4::new(1.0, 2.0, 2.0, 2.0)),
];
/// How many these are.
const COUNT: f32 = 12.0;
/// Longest side of an image, in pixels: the number of its last pixel is exact in an `f32`.
pub const LONGEST_SIDE: usize = 4096;
/// How far a patch may reach in another photo, in pixels.
const FARTHEST: f32 = 16.0;
/// Least deviation of a patch: below it there is nothing to compare.
const LEAST_CONTRAST: f32 = 0.002;

/// A plane by its inverse depth, which is linear over the image: its value at a pixel, and its slopes to the right and down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct DepthPlane {
    pub near: f32,
    pub slope: [f32; 2],
}

impl DepthPlane {
    /// The same plane seen from the pixel that lies `dx`, `dy` further on.
    pub fn at(&self, dx: f32, dy: f32) -> DepthPlane {
        DepthPlane { near: self.near + self.slope[0] * dx + self.slope[1] * dy, ..*self }
    }
}

/// The largest whole number below, of numbers over 0 and under 2^22: by rounding, for which there is an instruction on
/// every machine. A whole number may be itself or one less, between whose pixels it is all the same.
fn whole(x: Vec4) -> Vec4 {
    const ROUND: f32 = (3 << 22) as f32;
    (x - 0.5 + ROUND) - ROUND
}

/// A patch of the photo whose depth is sought: its samples without their mean, of length 1.
pub(crate) struct Patch([Vec4; 3]);

impl Patch {
    /// `None` where it has no contrast.
    pub fn new(grey: &Grey, x: usize, y: usize) -> Option<Patch> {
        let at = |dx: f32, dy: f32| {
            grey.values[(y as i32 + dy as i32) as usize * grey.width + (x as i32 + dx as i32) as usize]
        };
        let mut values = OFFSETS.map(|(dx, dy)| {
            let (dx, dy) = (dx.to_array(), dy.to_array());
            Vec4::from_array(std::array::from_fn(|k| at(dx[k], dy[k])))
        });
        let total = |of: &dyn Fn(Vec4) -> Vec4, values: &[Vec4; 3]| {
            values.iter().map(|v| of(*v)).sum::<Vec4>().element_sum()
        };
        let mean = total(&|v| v, &values) / COUNT;
        values.iter_mut().for_each(|v| *v -= mean);
        let length = total(&|v| v * v, &values).sqrt();
        if length < LEAST_CONTRAST * COUNT.sqrt() {
            return None;
        }
        Some(Patch(values.map(|v| v / length)))
    }
}

/// Another photo: `homogeneous pixel = turn * (x, y, 1) + near * shift`.
pub(crate) struct SourceView<'a> {
    grey: &'a Grey,
    turn: Mat3,
    shift: Vec3,
}

impl<'a> SourceView<'a> {
    pub fn new((of, from): (&Grey, &Pose), (grey, to): (&'a Grey, &Pose)) -> SourceView<'a> {
        let matrix = |c: &Camera| {
            Mat3::from_cols(Vec3::new(c.fx, 0.0, 0.0), Vec3::new(0.0, c.fy, 0.0), Vec3::new(c.cx, c.cy, 1.0))
        };
        let rotation = to.rotation * from.rotation.transpose();
        let translation = to.translation - rotation * from.translation;
        let k = matrix(&grey.camera);
        SourceView { grey, turn: k * rotation * matrix(&of.camera).inverse(), shift: k * translation }
    }

    /// Projects a pixel of inverse depth `near` here: its position, and its inverse depth here; `None` behind the camera.
    pub fn project(&self, x: f32, y: f32, near: f32) -> Option<(f32, f32, f32)> {
        let q = self.turn * Vec3::new(x, y, 1.0) + near * self.shift;
        (q.z > 1e-6 && near > 0.0).then(|| (q.x / q.z, q.y / q.z, near / q.z))
    }

    /// Normalised cross-correlation, in [-1, 1], of the patch around the pixel with this photo's pixels on the plane;
    /// `None` where the plane lies outside this photo.
    pub fn alike(&self, patch: &Patch, x: usize, y: usize, plane: DepthPlane) -> Option<f32> {
        let (w, h) = (self.grey.width, self.grey.height);
        let at = Vec3::new(x as f32 + 0.5, y as f32 + 0.5, 1.0);
        let middle = self.turn * at + plane.near * self.shift;
        let right = self.turn.col(0) + plane.slope[0] * self.shift;
        let down = self.turn.col(1) + plane.slope[1] * self.shift;
        if middle.z <= 1e-6 {
            return None;
        }
        // A patch is small: what its pixels are divided by hardly changes over it, and is taken for linear.
        let over = 1.0 / middle.z;
        let (u, v) = (middle.x * over, middle.y * over);
        let along = |g: Vec3| ((g.x - u * g.z) * over, (g.y - v * g.z) * over);
        let ((ur, vr), (ud, vd)) = (along(right), along(down));
        let (u, v) = (u - 0.5, v - 0.5);
        let reach = REACH as f32;
        let (du, dv) = (reach * (ur.abs() + ud.abs()), reach * (vr.abs() + vd.abs()));
        // A little within the frame, for rounding.
        let last = |n: usize| n as f32 - 1.01;
        let inside = u - du >= 0.01 && v - dv >= 0.01 && u + du < last(w) && v + dv < last(h);
        // A patch stretched so far is seen from very near, or along its surface.
        if !inside || du + dv > FARTHEST {
            return None;
        }
        let (mut sum, mut squares, mut product) = (Vec4::ZERO, Vec4::ZERO, Vec4::ZERO);
        let width = w as f32;
        for ((dx, dy), p) in OFFSETS.iter().zip(&patch.0) {
            let x = u + ur * *dx + ud * *dy;
            let y = v + vr * *dx + vd * *dy;
            let (left, top) = (whole(x), whole(y));
            // Whole numbers under 2^24: exact (see `LONGEST_SIDE`).
            let at = (top * width + left).to_array().map(|i| {
                let i = i as i32 as usize;
                let pixels = &self.grey.values[i..i + w + 2];
                [pixels[0], pixels[1], pixels[w], pixels[w + 1]]
            });
            let corner = |k: usize| Vec4::new(at[0][k], at[1][k], at[2][k], at[3][k]);
            let (across, down) = (x - left, y - top);
            let upper = corner(0) + (corner(1) - corner(0)) * across;
            let lower = corner(2) + (corner(3) - corner(2)) * across;
            let value = upper + (lower - upper) * down;
            sum += value;
            squares += value * value;
            product += *p * value;
        }
        let (sum, squares, product) = (sum.element_sum(), squares.element_sum(), product.element_sum());
        let deviation = squares - sum * sum / COUNT;
        if deviation < COUNT * LEAST_CONTRAST * LEAST_CONTRAST {
            return Some(-1.0);
        }
        Some(product / deviation.sqrt())
    }
}
