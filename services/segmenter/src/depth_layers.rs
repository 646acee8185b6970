//! What a mask takes along of what stands behind.
//!
//! A 2D segmenter does not see how far away things are: where a statue and the wall behind it look alike, its mask takes in
//! a piece of the wall, and other photos complete that piece to the whole wall. The splats know better. In the photo that
//! was clicked, what such a mask holds lies in two layers with empty space between them, and all clicks are on the near one.

use crate::{Evidence, PromptedView};
use segwild_raster::{Channels, Projected, RasterError};
use segwild_scene::{Camera, Image};

/// Accumulated alpha under which it is not known how far away a pixel is.
const SOLID: f32 = 0.5;

/// Share of a splat's evidence that must lie inside for its depth to count: those astride the outline are of either thing.
const WITHIN: f32 = 0.5;

/// How far behind the deepest click the other thing must begin, and how far apart the middles of the two layers must be, in
/// widths of the near layer: things are rarely deeper than they are wide.
const CLEAR: f64 = 1.0;
const APART: f64 = 2.0;

/// Most light that the middle half of the way between the two layers may hold, as a share of the far layer: a street that
/// leads away is deep as well, but fills all depths. Spread evenly, the light there would be half of a layer's.
const EMPTY: f64 = 0.4;

/// Share of what the mask said for a splat of the layer behind that then speaks against it. Little, so that other photos
/// overrule it where the near layer is but the front of the thing.
const AGAINST: f32 = 0.3;

/// Most layers behind the near one.
const LAYERS: usize = 4;

/// How far away a splat is, and how many pixels' light it sends from inside the mask.
struct Seen {
    depth: f64,
    light: f64,
}

/// Turns what a prompted mask says for splats against them where they lie clearly behind what was clicked. `evidence`: what the
/// mask says; `inside`: how much of each pixel of `frame` it covers; `asked`: the camera in whose pixels the clicks are.
pub(crate) fn doubt(
    evidence: &mut Evidence,
    projected: &dyn Projected,
    prompt: &PromptedView,
    inside: Vec<f32>,
    asked: &Camera,
    frame: &Camera,
) -> Result<(), RasterError> {
    let Some(clicked) = deepest_click(projected, prompt, asked, frame)? else { return Ok(()) };
    let (width, height) = (frame.width as usize, frame.height as usize);
    let light = projected.gather(&Image { width, height, channels: 1, data: inside })?;
    let depths = projected.depths();
    let mut seen: Vec<Seen> = (0..depths.len())
        .filter(|&i| depths[i].is_finite() && light[i] > 0.0)
        .filter(|&i| evidence.rho(i).is_some_and(|rho| rho >= WITHIN))
        .map(|i| Seen { depth: depths[i].into(), light: light[i].into() })
        .collect();
    seen.sort_by(|a, b| a.depth.total_cmp(&b.depth));
    let pixel = clicked / f64::from(frame.fx);
    let Some(end) = end_of_near_layer(&seen, clicked, pixel) else { return Ok(()) };
    for i in (0..depths.len()).filter(|&i| f64::from(depths[i]) > end) {
        let all = evidence.seen(i);
        evidence.outside[i] += AGAINST * std::mem::take(&mut evidence.inside[i]);
        if all > 0.0 {
            evidence.known[i] *= evidence.outside[i] / all;
        }
    }
    Ok(())
}

/// How far away the furthest of the places is that the clicks say the object is at; `None` where no click is on anything.
fn deepest_click(
    projected: &dyn Projected,
    prompt: &PromptedView,
    asked: &Camera,
    frame: &Camera,
) -> Result<Option<f64>, RasterError> {
    let values: Vec<f32> = projected.depths().iter().map(|z| if z.is_finite() { *z } else { 0.0 }).collect();
    let rendered = projected.blend(&Channels { count: 1, values: &values })?;
    let scaled = |at: f32, from: u32, to: u32| ((at * to as f32 / from as f32) as u32).min(to - 1);
    let clicks = prompt.points.iter().filter(|point| point.inside);
    let depth = |pixel: usize| {
        let alpha = rendered.alpha.data[pixel];
        (alpha >= SOLID).then(|| f64::from(rendered.image.data[pixel] / alpha))
    };
    Ok(clicks
        .map(|p| (scaled(p.x, asked.width, frame.width), scaled(p.y, asked.height, frame.height)))
        .filter_map(|(x, y)| depth((y * frame.width + x) as usize))
        .reduce(f64::max))
}

