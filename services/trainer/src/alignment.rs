//! Alignment of a photo's camera to the scene: the small motion that best explains how the photo differs from its
//! render (Lucas and Kanade 1981; method, section 3). The splats stay as they are.

use crate::TrainError;
use crate::camera_motion::{NormalEquations, TUKEY, Twist, flow, form, moved};
use crate::photos::PhotoLevel;
use glam::Vec2;
use segwild_raster::{Channels, Projected};
use segwild_scene::statistics::upper_median;
use segwild_scene::{Camera, Image, Pose};

/// Most steps at one size of the photo.
const STEPS: usize = 4;
/// A step that moves the render by fewer pixels than this (root mean square) is the last one.
const SETTLED: f64 = 0.02;
/// Accumulated alpha from which a pixel shows the scene, whose depth is then known.
const SOLID: f32 = 0.6;
/// Fewest pixels that say where a camera is.
const MIN_PIXELS: usize = 200;
/// Least standard deviation of the residuals, in sRGB: half of what eight bits round.
const MIN_DEVIATION: f64 = 0.5 / 255.0;
/// Standard deviations of normal noise for its median absolute value.
const DEVIATION_OF_MEDIAN: f64 = 1.4826;

/// What a camera shows: the render over its background in the photo's appearance, accumulated alpha, and the sum of
/// alpha T z.
pub(crate) struct RenderedDepth {
    pub shown: Image,
    pub alpha: Image,
    pub depth: Image,
}

impl RenderedDepth {
    /// Depth of a pixel along the camera's axis; `None` where too little of the scene is there.
    fn at(&self, i: usize) -> Option<f64> {
        let alpha = self.alpha.data[i];
        let depth = f64::from(self.depth.data[i] / alpha);
        (alpha > SOLID && depth.is_finite() && depth > 0.0).then_some(depth)
    }

    /// Root mean square of how far what its pixels show moves from one pose to another, in pixels; 0 where it shows
    /// nothing.
    pub fn motion(&self, camera: &Camera, from: &Pose, to: &Pose) -> f32 {
        let (w, back) = (self.alpha.width, from.rotation.transpose());
        let (mut sum, mut count) = (0.0f64, 0u32);
        for i in 0..self.alpha.pixels() {
            let Some(depth) = self.at(i) else { continue };
            let pixel = centre(i, w);
            let point = back * (camera.ray(pixel) * depth as f32 - from.translation);
            let there = to.to_camera(point);
            if there.z > 0.0 {
                sum += f64::from((camera.pixel(there) - pixel).length_squared());
                count += 1;
            }
        }
        (sum / f64::from(count.max(1))).sqrt() as f32
    }
}

fn centre(i: usize, width: usize) -> Vec2 {
    Vec2::new((i % width) as f32 + 0.5, (i / width) as f32 + 0.5)
}

/// How a render differs from its photo.
struct Difference {
    equations: NormalEquations,
    /// Mean of J^T J of the flow: what a twist moves the pixels by.
    flows: [Twist; 6],
    /// Mean of Tukey's loss.
    cost: f64,
    /// Robust standard deviation of the residuals.
    deviation: f64,
}

