//! Loss and metrics against the definition in f64, and gradients against finite differences of it.

use crate::common::RasterTestRandom;
use segwild_objective::{photometric, psnr, ssim};
use segwild_scene::Image;

/// The loss from its definition: a full 2D window, zero beyond the frame.
fn loss(render: &[f64], target: &Image, weight: Option<&Image>, lambda: f64) -> f64 {
    let (w, h, pixels) = (target.width as i64, target.height as i64, target.pixels());
    let tap = |k: i64| (-(k * k) as f64 / 4.5).exp();
    let norm: f64 = (-5..=5).map(tap).sum();
    let scale = |p: usize| weight.map_or(1.0, |weight| f64::from(weight.data[p]));
    let (mut l1, mut similarity) = (0.0, 0.0);
    for c in 0..target.channels {
        for y in 0..h {
            for x in 0..w {
                let mut s = [0.0; 5];
                for dy in -5..=5 {
                    for dx in -5..=5 {
                        let (u, v) = (x + dx, y + dy);
                        if u >= 0 && v >= 0 && u < w && v < h {
                            let p = (v * w + u) as usize;
                            let g = tap(dx) * tap(dy) / (norm * norm);
                            let a = render[c * pixels + p] * scale(p);
                            let b = f64::from(target.data[c * pixels + p]) * scale(p);
                            for (s, v) in s.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                                *s += g * v;
                            }
                        }
                    }
                }
                let [ma, mb, aa, bb, ab] = s;
                let (c1, c2) = (1e-4, 9e-4);
                similarity += (2.0 * ma * mb + c1) * (2.0 * (ab - ma * mb) + c2)
                    / ((ma * ma + mb * mb + c1) * (aa - ma * ma + bb - mb * mb + c2));
                let p = (y * w + x) as usize;
                l1 += (render[c * pixels + p] - f64::from(target.data[c * pixels + p])).abs() * scale(p);
            }
        }
    }
    let n = render.len() as f64;
    (1.0 - lambda) * l1 / n + lambda * (1.0 - similarity / n)
}

fn positive(mut image: Image) -> Image {
    image.data.iter_mut().for_each(|v| *v = 0.5 + 0.5 * *v);
    image
}

#[test]
fn photometric_matches_definition_and_finite_differences() {
    let mut random = RasterTestRandom(3);
    for (width, height, weighted, lambda) in [(21, 13, false, 0.2), (16, 9, true, 0.5), (7, 3, true, 1.0)] {
        let render = positive(random.image(width, height, 2));
        let target = positive(random.image(width, height, 2));
        let weight = positive(random.image(width, height, 1));
        let weight = weighted.then_some(&weight);
        let (got, grad) = photometric(&render, &target, weight, lambda);
        let start: Vec<f64> = render.data.iter().map(|&v| f64::from(v)).collect();
        let at = |values: &[f64]| loss(values, &target, weight, f64::from(lambda));
        assert!((f64::from(got) - at(&start)).abs() < 1e-6, "{got} against {}", at(&start));
        let largest = grad.data.iter().fold(0f32, |m, v| m.max(v.abs()));
        for k in (0..start.len()).step_by(7) {
            let mut moved = start.clone();
            let step = 1e-6;
            moved[k] += step;
            let up = at(&moved);
            moved[k] -= 2.0 * step;
            let numeric = (up - at(&moved)) / (2.0 * step);
            let wrong = (f64::from(grad.data[k]) - numeric).abs();
            assert!(
                wrong < 2e-5 * f64::from(largest) + 1e-9,
                "pixel {k}: {} against {numeric}",
                grad.data[k]
            );
        }
    }
}

#[test]
fn metrics_know_equal_images_and_masks() {
    let mut random = RasterTestRandom(8);
    let image = positive(random.image(30, 20, 3));
    let mut other = image.clone();
    // Differences of 0.1 in the left third only.
    for (k, v) in other.data.iter_mut().enumerate() {
        if k % 30 < 10 {
            *v += 0.1;
        }
    }
    let side = |left: bool, reach: usize| {
        let mut mask = Image::zeros(30, 20, 1);
        for (k, v) in mask.data.iter_mut().enumerate() {
            *v = f32::from(if left { k % 30 < 10 } else { k % 30 >= 10 + reach });
        }
        mask
    };
    assert_eq!(psnr(&image, &image, None), f32::INFINITY);
    assert!((ssim(&image, &image, None) - 1.0).abs() < 1e-6);
    assert!((psnr(&image, &other, Some(&side(true, 0))) - 20.0).abs() < 1e-3);
    assert!((psnr(&image, &other, None) - (20.0 + 10.0 * 3f32.log10())).abs() < 1e-3);
    assert_eq!(psnr(&image, &other, Some(&side(false, 0))), f32::INFINITY);
    assert!((ssim(&image, &other, Some(&side(false, 5))) - 1.0).abs() < 1e-5);
    assert!(ssim(&image, &other, Some(&side(true, 0))) < 0.999);
    assert_eq!(ssim(&image, &other, Some(&Image::zeros(30, 20, 1))), 1.0);
}