/// The depth at which the layer ends that reaches to `clicked`, if there is another clearly behind it. `seen` comes by rising
/// depth; `pixel` is the width of a pixel at the click, in scene units.
fn end_of_near_layer(seen: &[Seen], clicked: f64, pixel: f64) -> Option<f64> {
    let (mut left, mut end) = (seen, None);
    for _ in 0..LAYERS {
        let Some(split) = best_split(left, clicked) else { break };
        let (near, far) = left.split_at(split);
        let between = 0.5 * (near[split - 1].depth + far[0].depth);
        let (from, to) = (median(near), median(far));
        let width = pixel * light(near).sqrt();
        let (middle, reach) = (0.5 * (from + to), 0.25 * (to - from));
        let midway: f64 = left.iter().filter(|s| (s.depth - middle).abs() < reach).map(|s| s.light).sum();
        let apart = between - clicked >= CLEAR * width && to - from >= APART * width;
        // What a mask takes along is less than what is meant: if most lies behind, the near layer is a haze before it.
        if !apart || light(far) > light(near) || midway > EMPTY * light(far) {
            break;
        }
        (left, end) = (near, Some(between));
    }
    end
}

fn light(seen: &[Seen]) -> f64 {
    seen.iter().map(|s| s.light).sum()
}

/// The depth before which half of the light comes from.
fn median(seen: &[Seen]) -> f64 {
    let mut left = 0.5 * light(seen);
    let reached = seen.iter().find(|s| {
        left -= s.light;
        left <= 0.0
    });
    reached.or(seen.last()).map_or(0.0, |s| s.depth)
}

/// How many come first when they are split into the two groups that differ most from one another (Otsu's criterion), all that
/// is no deeper than `clicked` among the first.
fn best_split(seen: &[Seen], clicked: f64) -> Option<usize> {
    let moment = |seen: &[Seen]| -> f64 { seen.iter().map(|s| s.light * s.depth).sum() };
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
    fn layer(from: f64, to: f64, count: usize) -> Vec<Seen> {
        let depth = |i: usize| from + (to - from) * i as f64 / count as f64;
        (0..count).map(|i| Seen { depth: depth(i), light: 1.0 }).collect()
    }

    fn end(layers: Vec<Vec<Seen>>, clicked: f64) -> Option<f64> {
        end_of_near_layer(&layers.into_iter().flatten().collect::<Vec<_>>(), clicked, PIXEL)
    }

    #[test]
    fn a_statue_ends_before_the_wall_and_the_hills_behind_it() {
        // The statue is 0.3 wide.
        let found = end(vec![layer(1.0, 1.2, 900), layer(2.0, 2.2, 900), layer(9.0, 10.0, 300)], 1.1);
        assert!(found.is_some_and(|end| end > 1.2 && end < 2.0), "{found:?}");
    }

    #[test]
    fn a_street_that_leads_away_from_the_click_is_one_thing() {
        assert_eq!(end(vec![layer(1.0, 5.0, 900)], 1.1), None);
        // Near parts of a wall along the street show larger.
        let wall = (0..400).map(|i| 1.0 + 0.01 * f64::from(i));
        let wall = wall.map(|depth| Seen { depth, light: 10.0 / depth.powi(3) }).collect();
        assert_eq!(end(vec![wall], 1.1), None);
    }

    #[test]
    fn a_haze_before_what_was_clicked_does_not_take_its_place() {
        // Seen through the haze, the click seems to lie before the thing itself.
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
