//! The CPU engine against the f64 reference, and the reference against finite differences of itself.

use crate::common::{RasterTestRandom, error, splats, view};
use segwild_raster::reference::{Parameters, Reference, shade};
use segwild_raster::{Channels, CpuEngine, FrameGrad, ProjectOptions, Rasterizer};
use segwild_scene::{Camera, Image, Pose, Splats};

fn flat<const N: usize>(rows: &[[f32; N]]) -> Vec<f32> {
    rows.as_flattened().to_vec()
}

fn flat64<const N: usize>(rows: &[[f64; N]]) -> Vec<f64> {
    rows.as_flattened().to_vec()
}

fn zero_unsure(image: &mut Image, unsure: &[bool]) {
    let pixels = image.pixels();
    for (k, v) in image.data.iter_mut().enumerate() {
        if unsure[k % pixels] {
            *v = 0.0;
        }
    }
}

fn compare(splats: &Splats, camera: &Camera, pose: &Pose, options: ProjectOptions, count: usize, seed: u64) {
    let mut random = RasterTestRandom(seed);
    let values = random.many(splats.len() * count, -1.0, 1.0);
    let values64: Vec<f64> = values.iter().map(|&v| f64::from(v)).collect();
    let parameters = Parameters::of(splats);
    let reference = Reference { camera: *camera, pose: *pose, options, cutoffs: true };
    let wanted = reference.render(&parameters, &values64, count);

    let engine = CpuEngine::new();
    let projected = engine.project(splats, camera, pose, &options).unwrap();
    let channels = Channels { count, values: &values };
    let frame = projected.blend(&channels).unwrap();
    let pixels = frame.alpha.pixels();
    let sure = |k: usize| !wanted.unsure[k % pixels];
    assert!(
        wanted.unsure.iter().filter(|&&u| u).count() * 4 < pixels,
        "too few pixels are away from cut-offs"
    );
    let pick = |data: &[f32], from: &[f64]| {
        error(
            data.iter().enumerate().filter(|(k, _)| sure(*k)).map(|(_, &v)| v),
            from.iter().enumerate().filter(|(k, _)| sure(*k)).map(|(_, &v)| v),
        )
    };
    let (image, alpha) = (pick(&frame.image.data, &wanted.image), pick(&frame.alpha.data, &wanted.alpha));
    assert!(image < 2e-5 && alpha < 2e-5, "image {image:e}, alpha {alpha:e}");

    let mut grad_image = random.image(frame.image.width, frame.image.height, count);
    let mut grad_alpha = random.image(frame.image.width, frame.image.height, 1);
    zero_unsure(&mut grad_image, &wanted.unsure);
    zero_unsure(&mut grad_alpha, &wanted.unsure);
    let got = projected
        .backward(&channels, &frame, &FrameGrad { image: &grad_image, alpha: Some(&grad_alpha) })
        .unwrap();
    let as64 = |image: &Image| image.data.iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
    let wanted = reference.backward(&parameters, &values64, count, &as64(&grad_image), &as64(&grad_alpha));
    let errors = [
        ("values", error(got.values, wanted.values)),
        ("opacities", error(got.opacities, wanted.parameters.opacities)),
        ("means", error(flat(&got.means), flat64(&wanted.parameters.means))),
        ("log_scales", error(flat(&got.log_scales), flat64(&wanted.parameters.log_scales))),
        ("rotations", error(flat(&got.rotations), flat64(&wanted.parameters.rotations))),
        ("screen", error(got.screen, wanted.screen)),
        ("screen_abs", error(got.screen_abs, wanted.screen_abs)),
    ];
    for (name, error) in errors {
        assert!(error < 1e-4, "{name}: {error:e} of {errors:?}");
    }
}

#[test]
fn engine_matches_reference() {
    for (seed, count, sizes) in [
        (1, 1, (0.02, 0.2)),
        (2, 3, (0.01, 0.1)),
        (3, 4, (0.003, 0.3)),
        (4, 7, (0.02, 0.1)),
        (5, 20, (0.01, 0.05)),
    ] {
        let splats = splats(&mut RasterTestRandom(seed), 120, sizes, 0);
        let (camera, pose) = view(53, 41);
        compare(&splats, &camera, &pose, ProjectOptions::default(), count, seed);
        let antialias = ProjectOptions { antialias: true, low_pass: 0.2, ..ProjectOptions::default() };
        compare(&splats, &camera, &pose, antialias, count, seed);
    }
}

