//! Depth layering: the part of a mask that lies in the background of the clicked object.
//!
//! A 2D segmenter has no depth. Where a statue and the wall behind it look alike, its mask includes a piece of the wall,
//! and other photos complete that piece to the whole wall. The splats have depth: in the clicked photo, the splats of such
//! a mask lie in two layers with empty space between them, and all clicks are on the near one.

use crate::{Evidence, PromptedView};
use segwild_raster::{Channels, Projected, RasterError};
use segwild_scene::{Camera, Image};

/// Accumulated alpha `A` under which the depth of a click is unknown (method, section 6.6). By choice. Half and half more
/// changed no measured click.
const MIN_DEPTH_ALPHA: f32 = 0.5;

/// How much deeper than the deepest click the far layer must start, in widths `W` of the near layer (method, section 6.6):
/// things are rarely deeper than they are wide. From docs/experiments/2026-11-23-depth-layering.md. Half and half more changed
/// no measured click.
const LAYER_GAP: f64 = 1.0;

/// How far apart the medians of the two layers must be, in widths `W` of the near layer (method, section 6.6). From
/// docs/experiments/2026-11-23-depth-layering.md. Half and half more changed no measured click.
const LAYER_DISTANCE: f64 = 2.0;

/// Most light that the middle half of the way between the two layers may hold, as a share of the far layer (method, section
/// 6.6): a street that recedes from the camera is deep as well, but fills all depths. Spread evenly, the light there would be
/// half of a layer's. IoU by half, half more: 0, 0 on `sacre_coeur`; 0, +.010 on the demo.
const MAX_LIGHT_MIDWAY: f64 = 0.4;

/// Share `beta` of the evidence for a splat of the far layer that becomes evidence against it (method, section 6.6). Small, so
/// that other photos overrule it where the near layer is only the front of the object. From
/// docs/experiments/2026-11-23-depth-layering.md. Half and half more changed no measured click.
const BACKGROUND_AGAINST: f32 = 0.3;

/// At most so many layers are split off behind the near one. Half and half more changed no measured click.
const MAX_LAYERS: usize = 4;

/// Depth of a splat, and its light inside the mask, in pixels.
struct SplatDepth {
    depth: f64,
    light: f64,
}

/// Turns a prompted mask's evidence for splats into evidence against them where they lie clearly behind the clicked object.
/// `evidence` is the mask's; `inside` is its coverage of each pixel of `frame`, in [0, 1]; the clicks are in pixels of
/// `click_camera`.
pub(crate) fn discount_background(
    evidence: &mut Evidence,
    projected: &dyn Projected,
    prompt: &PromptedView,
    inside: Vec<f32>,
    click_camera: &Camera,
    frame: &Camera,
) -> Result<(), RasterError> {
    let Some(clicked) = deepest_click(projected, prompt, click_camera, frame)? else { return Ok(()) };
    let (width, height) = (frame.width as usize, frame.height as usize);
    let light = projected.gather(&Image { width, height, channels: 1, data: inside })?;
    let depths = projected.depths();
    let mut seen: Vec<SplatDepth> = (0..depths.len())
        .filter(|&i| depths[i].is_finite() && light[i] > 0.0 && evidence.seen(i) > 0.0)
        .map(|i| SplatDepth { depth: depths[i].into(), light: light[i].into() })
        .collect();
    seen.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let pixel = clicked / f64::from(frame.fx);
    let Some(end) = end_of_near_layer(&seen, clicked, pixel) else { return Ok(()) };
    for i in (0..depths.len()).filter(|&i| f64::from(depths[i]) > end) {
        let all = evidence.seen(i);
        evidence.outside[i] += BACKGROUND_AGAINST * std::mem::take(&mut evidence.inside[i]);
        if all > 0.0 {
            evidence.known[i] *= evidence.outside[i] / all;
        }
    }
    Ok(())
}

/// Depth of the deepest positive click, in scene units; `None` where no click is on a splat.
fn deepest_click(
    projected: &dyn Projected,
    prompt: &PromptedView,
    click_camera: &Camera,
    frame: &Camera,
) -> Result<Option<f64>, RasterError> {
    let values: Vec<f32> = projected.depths().iter().map(|z| if z.is_finite() { *z } else { 0.0 }).collect();
    let rendered = projected.blend(&Channels { count: 1, values: &values })?;
    let scaled = |at: f32, from: u32, to: u32| ((at * to as f32 / from as f32) as u32).min(to - 1);
    let clicks = prompt.points.iter().filter(|point| point.inside);
    let depth = |pixel: usize| {
        let alpha = rendered.alpha.data[pixel];
        (alpha >= MIN_DEPTH_ALPHA).then(|| f64::from(rendered.image.data[pixel] / alpha))
    };
    Ok(clicks
        .map(|p| {
            (scaled(p.x, click_camera.width, frame.width), scaled(p.y, click_camera.height, frame.height))
        })
        .filter_map(|(x, y)| depth((y * frame.width + x) as usize))
        .reduce(f64::max))
}

