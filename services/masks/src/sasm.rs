//! Where to prompt: scale-adaptive prompts (method, section 5; paper Eq. 15-23).
//!
//! A far camera sees its object small, so its photo is divided into more cells ([`segs`]); a cell whose surface is
//! far, and densely covered by splats, gets more prompts ([`prompt_map`]). Sky gets the fewest.

use crate::{MaskError, MaskSettings};
use glam::Vec3;
use segwild_scene::statistics::interpolated_quantile;
use segwild_scene::{Camera, Image, Mask, NEAR, Pose, Scene, View};

/// Diagonal in mm of the 36 x 24 frame that 35-mm focal lengths refer to.
const FRAME_DIAGONAL: f64 = 43.266_615_305_567_875;
/// Focal length in mm that counts as neutral (Eq. 15).
const NORMAL_FOCAL: f64 = 50.0;

/// Focal length in 35-mm terms, in mm: the one that gives the same angle over the diagonal.
///
/// The diagonal, because it does not care whether a photo is portrait or landscape.
pub fn focal_35mm(camera: &Camera) -> f64 {
    let diagonal = f64::from(camera.width).hypot(f64::from(camera.height));
    (f64::from(camera.fx) * f64::from(camera.fy)).sqrt() * FRAME_DIAGONAL / diagonal
}

/// How far a camera stands from the scene, zoom discounted: the mean depth along the optical axis of the points
/// in front of it, over `f35 / 50` (Eq. 15). `None` if no point is in front.
pub fn view_depth(camera: &Camera, pose: &Pose, points: impl IntoIterator<Item = Vec3>) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0u64);
    for p in points {
        let z = pose.to_camera(p).z;
        if z.is_finite() && z > 0.0 {
            sum += f64::from(z);
            count += 1;
        }
    }
    let depth = sum / count as f64 / (focal_35mm(camera) / NORMAL_FOCAL);
    (count > 0 && depth.is_finite()).then_some(depth)
}

/// The spread of [`view_depth`] over the training photos: what is near and what is far in the scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SceneDepths {
    /// 1 % quantile.
    pub low: f64,
    /// 99 % quantile.
    pub high: f64,
}

impl SceneDepths {
    /// Spread over a scene's training photos.
    pub fn of(scene: &Scene) -> SceneDepths {
        let train = scene.views.iter().filter(|v| !v.test);
        SceneDepths::spread(train.filter_map(|v| scene_view_depth(scene, v)).collect())
    }

    /// Spread of given view depths; what is not finite does not count.
    pub fn spread(mut depths: Vec<f64>) -> SceneDepths {
        depths.retain(|d| d.is_finite());
        depths.sort_by(f64::total_cmp);
        let [low, high] = low_and_high(&depths);
        SceneDepths { low, high }
    }

    /// Where a view depth lies between near (0) and far (1); 0.5 if it is unknown or all photos are alike.
    pub fn relative(&self, depth: Option<f64>) -> f64 {
        let range = self.high - self.low;
        match depth {
            // Rounding alone must not decide: depths within 1e-6 of each other are equal.
            Some(d) if d.is_finite() && range > 1e-6 * self.high.abs() => {
                ((d - self.low) / range).clamp(0.0, 1.0)
            }
            _ => 0.5,
        }
    }
}

/// [`view_depth`] of a scene's view over the scene's points.
pub fn scene_view_depth(scene: &Scene, view: &View) -> Option<f64> {
    view_depth(&view.camera, &view.pose, scene.points.iter().map(|p| p.position))
}

/// Cells along each side of the prompt grid for a relative depth in [0, 1]: 4 (near) to 8 (far) (Eq. 17).
pub fn segs(relative_depth: f64) -> u32 {
    // Clamped as a whole number: a NaN becomes 0 there, and then the coarsest grid.
    ((4.0 + 4.0 * relative_depth.clamp(0.0, 1.0) + 0.5).floor() as u32).clamp(4, 8)
}

