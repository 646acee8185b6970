//! Boundary strength of one view by the photo and by the geometry (method, section 13).

use segwild_raster::Frame;
use segwild_scene::Image;
use segwild_scene::statistics::upper_median;

/// Pixels between the samples of the second difference of inverse depth.
const DIFFERENCE_STEP: usize = 2;

/// Half width, in pixels, of the window whose largest inverse depth a second difference is relative to.
const LOCAL_WINDOW: usize = 2;

/// A relative second difference of this many times its median, `b_0` more, is half way `b_h` to an occlusion (method, section
/// 13): the median is the noise of a surface. By choice. IoU by half, half more: 0, -.100 on `sacre_coeur`; 0, 0 on the demo.
const NOISE_FACTOR: f32 = 6.0;

/// Least relative second difference `b_0` that counts as one (method, section 13). By choice. Half and half more changed no
/// measured click.
const MIN_BEND: f32 = 0.03;

/// Accumulated alpha `A` from which a pixel has a depth (method, section 13). By choice. Half and half more changed no measured
/// click.
const MIN_DEPTH_ALPHA: f32 = 0.5;

/// A map of strengths, whoever it is from, in [0, 1]: what is no number is none.
pub fn bounded(strengths: &Image) -> Image {
    let bounded = |x: &f32| if x.is_finite() { x.clamp(0.0, 1.0) } else { 0.0 };
    let data = strengths.plane(0).iter().map(bounded).collect();
    Image { width: strengths.width, height: strengths.height, channels: 1, data }
}

/// Where the geometry of a view has an edge, in [0, 1]: one plane. Inverse depth is linear on planes, so its second difference
/// is 0 there, whatever the slant; it is compared with the largest inverse depth around, and with its own noise. Where splats
/// end, inverse depth falls to 0 with their opacity, which is an occlusion too. `frame` is the blend of inverse depths.
pub fn depth_edges(frame: &Frame) -> Image {
    let (inverse, alpha) = (&frame.image, &frame.alpha);
    let (w, h) = (inverse.width, inverse.height);
    let smooth = blurred(inverse.plane(0), w, h);
    let at = |x: isize, y: isize| {
        smooth[y.clamp(0, h as isize - 1) as usize * w + x.clamp(0, w as isize - 1) as usize]
    };
    let mut relative = vec![0.0f32; w * h];
    for y in 0..h as isize {
        for x in 0..w as isize {
            let (s, local) = (DIFFERENCE_STEP as isize, LOCAL_WINDOW as isize);
            // A side that lies outside the frame says nothing.
            let bend = |dx: isize, dy: isize| {
                let inside = x >= dx && y >= dy && x + dx < w as isize && y + dy < h as isize;
                let sides = at(x - dx, y - dy) + at(x + dx, y + dy);
                if inside { (sides - 2.0 * at(x, y)).abs() } else { 0.0 }
            };
            let bend = bend(s, 0).max(bend(0, s));
            let around = (-local..=local).flat_map(|dy| (-local..=local).map(move |dx| (dx, dy)));
            let largest = around.map(|(dx, dy)| at(x + dx, y + dy)).fold(0.0, f32::max);
            let bend = if largest > 1e-9 { bend / largest } else { 0.0 };
            relative[y as usize * w + x as usize] = if bend.is_finite() { bend } else { 0.0 };
        }
    }
    let solid =
        relative.iter().zip(alpha.plane(0)).filter(|(_, a)| **a > MIN_DEPTH_ALPHA).map(|(r, _)| *r).collect();
    let noise = upper_median(solid).unwrap_or(0.0);
    let half = NOISE_FACTOR * noise + MIN_BEND;
    let data = relative.iter().map(|r| 1.0 - (-(r / half).powi(2)).exp()).collect();
    Image { width: w, height: h, channels: 1, data }
}

/// A small blur, so that the rims of single splats are no edges: weights 1, 4, 1 of 6 in each direction (a Gaussian of .58 px).
fn blurred(plane: &[f32], w: usize, h: usize) -> Vec<f32> {
    let three = |a: f32, b: f32, c: f32| (a + 4.0 * b + c) / 6.0;
    let mut rows = vec![0.0; w * h];
    for y in 0..h {
        for x in 0..w {
            let at = |x: usize| plane[y * w + x];
            rows[y * w + x] = three(at(x.saturating_sub(1)), at(x), at((x + 1).min(w - 1)));
        }
    }
    let mut out = vec![0.0; w * h];
    for y in 0..h {
        for x in 0..w {
            let at = |y: usize| rows[y * w + x];
            out[y * w + x] = three(at(y.saturating_sub(1)), at(y), at((y + 1).min(h - 1)));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 60;

    fn edges(inverse: impl Fn(f32, f32) -> f32, alpha: f32) -> Image {
        let plane = |f: &dyn Fn(f32, f32) -> f32| Image {
            width: SIZE,
            height: SIZE,
            channels: 1,
            data: (0..SIZE * SIZE).map(|i| f((i % SIZE) as f32, (i / SIZE) as f32)).collect(),
        };
        depth_edges(&Frame { image: plane(&inverse), alpha: plane(&|_, _| alpha) })
    }

    fn at(map: &Image, x: usize, y: usize) -> f32 {
        map.data[y * SIZE + x]
    }

    #[test]
    fn a_slanted_plane_has_no_edge_and_a_box_before_it_has_its_outline() {
        let plane = |x: f32, y: f32| 0.2 + 0.004 * x + 0.001 * y;
        let flat = edges(plane, 1.0);
        assert!(flat.data.iter().all(|&e| e < 0.05), "{:?}", flat.data.iter().fold(0.0f32, |m, &e| m.max(e)));
        let boxed = |x: f32, y: f32| {
            if (20.0..40.0).contains(&x) && (20.0..40.0).contains(&y) { 1.0 } else { plane(x, y) }
        };
        let map = edges(boxed, 1.0);
        assert!(at(&map, 20, 30) > 0.9 && at(&map, 30, 39) > 0.9);
        assert!(at(&map, 30, 30) < 0.05 && at(&map, 5, 5) < 0.05);
    }

    /// Units of the scene must not matter.
    #[test]
    fn a_scene_a_thousand_times_as_large_has_the_same_edges() {
        let scene = |scale: f32| edges(move |x, _| if x < 30.0 { 0.5 / scale } else { 0.9 / scale }, 1.0);
        let (small, large) = (scale_free(&scene(1.0)), scale_free(&scene(1000.0)));
        assert_eq!(small, large);
    }

    fn scale_free(map: &Image) -> Vec<i32> {
        map.data.iter().map(|e| (e * 1000.0).round() as i32).collect()
    }

    #[test]
    fn what_is_no_number_is_no_edge() {
        let map = edges(|x, y| if (x, y) == (30.0, 30.0) { f32::NAN } else { 0.5 }, 1.0);
        assert!(map.data.iter().all(|e| e.is_finite()));
        let nothing = edges(|_, _| 0.0, 0.0);
        assert!(nothing.data.iter().all(|&e| e == 0.0));
    }

    #[test]
    fn strengths_that_are_no_numbers_or_too_large_are_bounded() {
        let map = Image { data: vec![f32::NAN, -1.0, 0.5, 7.0], ..Image::zeros(4, 1, 1) };
        assert_eq!(bounded(&map).data, [0.0, 0.0, 0.5, 1.0]);
    }
}
