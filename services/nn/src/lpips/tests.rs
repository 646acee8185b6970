//! LPIPS against the Python package `lpips` 0.1.4 in f64 on PyTorch 2.15, with weights and images of a formula that both
//! programs compute: [`noise`].

use super::untrained::{TensorFile, noise, tensors};
use super::*;
use std::sync::LazyLock;

static OF_VGG: LazyLock<Lpips> = LazyLock::new(|| Lpips::parse(&LpipsNet::Vgg.untrained()).unwrap());
static OF_ALEX: LazyLock<Lpips> = LazyLock::new(|| Lpips::parse(&LpipsNet::Alex.untrained()).unwrap());

fn both() -> [&'static Lpips; 2] {
    [&OF_VGG, &OF_ALEX]
}

/// Two images that differ.
fn images(width: usize, height: usize) -> [Map; 2] {
    let of = |data: Vec<f32>| Map { channels: 3, height, width, data };
    let count = 3 * width * height;
    let render: Vec<f32> = noise(200, count).map(|v| 0.5 + 0.4 * v).collect();
    let mixed = render.iter().zip(noise(201, count)).map(|(a, v)| 0.6 * a + 0.4 * (0.5 + 0.5 * v)).collect();
    [of(render), of(mixed)]
}

/// What the package computes: size, distance, sum of the absolute gradient, some of its numbers.
type Known = ((usize, usize), f64, f64, [(usize, f64); 6]);

const OF_THE_PACKAGE: [(LpipsNet, [Known; 2]); 2] = [
    (
        LpipsNet::Vgg,
        [
            (
                (64, 48),
                0.136_753_800,
                1.566_908_288,
                [
                    (0, 3.58412876e-05),
                    (63, 5.13914962e-05),
                    (1568, 0.000175814375),
                    (9215, 2.52309888e-05),
                    (6582, 0.00011567065),
                    (3079, -0.000175639322),
                ],
            ),
            (
                (37, 29),
                0.139_494_629,
                1.527_013_427,
                [
                    (0, 0.000224954067),
                    (36, 4.59096087e-05),
                    (554, -0.000508380169),
                    (3218, 8.80892896e-05),
                    (2299, -0.000426531656),
                    (1080, 0.000136589617),
                ],
            ),
        ],
    ),
    (
        LpipsNet::Alex,
        [
            (
                (64, 48),
                0.154_903_718,
                4.271_424_550,
                [
                    (0, 0.000289902434),
                    (63, 6.77710301e-05),
                    (1568, -0.00151022681),
                    (9215, -4.26374936e-05),
                    (6582, 0.000425448295),
                    (3079, -0.000286012779),
                ],
            ),
            (
                (71, 53),
                0.150_322_728,
                3.979_688_375,
                [
                    (0, 0.00015730403),
                    (70, 1.02587957e-07),
                    (1916, 0.000102300131),
                    (11288, 4.86758369e-05),
                    (8063, 0.000736734639),
                    (3770, -0.000465751662),
                ],
            ),
        ],
    ),
];

#[test]
fn distances_and_gradients_are_those_of_the_python_package() {
    for ((net, known), lpips) in OF_THE_PACKAGE.iter().zip(both()) {
        assert_eq!(lpips.net(), *net);
        for ((width, height), distance, sum, numbers) in known {
            let [render, target] = images(*width, *height);
            let (got, grad) = lpips.gradient(&render, &target).unwrap();
            assert!((got - distance).abs() < 1e-6, "{net} {width}x{height}: {got}, not {distance}");
            assert_eq!(lpips.distance(&render, &target), Some(got));
            let total: f64 = grad.data.iter().map(|g| f64::from(g.abs())).sum();
            assert!((total / sum - 1.0).abs() < 1e-4, "{net} {width}x{height}: {total}, not {sum}");
            for (k, wanted) in numbers {
                let got = f64::from(grad.data[*k]);
                assert!(
                    (got - wanted).abs() < 5e-8,
                    "{net} {width}x{height}, number {k}: {got}, not {wanted}"
                );
            }
        }
    }
}

#[test]
fn the_gradient_is_the_slope_of_the_distance() {
    for lpips in both() {
        let [render, target] = images(45, 61);
        let (_, grad) = lpips.gradient(&render, &target).unwrap();
        let direction: Vec<f32> = noise(300, render.data.len()).collect();
        let moved = |by: f32| {
            let data = render.data.iter().zip(&direction).map(|(v, d)| v + by * d).collect();
            lpips.distance(&Map { data, ..render.clone() }, &target).unwrap()
        };
        let step = 1e-3;
        let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        let along: f64 = grad.data.iter().zip(&direction).map(|(g, d)| f64::from(g * d)).sum();
        let size: f64 = grad.data.iter().map(|g| f64::from(g * g)).sum::<f64>().sqrt();
        assert!((slope - along).abs() < 0.02 * size, "{}: {slope}, not {along}; of {size}", lpips.net());
    }
}