/// The nearest splat centre per pixel, scaled so that near is 0 and far is 1 (Eq. 18-20).
///
/// `camera` gives the map's size. Pixels without a centre take the smallest depth, which is how thin cover
/// lowers the number of prompts; so do the pixels of `sky`. The 1 and 99 % quantiles that the scale runs
/// between are those of the pixels that have a depth: filled pixels would drown them on a sparse scene.
/// If all depths are equal, pixels with a depth are 0.5 and the others 0.
pub fn depth_map(means: &[[f32; 3]], camera: &Camera, pose: &Pose, sky: Option<&Mask>) -> Image {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let mut depth = vec![f32::INFINITY; w * h];
    for &mean in means {
        let p = pose.to_camera(Vec3::from(mean));
        if !p.is_finite() || p.z <= NEAR {
            continue;
        }
        let pixel = camera.pixel(p);
        if camera.contains(pixel) {
            // `contains` compares in f32, where the largest value below the width may still round up to it.
            let (x, y) = ((pixel.x as usize).min(w - 1), (pixel.y as usize).min(h - 1));
            let cell = &mut depth[y * w + x];
            *cell = cell.min(p.z);
        }
    }
    if let Some(sky) = sky {
        for (i, d) in depth.iter_mut().enumerate() {
            let (u, v) = ((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
            let (sx, sy) = (sky.width() as f32 / w as f32, sky.height() as f32 / h as f32);
            if sky.at(u * sx, v * sy) {
                *d = f32::INFINITY;
            }
        }
    }
    let mut known: Vec<f64> = depth.iter().filter(|d| d.is_finite()).map(|&d| f64::from(d)).collect();
    known.sort_by(f64::total_cmp);
    let [low, high] = low_and_high(&known);
    let range = high - low;
    let scaled = |d: f32| match d {
        d if !d.is_finite() => 0.0,
        _ if range <= 1e-6 * high => 0.5,
        d => ((f64::from(d) - low) / range).clamp(0.0, 1.0) as f32,
    };
    Image { width: w, height: h, channels: 1, data: depth.into_iter().map(scaled).collect() }
}

/// How many prompts each cell of a photo gets.
#[derive(Clone, Debug, PartialEq)]
pub struct PromptMap {
    /// Cells along each side.
    pub segs: u32,
    /// Width of the photo in pixels.
    pub width: u32,
    /// Height of the photo in pixels.
    pub height: u32,
    /// Mean of the depth map per cell, row by row.
    pub depths: Vec<f64>,
    /// Prompts along each side of a cell (NPP), row by row.
    pub counts: Vec<u32>,
}

/// Prompts per cell (Eq. 21-22): `NPP = clamp(floor(kappa D), 1, most)`, D the cell's mean depth and kappa the
/// largest for which the sum of NPP² keeps within `budget`. One prompt per cell is the least, also where that
/// is over the budget.
pub fn prompt_map(depth: &Image, segs: u32, budget: u32, most: u32) -> PromptMap {
    let segs = segs.max(1);
    let (w, h) = (depth.width, depth.height);
    let mut depths = Vec::with_capacity((segs * segs) as usize);
    for row in 0..segs {
        for column in 0..segs {
            let (xs, ys) = (cell(column, segs, w), cell(row, segs, h));
            let pixels = xs.len() * ys.len();
            let sum: f64 = ys
                .flat_map(|y| depth.data[y * w..][xs.clone()].iter())
                .map(|&d| if d.is_finite() { f64::from(d) } else { 0.0 })
                .sum();
            depths.push(sum / pixels.max(1) as f64);
        }
    }
    let most = most.max(1);
    let npp = |kappa: f64, d: f64| ((kappa * d).floor() as u32).clamp(1, most);
    let total = |kappa: f64| depths.iter().map(|&d| u64::from(npp(kappa, d)).pow(2)).sum::<u64>();
    let smallest = depths.iter().copied().filter(|&d| d > 0.0).fold(f64::INFINITY, f64::min);
    let mut kappa = 0.0;
    if smallest.is_finite() {
        let full = f64::from(most + 1) / smallest;
        let (mut low, mut high) = (0.0, full);
        if total(full) <= u64::from(budget) {
            low = full;
        } else {
            for _ in 0..200 {
                let middle = 0.5 * (low + high);
                if total(middle) <= u64::from(budget) { low = middle } else { high = middle }
            }
        }
        kappa = low;
    }
    let counts = depths.iter().map(|&d| npp(kappa, d)).collect();
    PromptMap { segs, width: w as u32, height: h as u32, depths, counts }
}

impl PromptMap {
    /// The prompts as pixel positions, cell by cell: NPP x NPP points spread evenly over each (Eq. 23).
    pub fn prompts(&self) -> Vec<[f32; 2]> {
        let mut points = Vec::new();
        for row in 0..self.segs {
            let ys = cell(row, self.segs, self.height as usize);
            for column in 0..self.segs {
                let xs = cell(column, self.segs, self.width as usize);
                if !xs.is_empty() && !ys.is_empty() {
                    let count = self.counts[(row * self.segs + column) as usize];
                    spread(&mut points, xs, ys.clone(), count);
                }
            }
        }
        points
    }
}

/// A uniform grid with at most `budget` prompts (at least one): what SASM is compared with.
pub fn uniform_prompts(width: u32, height: u32, budget: u32) -> Vec<[f32; 2]> {
    let mut points = Vec::new();
    spread(&mut points, 0..width as usize, 0..height as usize, budget.isqrt().max(1));
    points
}

/// Prompts for one photo under the settings, at the size of `camera`; `relative_depth` from [`SceneDepths`].
pub fn plan(
    means: &[[f32; 3]],
    camera: &Camera,
    pose: &Pose,
    relative_depth: f64,
    sky: Option<&Mask>,
    settings: &MaskSettings,
) -> Result<PromptPlan, MaskError> {
    if camera.width == 0 || camera.height == 0 {
        return Err(MaskError::Size(format!(
            "a photo of {}x{} pixels has no room for prompts",
            camera.width, camera.height
        )));
    }
    if !settings.sasm {
        let points = uniform_prompts(camera.width, camera.height, settings.prompt_budget);
        return Ok(PromptPlan { map: None, points });
    }
    let depth = depth_map(means, camera, pose, sky.filter(|_| settings.sky_prompts));
    let map = prompt_map(&depth, segs(relative_depth), settings.prompt_budget, settings.max_points_per_cell);
    Ok(PromptPlan { points: map.prompts(), map: Some(map) })
}

/// The prompts of one photo and how they came about.
#[derive(Clone, Debug, PartialEq)]
pub struct PromptPlan {
    /// Prompts per cell; `None` for the uniform grid.
    pub map: Option<PromptMap>,
    /// Pixel positions.
    pub points: Vec<[f32; 2]>,
}

/// Pixels of cell `k` of `segs` along a side of `length`: edges at round(k length / segs).
fn cell(k: u32, segs: u32, length: usize) -> std::ops::Range<usize> {
    let edge = |k: u32| (f64::from(k) * length as f64 / f64::from(segs)).round() as usize;
    edge(k)..edge(k + 1)
}

fn spread(points: &mut Vec<[f32; 2]>, xs: std::ops::Range<usize>, ys: std::ops::Range<usize>, count: u32) {
    let at = |range: &std::ops::Range<usize>, i: u32| {
        range.start as f32 + range.len() as f32 * (i as f32 + 0.5) / count as f32
    };
    for j in 0..count {
        for i in 0..count {
            points.push([at(&xs, i), at(&ys, j)]);
        }
    }
}

/// The 1 and 99 % quantiles of sorted depths; 0 of none.
fn low_and_high(sorted: &[f64]) -> [f64; 2] {
    [0.01, 0.99].map(|share| interpolated_quantile(sorted, share).unwrap_or(0.0))
}