impl Difference {
    /// Among the pixels `within`. `deviation` is that of an earlier render, if there is one: costs are compared by the same
    /// loss. `None` where too few pixels show the scene.
    fn of(
        rendered: &RenderedDepth,
        photo: &PhotoLevel,
        camera: &Camera,
        deviation: Option<f64>,
        within: &dyn Fn(usize) -> bool,
    ) -> Option<Difference> {
        let (w, h, n) = (photo.width, photo.height, photo.pixels());
        let image = photo.image();
        let inner = |i: usize| (1..w - 1).contains(&(i % w)) && (1..h - 1).contains(&(i / w));
        let counted: Vec<(usize, f64)> = (0..n)
            .filter(|&i| inner(i) && photo.counts(i) && within(i))
            .filter_map(|i| Some((i, rendered.at(i)?)))
            .collect();
        if counted.len() < MIN_PIXELS {
            return None;
        }
        // What the render is to gain, channel by channel.
        let residual = |c: usize, i: usize| f64::from(rendered.shown.data[c * n + i] - image.data[c * n + i]);
        let deviation = deviation.unwrap_or_else(|| {
            let all = counted.iter().flat_map(|&(i, _)| [0, 1, 2].map(|c| residual(c, i).abs()));
            (DEVIATION_OF_MEDIAN * upper_median(all.collect()).unwrap_or(0.0)).max(MIN_DEVIATION)
        });
        let limit = TUKEY * deviation;
        let (mut equations, mut flows, mut cost) = (NormalEquations::default(), [[0.0; 6]; 6], 0.0);
        for &(i, depth) in &counted {
            let [across, down] = flow(camera, centre(i, w), depth);
            for a in 0..6 {
                for b in 0..6 {
                    flows[a][b] += across[a] * across[b] + down[a] * down[b];
                }
            }
            for c in 0..3 {
                let r = residual(c, i);
                let inside = (1.0 - (r / limit).powi(2)).max(0.0);
                // 1 of what counts as an outlier.
                cost += 1.0 - inside.powi(3);
                if inside == 0.0 {
                    continue;
                }
                // The mean of both gradients: steps converge to second order (Malis 2004).
                let slope = |d: usize| {
                    let of = |image: &Image| image.data[c * n + i + d] - image.data[c * n + i - d];
                    f64::from(0.25 * (of(&image) + of(&rendered.shown)))
                };
                let (gx, gy) = (slope(1), slope(w));
                // A pixel shows after the motion what was where the flow comes from.
                let jacobian = std::array::from_fn(|k| -(gx * across[k] + gy * down[k]));
                equations.add(inside * inside, &jacobian, r);
            }
        }
        let share = 1.0 / counted.len() as f64;
        flows.as_flattened_mut().iter_mut().for_each(|v| *v *= share);
        Some(Difference { equations, flows, cost: cost * share / 3.0, deviation })
    }

    /// Root mean square of the pixels' motion by a twist, in pixels.
    fn motion(&self, twist: &Twist) -> f64 {
        form(twist, &self.flows, twist).max(0.0).sqrt()
    }
}

/// The pose near `start` from which the scene looks most like the photo, among its pixels `within`; `start` where no
/// other is better. `render` renders the camera from a pose.
pub(crate) fn align(
    start: Pose,
    camera: &Camera,
    photo: &PhotoLevel,
    within: &dyn Fn(usize) -> bool,
    render: &mut dyn FnMut(&Camera, &Pose) -> Result<RenderedDepth, TrainError>,
) -> Result<Pose, TrainError> {
    let mut best: Option<(f64, Pose)> = None;
    let (mut pose, mut deviation, mut last) = (start, None, false);
    for step in 0..=STEPS {
        let rendered = render(camera, &pose)?;
        let Some(difference) = Difference::of(&rendered, photo, camera, deviation, within) else { break };
        if best.is_some_and(|(cost, _)| difference.cost >= cost) {
            break;
        }
        (best, deviation) = (Some((difference.cost, pose)), Some(difference.deviation));
        if last || step == STEPS {
            break;
        }
        let Some(twist) = difference.equations.twist() else { break };
        last = difference.motion(&twist) < SETTLED;
        pose = moved(&pose, &twist);
    }
    Ok(best.map_or(start, |(_, pose)| pose))
}

/// Sum of alpha T z of a projected view.
pub(crate) fn depth_sum(
    projected: &dyn Projected,
    means: &[[f32; 3]],
    pose: &Pose,
) -> Result<Image, TrainError> {
    let depths: Vec<f32> = means.iter().map(|&mean| pose.to_camera(mean.into()).z).collect();
    Ok(projected.blend(&Channels { count: 1, values: &depths })?.image)
}
