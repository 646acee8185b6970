//! Prompts as a person would give them: a click anywhere on an object, a box around it, a correction where an answer is wrong.

use segwild_scene::{BoxPrompt, Mask, PointPrompt, Random};

/// The row of a record whose prompt is a box.
pub const BOX: &str = "box";

/// Clicks keep away from an object's outline by this share of the photo's diagonal, where the object is wide enough: a person
/// aims inside.
pub const INSET: f32 = 0.01;

/// A box is wider than the object by at most this share of the photo's diagonal on each side: nobody draws it by the pixel.
pub const BOX_MARGIN: f32 = 0.01;

fn diagonal(mask: &Mask) -> f32 {
    (mask.width() as f32).hypot(mask.height() as f32)
}

/// A pixel of a mask, away from its outline where the mask is wide enough.
pub fn random_pixel(mask: &Mask, random: &mut Random) -> [f32; 2] {
    let depths = mask.not().distances();
    let inset = INSET * diagonal(mask);
    let deep = |&(x, y): &(u32, u32)| depths[(y * mask.width() + x) as usize] > inset;
    let mut pixels: Vec<(u32, u32)> = mask.pixels().filter(deep).collect();
    if pixels.is_empty() {
        pixels = mask.pixels().collect();
    }
    let (x, y) = pixels[random.below(pixels.len())];
    [x as f32 + 0.5, y as f32 + 0.5]
}

/// A box around a mask that is not empty, within the frame.
pub fn random_box(mask: &Mask, random: &mut Random) -> BoxPrompt {
    let (mut low, mut high) = ([f32::INFINITY; 2], [0.0f32; 2]);
    for (x, y) in mask.pixels() {
        for (axis, at) in [x as f32, y as f32].into_iter().enumerate() {
            low[axis] = low[axis].min(at);
            high[axis] = high[axis].max(at + 1.0);
        }
    }
    let mut margin = || random.uniform() * BOX_MARGIN * diagonal(mask);
    let [x0, y0] = low.map(|at| (at - margin()).max(0.0));
    let frame = [mask.width() as f32, mask.height() as f32];
    let [x1, y1] = [0, 1].map(|axis: usize| (high[axis] + margin()).min(frame[axis]));
    BoxPrompt { x0, y0, x1, y1 }
}

/// The pixel deepest inside of what `mask` lacks of `truth`, or has beyond it, as a click that says which; with its depth as a share
/// of the diagonal. Outside of the frame nothing is wrong. `None` where the masks are the same. This is the next click of the
/// measure NoC (number of clicks) of interactive segmentation.
pub fn worst_error(truth: &Mask, mask: &Mask) -> Option<(f32, PointPrompt)> {
    let deepest = |wrong: Mask| {
        let depths = wrong.depths();
        let depth = |(x, y): (u32, u32)| depths[(y * truth.width() + x) as usize];
        wrong
            .pixels()
            .map(|at| (depth(at), at))
            .reduce(|best, other| if other.0 > best.0 { other } else { best })
    };
    let (lacks, beyond) = (deepest(truth.minus(mask)), deepest(mask.minus(truth)));
    let [lacks, beyond] = [(lacks, true), (beyond, false)].map(|(found, inside)| {
        let (depth, (x, y)) = found?;
        let point = PointPrompt { x: x as f32 + 0.5, y: y as f32 + 0.5, inside };
        Some((depth / diagonal(truth), point))
    });
    match (lacks, beyond) {
        (Some(a), Some(b)) => Some(if b.0 > a.0 { b } else { a }),
        (a, b) => a.or(b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(xs: std::ops::Range<u32>, ys: std::ops::Range<u32>) -> Mask {
        Mask::from_fn(100, 80, |x, y| xs.contains(&x) && ys.contains(&y))
    }

    #[test]
    fn a_random_click_keeps_a_distance_from_the_outline() {
        let mask = block(20..60, 10..50);
        let thin = Mask::from_fn(100, 80, |x, _| x == 30);
        let mut random = Random::new(3);
        for _ in 0..200 {
            let [x, y] = random_pixel(&mask, &mut random);
            assert!((21.0..59.0).contains(&x) && (11.0..49.0).contains(&y), "({x}, {y})");
            assert_eq!(random_pixel(&thin, &mut random)[0], 30.5);
        }
    }

    #[test]
    fn a_random_box_holds_the_object_and_stays_in_the_frame() {
        let mut random = Random::new(3);
        for _ in 0..50 {
            let b = random_box(&block(0..60, 10..80), &mut random);
            assert!(b.x0 == 0.0 && b.y1 == 80.0, "{b:?}");
            assert!((60.0..=61.3).contains(&b.x1) && (8.7..=10.0).contains(&b.y0), "{b:?}");
        }
    }

    #[test]
    fn the_next_click_is_in_the_middle_of_the_largest_error() {
        let truth = block(20..60, 10..50);
        assert_eq!(worst_error(&truth, &truth), None);
        // The right half is missing: 20 x 40 pixels.
        let (depth, click) = worst_error(&truth, &block(20..40, 10..50)).unwrap();
        assert!(
            click.inside && (49.0..51.0).contains(&click.x) && (19.0..41.0).contains(&click.y),
            "{click:?}"
        );
        assert!((depth - 10.0 / 128.06).abs() < 1e-3, "{depth}");
        // A strip of 30 pixels too much weighs more; it is cut by the frame, where it is not deep.
        let (_, click) = worst_error(&truth, &block(20..100, 10..50)).unwrap();
        assert!(!click.inside && (79.0..81.0).contains(&click.x), "{click:?}");
        // Nothing selected: the middle of the object.
        let (_, click) = worst_error(&truth, &Mask::empty(100, 80)).unwrap();
        assert!(
            click.inside && (39.0..41.0).contains(&click.x) && (29.0..31.0).contains(&click.y),
            "{click:?}"
        );
    }
}
