//! A photo as the input of the UNet: small, with its camera.

use super::nets::{BESIDE, PLANES};
use segwild_nn::Map;
use segwild_scene::{Camera, NEAR, Pose};
use wincode::{SchemaRead, SchemaWrite};

/// The sides of the UNet's input are multiples of this.
const GRAIN: usize = 32;

/// A photo at the size of the UNet, a byte per number, and its camera and pose. Appearance is computed from it, so it
/// is stored with the model.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub struct ImageConditioning {
    width: u32,
    height: u32,
    /// Three planes.
    rgb: Vec<u8>,
    /// How far each pixel is known.
    known: Vec<u8>,
    camera: Camera,
    /// World to camera: rotation, row by row, each followed by its translation.
    pose: [[f32; 4]; 3],
}

impl ImageConditioning {
    /// The photo of `camera` and `pose`, at most `side` long. `colour` gives the colour of each pixel of a photo of
    /// `width` x `height`, or `None` where it is unknown.
    pub(super) fn new(
        side: usize,
        (width, height): (usize, usize),
        camera: &Camera,
        pose: &Pose,
        colour: impl Fn(usize) -> Option<[f32; 3]>,
    ) -> ImageConditioning {
        let scale = (side as f32 / width.max(height) as f32).min(1.0);
        // The nearest sizes that can be halved five times: a little wider or narrower does not matter.
        let fit = |n: usize| ((n as f32 * scale / GRAIN as f32).round() as usize).max(1) * GRAIN;
        let (w, h) = (fit(width), fit(height));
        let (mut rgb, mut known) = (vec![0; 3 * w * h], vec![0; w * h]);
        for y in 0..h {
            for x in 0..w {
                // The mean of the photo's pixels under this one, at least one.
                let under =
                    |k: usize, of: usize, n: usize| k * n / of..((k + 1) * n / of).max(k * n / of + 1);
                let (mut sum, mut count, mut all) = ([0.0f32; 3], 0.0f32, 0.0f32);
                for v in under(y, h, height) {
                    for u in under(x, w, width) {
                        all += 1.0;
                        if let Some(colour) = colour(v * width + u) {
                            count += 1.0;
                            (0..3).for_each(|c| sum[c] += colour[c]);
                        }
                    }
                }
                if count > 0.0 {
                    known[y * w + x] = (255.0 * count / all + 0.5) as u8;
                    for c in 0..3 {
                        rgb[c * w * h + y * w + x] = ((sum[c] / count).clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
                    }
                }
            }
        }
        let r = pose.rotation.transpose();
        let rows = [r.x_axis, r.y_axis, r.z_axis];
        let pose = std::array::from_fn(|i| [rows[i].x, rows[i].y, rows[i].z, pose.translation[i]]);
        ImageConditioning { width: w as u32, height: h as u32, rgb, known, camera: *camera, pose }
    }

    /// Whether its parts fit each other.
    pub(super) fn is_whole(&self) -> bool {
        let (w, h) = (self.width as usize, self.height as usize);
        let sides = [w, h].iter().all(|n| (GRAIN..=64 * GRAIN).contains(n) && n.is_multiple_of(GRAIN));
        sides && self.rgb.len() == 3 * w * h && self.known.len() == w * h
    }

    /// The input planes of the UNet, and those that bypass it; pixels in the columns outside `seen` are masked as
    /// unknown.
    pub(super) fn planes(&self, seen: std::ops::Range<f32>) -> (Map, Map) {
        let (w, h) = (self.width as usize, self.height as usize);
        let mut image = Map::zeros(PLANES, h, w);
        let mut sums = [[0.0f64; 2]; 3];
        let mut total = 0.0f64;
        let n = w * h;
        for i in 0..n {
            let at = (i % w) as f32 / w as f32;
            let known = if seen.contains(&at) { f32::from(self.known[i]) / 255.0 } else { 0.0 };
            image.data[3 * n + i] = known;
            total += f64::from(known);
            for c in 0..3 {
                let v = f32::from(self.rgb[c * n + i]) / 255.0;
                image.data[c * n + i] = known * 2.0 * (v - 0.5);
                sums[c][0] += f64::from(known * v);
                sums[c][1] += f64::from(known * v * v);
            }
        }
        let total = total.max(1e-3);
        let mut beside = Map::zeros(BESIDE, h / 2, w / 2);
        let m = beside.pixels();
        for c in 0..PLANES {
            for y in 0..h / 2 {
                for x in 0..w / 2 {
                    let at = c * n + 2 * y * w + 2 * x;
                    let four =
                        image.data[at] + image.data[at + 1] + image.data[at + w] + image.data[at + w + 1];
                    beside.data[c * m + y * w / 2 + x] = 0.25 * four;
                }
            }
        }
        for c in 0..3 {
            let mean = sums[c][0] / total;
            let deviation = (sums[c][1] / total - mean * mean).max(0.0).sqrt();
            beside.data[(PLANES + c) * m..][..m].fill(2.0 * (mean as f32 - 0.5));
            beside.data[(PLANES + 3 + c) * m..][..m].fill(4.0 * deviation as f32);
        }
        (image, beside)
    }

    /// Its camera and pose: world to camera, rotation row by row, each followed by its translation.
    pub fn stand(&self) -> (&Camera, &[[f32; 4]; 3]) {
        (&self.camera, &self.pose)
    }

    /// Projects a point into the photo, as shares of width and height; `None` behind the camera or outside the frame.
    pub(super) fn pixel_of(&self, [x, y, z]: [f32; 3]) -> Option<[f32; 2]> {
        let p = self.pose.map(|r| r[0] * x + r[1] * y + r[2] * z + r[3]);
        let camera = &self.camera;
        if p[2] <= NEAR || !p[2].is_finite() {
            return None;
        }
        let u = (camera.fx * p[0] / p[2] + camera.cx) / camera.width as f32;
        let v = (camera.fy * p[1] / p[2] + camera.cy) / camera.height as f32;
        ((0.0..1.0).contains(&u) && (0.0..1.0).contains(&v)).then_some([u, v])
    }
}