#[test]
fn reference_matches_its_finite_differences() {
    let mut random = RasterTestRandom(11);
    let (camera, pose) = view(24, 18);
    for antialias in [false, true] {
        let options = ProjectOptions { antialias, ..ProjectOptions::default() };
        let parameters = Parameters::of(&splats(&mut random, 12, (0.02, 0.2), 0));
        let reference = Reference { camera, pose, options, cutoffs: false };
        let values: Vec<f64> = random.many(24, -1.0, 1.0).into_iter().map(f64::from).collect();
        let weights: Vec<f64> = random.many(24 * 18 * 3, -1.0, 1.0).into_iter().map(f64::from).collect();
        let (on_image, on_alpha) = weights.split_at(24 * 18 * 2);
        let loss = |p: &Parameters, values: &[f64]| {
            let render = reference.render(p, values, 2);
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            dot(&render.image, on_image) + dot(&render.alpha, on_alpha)
        };
        let got = reference.backward(&parameters, &values, 2, on_image, on_alpha);
        let step = 1e-5;
        let mut pairs: Vec<(&str, f64, f64)> = Vec::new();
        for i in 0..12 {
            let mut central = |name: &'static str, analytic: f64, touch: &dyn Fn(&mut Parameters, f64)| {
                let at = |d: f64| {
                    let mut moved = parameters.clone();
                    touch(&mut moved, d);
                    loss(&moved, &values)
                };
                pairs.push((name, analytic, (at(step) - at(-step)) / (2.0 * step)));
            };
            for k in 0..3 {
                central("mean", got.parameters.means[i][k], &|p, d| p.means[i][k] += d);
                central("log scale", got.parameters.log_scales[i][k], &|p, d| p.log_scales[i][k] += d);
            }
            for k in 0..4 {
                central("rotation", got.parameters.rotations[i][k], &|p, d| p.rotations[i][k] += d);
            }
            central("opacity", got.parameters.opacities[i], &|p, d| p.opacities[i] += d);
            for k in i * 2..i * 2 + 2 {
                let at = |d: f64| {
                    let mut moved = values.clone();
                    moved[k] += d;
                    loss(&parameters, &moved)
                };
                pairs.push(("value", got.values[k], (at(step) - at(-step)) / (2.0 * step)));
            }
        }
        for (name, analytic, numeric) in pairs {
            let scale = 1.0 + analytic.abs();
            assert!((analytic - numeric).abs() < 1e-6 * scale, "{name}: {analytic} against {numeric}");
        }
    }
}

#[test]
fn colours_match_harmonics_and_their_finite_differences() {
    let (camera, pose) = view(64, 48);
    for degree in 0..=3 {
        let mut splats = splats(&mut RasterTestRandom(20 + u64::from(degree)), 40, (0.02, 0.1), degree);
        // Keep the colours clear of the clamp at 0, save for one splat far below it.
        splats.sh.iter_mut().for_each(|v| *v *= 0.15);
        let stride = splats.sh_stride();
        splats.sh[0] = -20.0;
        let engine = CpuEngine::new();
        let projected = engine.project(&splats, &camera, &pose, &ProjectOptions::default()).unwrap();
        let seen: Vec<usize> = (0..40).filter(|&i| projected.radii()[i] > 0.0).collect();
        assert!(seen.len() > 20);
        let parameters = Parameters::of(&splats);
        let (got, wanted) = (projected.shade(), shade(&parameters, &pose));
        for &i in &seen {
            for k in i * 3..i * 3 + 3 {
                assert!(
                    (f64::from(got[k]) - wanted[k]).abs() < 1e-5,
                    "degree {degree}: {} {}",
                    got[k],
                    wanted[k]
                );
            }
        }
        let weights = RasterTestRandom(5).many(120, -1.0, 1.0);
        let loss = |p: &Parameters| {
            let colours = shade(p, &pose);
            seen.iter()
                .flat_map(|&i| i * 3..i * 3 + 3)
                .map(|k| colours[k] * f64::from(weights[k]))
                .sum::<f64>()
        };
        let mut grads = segwild_raster::SplatGrads { means: vec![[0.0; 3]; 40], ..Default::default() };
        let sh = projected.shade_backward(&weights, &mut grads);
        let step = 1e-6;
        let check = |name: &str, got: f32, touch: &dyn Fn(&mut Parameters, f64)| {
            let at = |d: f64| {
                let mut moved = parameters.clone();
                touch(&mut moved, d);
                loss(&moved)
            };
            let numeric = (at(step) - at(-step)) / (2.0 * step);
            assert!(
                (f64::from(got) - numeric).abs() < 2e-5,
                "degree {degree}, {name}: {got} against {numeric}"
            );
        };
        for i in 0..40 {
            for k in 0..3 {
                check("mean", grads.means[i][k], &|p, d| p.means[i][k] += d);
            }
            for k in i * stride..(i + 1) * stride {
                check("sh", sh[k], &|p, d| p.sh[k] += d);
            }
        }
    }
}
