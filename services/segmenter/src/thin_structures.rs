//! Thin structures before the sky that are missing from the splats.
//!
//! Flames, rays and finials are small, and photos' poses are off by a pixel or two: their splats are thinner than the thing,
//! or missing. A photo that gets "nothing there" as its prior leaves such a part out, and so does the next. But an empty
//! pixel that is not sky shows a thing, and the splats around it decide which object it is a part of.

use segwild_scene::{Image, Mask, box_mean};

/// Half width of the window of neighbours, as a share of the photo's diagonal; the box filter is applied twice (method, section
/// 6.4). By choice. IoU by half, half more: 0, -.002 on `sacre_coeur`; 0, 0 on the demo.
const WINDOW: f32 = 0.008;
/// Share `z_0` of sky around an empty pixel from which it surely stands before the sky (method, section 6.4). Before ground or
/// sea without splats, an empty pixel is no evidence. By choice. IoU by half, half more: 0, 0 on `sacre_coeur`; +.001, 0 on the
/// demo.
const SKY_SHARE: f32 = 0.25;
/// Least accumulated alpha `A` of the splats around a pixel that can decide it (method, section 6.4). By choice. Half and half
/// more move IoU by less than .0005.
const MIN_ALPHA_AROUND: f32 = 0.02;

/// Completes the prior of a photo's pixels where splats are missing: `certainty` and `alpha`, as rendered, are one plane
/// each. Returns how much of each pixel is missing, in [0, 1].
pub(crate) fn complete(certainty: &mut Image, alpha: &Image, sky: &Mask) -> Vec<f32> {
    let (w, h) = (certainty.width, certainty.height);
    let sky = sky.resized(w as u32, h as u32);
    if sky.is_empty() {
        // Nothing stands before the sky.
        return vec![0.0; w * h];
    }
    let r = ((WINDOW * (w as f32).hypot(h as f32)).round() as usize).max(1);
    let around = |values: &[f32]| box_mean(&box_mean(values, w, h, r), w, h, r);
    let open: Vec<f32> = (0..w * h).map(|i| f32::from(u8::from(sky.index(i)))).collect();
    let (open, solid, inside) = (around(&open), around(&alpha.data), around(&certainty.data));
    (0..w * h)
        .map(|i| {
            let known = solid[i] >= MIN_ALPHA_AROUND && inside[i].is_finite();
            if sky.index(i) || !known {
                return 0.0;
            }
            let missing = (1.0 - alpha.data[i]).clamp(0.0, 1.0) * (open[i] / SKY_SHARE).min(1.0);
            certainty.data[i] = (certainty.data[i] + missing * (inside[i] / solid[i]).min(1.0)).min(1.0);
            missing
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (240, 320);

    fn plane(of: impl Fn(usize, usize) -> f32) -> Image {
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
        let (mut certainty, alpha) = (plane(|x, y| lit(arm(x, y))), plane(|x, y| lit(arm(x, y))));
        let missing = complete(&mut certainty, &alpha, &mask(|x, y| !arm(x, y) && !flame(x, y)));
        for (i, (c, l)) in certainty.data.iter().zip(&missing).enumerate() {
            let (x, y) = (i % SIZE.0, i / SIZE.0);
            if flame(x, y) {
                assert!(*c > 0.5 && *l > 0.5, "{x} {y}: {c} {l}");
            } else {
                assert_eq!((*c, *l), (lit(arm(x, y)), 0.0), "{x} {y}");
            }
        }
        // A part of something else stays something else.
        let mut other = plane(|_, _| 0.0);
        complete(&mut other, &alpha, &mask(|x, y| !arm(x, y) && !flame(x, y)));
        assert!(other.data.iter().all(|c| *c == 0.0));
    }

    #[test]
    fn an_empty_pixel_before_ground_without_splats_is_not_completed() {
        let (before, alpha) = (plane(|x, y| lit(arm(x, y))), plane(|x, y| lit(arm(x, y))));
        let mut certainty = before.clone();
        let missing = complete(&mut certainty, &alpha, &mask(|_, y| y < 40));
        assert!(certainty == before && missing.iter().all(|l| *l == 0.0));
    }

    #[test]
    fn what_is_no_number_completes_nothing() {
        let mut alpha = plane(|x, y| lit(arm(x, y)));
        alpha.data[170 * SIZE.0 + 120] = f32::NAN;
        let mut certainty = plane(|x, y| lit(arm(x, y)));
        let missing = complete(&mut certainty, &alpha, &mask(|x, y| !arm(x, y) && !flame(x, y)));
        assert!(certainty.data.iter().chain(&missing).all(|v| v.is_finite()));
    }
}