/// The depth at which the layer ends that holds the depth `clicked`, if there is another clearly behind it. `seen` is sorted by
/// rising depth; `pixel` is the width of a pixel at the click, in scene units.
fn end_of_near_layer(seen: &[SplatDepth], clicked: f64, pixel: f64) -> Option<f64> {
    let (mut left, mut end) = (seen, None);
    for _ in 0..MAX_LAYERS {
        let Some(split) = best_split(left, clicked) else { break };
        let (near, far) = left.split_at(split);
        let boundary = 0.5 * (near[split - 1].depth + far[0].depth);
        let (from, to) = (median(near), median(far));
        let width = pixel * light(near).sqrt();
        let (middle, reach) = (0.5 * (from + to), 0.25 * (to - from));
        let midway: f64 = left.iter().filter(|s| (s.depth - middle).abs() < reach).map(|s| s.light).sum();
        let apart = boundary - clicked >= LAYER_GAP * width && to - from >= LAYER_DISTANCE * width;
        // A mask includes less background than object: if most light comes from the far layer, the near one is haze before it.
        if !apart || light(far) > light(near) || midway > MAX_LIGHT_MIDWAY * light(far) {
            break;
        }
        (left, end) = (near, Some(boundary));
    }
    end
}

fn light(seen: &[SplatDepth]) -> f64 {
    seen.iter().map(|s| s.light).sum()
}

/// The depth before which half of the light comes from.
fn median(seen: &[SplatDepth]) -> f64 {
    let mut left = 0.5 * light(seen);
    let reached = seen.iter().find(|s| {
        left -= s.light;
        left <= 0.0
    });
    reached.or(seen.last()).map_or(0.0, |s| s.depth)
}

/// How many come first when they are split into the two groups that differ most from one another (Otsu's criterion), all that
/// is no deeper than `clicked` among the first.
fn best_split(seen: &[SplatDepth], clicked: f64) -> Option<usize> {
    let moment = |seen: &[SplatDepth]| -> f64 { seen.iter().map(|s| s.light * s.depth).sum() };
    let first = seen.partition_point(|s| s.depth <= clicked).max(1);
    let (head, rest) = seen.split_at_checked(first)?;
    let (mut near, mut near_moment) = (light(head), moment(head));
    let (mut far, mut far_moment) = (light(rest), moment(rest));
    let (mut best, mut best_score) = (None, 0.0);
    for (at, next) in rest.iter().enumerate() {
        let apart = far_moment / far - near_moment / near;
        let score = near * far * apart * apart;
        if score > best_score {
            (best, best_score) = (Some(first + at), score);
        }
        near += next.light;
        near_moment += next.light * next.depth;
        far -= next.light;
        far_moment -= next.light * next.depth;
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Width of a pixel, in scene units.
    const PIXEL: f64 = 0.01;

    /// Splats of a pixel's light each, spread over depths `from` to `to`.
    fn layer(from: f64, to: f64, count: usize) -> Vec<SplatDepth> {
        let depth = |i: usize| from + (to - from) * i as f64 / count as f64;
        (0..count).map(|i| SplatDepth { depth: depth(i), light: 1.0 }).collect()
    }

    fn end(layers: Vec<Vec<SplatDepth>>, clicked: f64) -> Option<f64> {
        end_of_near_layer(&layers.into_iter().flatten().collect::<Vec<_>>(), clicked, PIXEL)
    }

    #[test]
    fn a_statue_ends_before_the_wall_and_the_hills_of_the_background() {
        // The statue is 0.3 wide.
        let found = end(vec![layer(1.0, 1.2, 900), layer(2.0, 2.2, 900), layer(9.0, 10.0, 300)], 1.1);
        assert!(found.is_some_and(|end| end > 1.2 && end < 2.0), "{found:?}");
    }

    #[test]
    fn a_street_that_recedes_from_the_camera_is_one_layer() {
        assert_eq!(end(vec![layer(1.0, 5.0, 900)], 1.1), None);
        // Near parts of a wall along the street show larger.
        let wall = (0..400).map(|i| 1.0 + 0.01 * f64::from(i));
        let wall = wall.map(|depth| SplatDepth { depth, light: 10.0 / depth.powi(3) }).collect();
        assert_eq!(end(vec![wall], 1.1), None);
    }

    #[test]
    fn haze_before_the_clicked_object_is_not_taken_for_the_object() {
        // Through the haze, the click seems to lie before the object itself.
        assert_eq!(end(vec![layer(1.0, 1.02, 100), layer(2.0, 2.2, 6000)], 1.2), None);
    }

    #[test]
    fn an_arm_before_the_body_is_no_layer_of_its_own() {
        assert_eq!(end(vec![layer(1.0, 1.05, 900), layer(1.4, 1.5, 900)], 1.02), None);
    }

    #[test]
    fn what_was_clicked_at_the_back_as_well_is_meant() {
        assert_eq!(end(vec![layer(1.0, 1.2, 900), layer(2.0, 2.2, 900)], 2.1), None);
    }

    #[test]
    fn a_mask_that_holds_no_splats_has_no_layers() {
        assert_eq!(end(vec![], 1.0), None);
        assert_eq!(end(vec![layer(1.0, 1.0, 1)], 1.0), None);
    }
}
