//! What stands before the sky and is not among the splats.
//!
//! Flames, rays and finials are small, and photos' poses are a pixel or two apart: splats come out thinner than the thing, or not
//! at all. A photo that is told "nothing is there" leaves such a part out, and so the next. But what is empty and no sky is
//! something, and what it is a part of is said by what stands around it.

use segwild_scene::{Image, Mask, box_mean};

/// Half width of the window in which neighbours are asked, as a share of the photo's diagonal; it is laid twice.
const AROUND: f32 = 0.008;
/// Share of sky around an empty pixel from which it surely stands before the sky. Before a ground or a sea that no splat models
/// emptiness says nothing.
const OPEN: f32 = 0.25;
/// Splats around a pixel, as accumulated alpha, from which on they can speak for it.
const SPEAK: f32 = 0.02;

/// Completes what is believed of a photo's pixels where splats are lacking: `certainty` and `alpha`, as rendered, are one plane
/// each. Gives back how much of each pixel is lacking, in [0, 1].
pub(crate) fn complete(certainty: &mut Image, alpha: &Image, sky: &Mask) -> Vec<f32> {
    let (w, h) = (certainty.width, certainty.height);
    let sky = sky.resized(w as u32, h as u32);
    let r = ((AROUND * (w as f32).hypot(h as f32)).round() as usize).max(1);
    let around = |values: &[f32]| box_mean(&box_mean(values, w, h, r), w, h, r);
    let open: Vec<f32> = (0..w * h).map(|i| f32::from(u8::from(sky.index(i)))).collect();
    let (open, solid, inside) = (around(&open), around(&alpha.data), around(&certainty.data));
    (0..w * h)
        .map(|i| {
            let known = solid[i] >= SPEAK && inside[i].is_finite();
            if sky.index(i) || !known {
                return 0.0;
            }
            let lacking = (1.0 - alpha.data[i]).clamp(0.0, 1.0) * (open[i] / OPEN).min(1.0);
            certainty.data[i] = (certainty.data[i] + lacking * (inside[i] / solid[i]).min(1.0)).min(1.0);
            lacking
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (240, 320);

    fn picture(of: impl Fn(usize, usize) -> f32) -> Image {
        let data = (0..SIZE.0 * SIZE.1).map(|i| of(i % SIZE.0, i / SIZE.0)).collect();
        Image { width: SIZE.0, height: SIZE.1, channels: 1, data }
    }

    fn mask(of: impl Fn(usize, usize) -> bool) -> Mask {
        Mask::from_fn(SIZE.0 as u32, SIZE.1 as u32, |x, y| of(x as usize, y as usize))
    }

    fn arm(x: usize, y: usize) -> bool {
        (100..140).contains(&x) && y >= 160
    }

    fn flame(x: usize, y: usize) -> bool {
        (117..123).contains(&x) && (155..160).contains(&y)
    }

    fn lit(inside: bool) -> f32 {
        f32::from(u8::from(inside))
    }

    #[test]
    fn a_flame_that_no_splat_holds_belongs_to_the_arm_below_it() {
        let (mut certainty, alpha) = (picture(|x, y| lit(arm(x, y))), picture(|x, y| lit(arm(x, y))));
        let lacking = complete(&mut certainty, &alpha, &mask(|x, y| !arm(x, y) && !flame(x, y)));
        for (i, (c, l)) in certainty.data.iter().zip(&lacking).enumerate() {
            let (x, y) = (i % SIZE.0, i / SIZE.0);
            if flame(x, y) {
                assert!(*c > 0.5 && *l > 0.5, "{x} {y}: {c} {l}");
            } else {
                assert_eq!((*c, *l), (lit(arm(x, y)), 0.0), "{x} {y}");
            }
        }
        // A part of something else stays something else.
        let mut other = picture(|_, _| 0.0);
        complete(&mut other, &alpha, &mask(|x, y| !arm(x, y) && !flame(x, y)));
        assert!(other.data.iter().all(|c| *c == 0.0));
    }

    #[test]
    fn emptiness_before_a_ground_without_splats_says_nothing() {
        let (told, alpha) = (picture(|x, y| lit(arm(x, y))), picture(|x, y| lit(arm(x, y))));
        let mut certainty = told.clone();
        let lacking = complete(&mut certainty, &alpha, &mask(|_, y| y < 40));
        assert!(certainty == told && lacking.iter().all(|l| *l == 0.0));
    }

    #[test]
    fn what_is_no_number_completes_nothing() {
        let mut alpha = picture(|x, y| lit(arm(x, y)));
        alpha.data[170 * SIZE.0 + 120] = f32::NAN;
        let mut certainty = picture(|x, y| lit(arm(x, y)));
        let lacking = complete(&mut certainty, &alpha, &mask(|x, y| !arm(x, y) && !flame(x, y)));
        assert!(certainty.data.iter().chain(&lacking).all(|v| v.is_finite()));
    }
}