#[test]
fn equal_images_have_no_distance_and_the_order_of_two_does_not_matter() {
    for lpips in both() {
        let [render, target] = images(64, 40);
        let (none, grad) = lpips.gradient(&render, &render).unwrap();
        assert_eq!(none, 0.0);
        assert!(grad.data.iter().all(|g| *g == 0.0));
        let there = lpips.distance(&render, &target).unwrap();
        assert_eq!(lpips.distance(&target, &render), Some(there));
        let half: Vec<f32> = render.data.iter().zip(&target.data).map(|(a, b)| 0.5 * (a + b)).collect();
        let nearer = lpips.distance(&render, &Map { data: half, ..render.clone() }).unwrap();
        assert!(0.0 < nearer && nearer < there, "{}: {nearer} {there}", lpips.net());
    }
}

#[test]
fn a_large_image_in_parts_has_the_distance_and_the_gradient_of_the_whole() {
    for (lpips, (width, height)) in both().into_iter().zip([(131, 57), (263, 149)]) {
        let [render, target] = images(width, height);
        let run = |limits| lpips.in_parts([&render, &target], true, limits).unwrap();
        let (whole, grad) = run((usize::MAX, 16));
        let (in_parts, of_parts) = run((0, 32));
        assert!((whole - in_parts).abs() < 1e-9, "{}: {whole} {in_parts}", lpips.net());
        let [grad, of_parts] = [grad, of_parts].map(Option::unwrap);
        let most = grad.data.iter().zip(&of_parts.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(most < 1e-8, "{}: {most}", lpips.net());
    }
}

#[test]
fn the_same_bytes_whatever_the_thread_count() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            both().map(|lpips| {
                let [render, target] = images(70, 50);
                let (distance, grad) = lpips.gradient(&render, &target).unwrap();
                (distance.to_bits(), grad.data.iter().map(|g| g.to_bits()).collect::<Vec<u32>>())
            })
        })
    };
    assert!(run(1) == run(3));
}

#[test]
fn numbers_that_are_none_and_images_without_detail_end_in_finite_gradients() {
    for lpips in both() {
        let [render, target] = images(48, 40);
        for poison in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, f32::MIN_POSITIVE / 4.0] {
            for k in [0, 48 * 40 + 7, render.data.len() - 1] {
                let mut poisoned = render.clone();
                poisoned.data[k] = poison;
                let (_, grad) = lpips.gradient(&poisoned, &target).unwrap();
                assert!(grad.data.iter().all(|g| g.is_finite()), "{} {poison}", lpips.net());
                lpips.distance(&target, &poisoned).unwrap();
            }
        }
        let mut poisoned = render.clone();
        poisoned.data[100] = f32::NAN;
        assert!(lpips.distance(&poisoned, &target).unwrap().is_nan(), "a score of NaN is none");
        let flat = Map { data: vec![0.5; render.data.len()], ..render.clone() };
        let (distance, grad) = lpips.gradient(&flat, &target).unwrap();
        assert!(distance > 0.0 && grad.data.iter().all(|g| g.is_finite()));
    }
}

#[test]
fn images_that_leave_no_features_have_no_distance() {
    for (lpips, least) in both().into_iter().zip([16, 31]) {
        let of = |width, height| {
            let [render, target] = images(width, height);
            lpips.gradient(&render, &target).map(|(distance, _)| distance)
        };
        assert!(of(least, least).is_some_and(|d| d > 0.0), "{}", lpips.net());
        assert!(of(least - 1, 64).is_none() && of(64, least - 1).is_none() && of(0, 0).is_none());
        assert!(lpips.net().fits(least, 1000) && !lpips.net().fits(1000, least - 1));
    }
}

#[test]
fn a_file_that_is_not_whole_is_refused_with_the_tensor_that_is_wrong() {
    let good = tensors(LpipsNet::Alex);
    let refused = |file: &TensorFile| Lpips::parse(&file.bytes()).unwrap_err().to_string();
    let without = |key: &str| {
        let mut file = good.clone();
        file.entries.retain(|entry| !entry.starts_with(&format!("\"{key}\"")));
        refused(&file)
    };
    for key in ["lin3.model.1.weight", "net.slice1.0.bias", "net.slice4.8.weight", "scaling_layer.shift"] {
        let message = without(key);
        assert!(message.contains(&format!("`{key}` is missing")), "{message}");
    }
    assert!(without("net.slice5.10.weight").contains("neither"));
    // `safetensors.torch.save_model` keeps one of the two names that the package has for a head.
    let renamed = good.entries.iter().map(|entry| entry.replace("\"lin2.model", "\"lins.2.model")).collect();
    assert!(Lpips::parse(&TensorFile { entries: renamed, ..good.clone() }.bytes()).is_ok());
    let cut = TensorFile { data: good.data[..good.data.len() - 30].to_vec(), ..good.clone() };
    assert!(refused(&cut).contains("`scaling_layer.shift` are not in the file"), "{}", refused(&cut));
    let changed = |from: &str, to: &str| {
        let entries = good.entries.iter().map(|entry| entry.replace(from, to)).collect();
        refused(&TensorFile { entries, ..good.clone() })
    };
    assert!(changed("[64, 3, 11, 11]", "[64, 3, 121]").contains("has the shape [64, 3, 121]"));
    let mut negative = good.clone();
    negative.data[3] |= 0x80; // the sign of the first head's first weight
    assert!(refused(&negative).contains("number 0 of tensor `lin0.model.1.weight` is -"));
    let mut zero = good.clone();
    let at = zero.data.len() - 24;
    zero.data[at..at + 4].fill(0);
    assert!(refused(&zero).contains("number 0 of tensor `scaling_layer.scale` is 0"), "{}", refused(&zero));
}
