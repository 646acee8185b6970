//! Compression: what it keeps, what it refuses.

use crate::support::{cosine, noise};
use proptest::prelude::*;
use segwild_features::{EmbeddingSamples, FeatureError, Pca};
use segwild_scene::{Embedding, Image, Mask};

/// Samples in a `rank`-dimensional plane of `e` dimensions, off the origin, with falling spread.
fn plane(n: usize, e: usize, rank: usize, unit: f32) -> Vec<f32> {
    let mut random = noise(7);
    let axes: Vec<f32> = (0..rank * e).map(|_| random()).collect();
    let mut samples = Vec::new();
    for _ in 0..n {
        let channels_at: Vec<f32> = (0..rank).map(|k| random() * 2.0 / (k + 1) as f32).collect();
        for j in 0..e {
            let v: f32 = (0..rank).map(|k| channels_at[k] * axes[k * e + j]).sum();
            samples.push(unit * (v + 3.0 + j as f32 * 0.1));
        }
    }
    samples
}

fn as_embedding(samples: &[f32], e: usize, width: usize) -> Embedding {
    let n = samples.len() / e;
    let mut data = vec![0.0; samples.len()];
    for i in 0..n {
        for j in 0..e {
            data[j * n + i] = samples[i * e + j];
        }
    }
    Embedding { width, height: n / width, channels: e, data }
}

#[test]
fn a_plane_is_kept_whole_and_found_again() {
    for unit in [1e-4, 1.0, 1e4] {
        let samples = plane(600, 40, 5, unit);
        let pca = Pca::fit(&samples, 40, 16, 1.0).unwrap();
        assert_eq!(pca.channels, 5, "no component for rounding: {:?}", pca.variances);
        assert!(pca.explained_variance() > 0.9999);
        let embedding = as_embedding(&samples, 40, 30);
        let compressed = pca.encode("photo", &embedding).unwrap();
        let back = pca.decoder().decode(&compressed).unwrap();
        let off = back.data.iter().zip(&embedding.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-4 * unit * 5.0, "{unit}: {off}");
        // Compressed vectors are centred and of mean squared length 1, whatever the embedding's unit.
        let n = compressed.pixels() as f32;
        let square: f32 = compressed.data.iter().map(|v| v * v).sum::<f32>() / n;
        assert!((square - 1.0).abs() < 1e-3, "{square}");
        assert!((0..5).all(|k| (compressed.plane(k).iter().sum::<f32>() / n).abs() < 1e-3));
        // Not whitened: the spreads fall as the variances do, and channels are not correlated.
        for k in 0..5 {
            let variance = compressed.plane(k).iter().map(|v| v * v).sum::<f32>() / n;
            let expected = pca.variances[k] / pca.variances.iter().sum::<f32>();
            assert!((variance - expected).abs() < 1e-3, "{k}: {variance} {expected}");
            for j in 0..k {
                let both: f32 =
                    compressed.plane(k).iter().zip(compressed.plane(j)).map(|(a, b)| a * b).sum::<f32>() / n;
                assert!(both.abs() < 1e-3);
            }
        }
        assert!(pca.variances.is_sorted_by(|a, b| a >= b));
    }
}

#[test]
fn fewer_channels_serve_when_they_keep_enough() {
    let samples = plane(600, 40, 8, 1.0);
    let all = Pca::fit(&samples, 40, 64, 1.0).unwrap();
    assert_eq!(all.channels, 8, "an embedding has what it has");
    let some = Pca::fit(&samples, 40, 64, 0.9).unwrap();
    assert!(some.channels < 8 && some.explained_variance() >= 0.9, "{}", some.channels);
    let fewer = Pca::fit(&samples, 40, some.channels - 1, 1.0).unwrap();
    assert!(fewer.explained_variance() < 0.9);
    assert_eq!(Pca::fit(&samples, 40, 3, 1.0).unwrap().channels, 3);
}

#[test]
fn samples_come_from_trusted_cells_and_do_not_depend_on_chance() {
    let embedding = as_embedding(&plane(600, 6, 3, 1.0), 6, 30);
    // The right third is sky, the left third distrusted; both are far from the rest.
    let mut poisoned = embedding.clone();
    for (i, v) in poisoned.data.iter_mut().enumerate() {
        if !(10..20).contains(&(i % 30)) {
            *v = 1e6;
        }
    }
    let mut validity = Image::filled(60, 40, 1, 1.0);
    (0..2400).filter(|i| i % 60 < 20).for_each(|i| validity.data[i] = 0.5);
    let sky = Mask::from_fn(15, 10, |x, _| x >= 10);
    let draw = |seed| {
        let mut samples = EmbeddingSamples::new(100, 2, seed);
        samples.add(0, "a", &poisoned, Some(&validity), Some(&sky)).unwrap();
        samples.add(1, "b", &poisoned, Some(&validity), Some(&sky)).unwrap();
        samples
    };
    assert_eq!(draw(1).len(), 100);
    let pca = draw(1).fit(6, 1.0).unwrap();
    assert!(pca.mean.iter().all(|m| m.abs() < 100.0), "{:?}", pca.mean);
    assert_eq!(pca, draw(1).fit(6, 1.0).unwrap());
    assert_ne!(pca, draw(2).fit(6, 1.0).unwrap());
    // A photo with fewer cells than its share gives all it has.
    let mut wide = EmbeddingSamples::new(1_000_000, 1, 0);
    wide.add(0, "a", &embedding, None, None).unwrap();
    assert_eq!(wide.len(), 600);
}

#[test]
fn what_cannot_be_compressed_is_refused_in_words() {
    let good = as_embedding(&plane(60, 4, 2, 1.0), 4, 10);
    let mut samples = EmbeddingSamples::new(100, 2, 0);
    assert!(matches!(EmbeddingSamples::new(100, 2, 0).fit(4, 1.0), Err(FeatureError::NoSamples)));
    for poison in [f32::NAN, f32::INFINITY] {
        let mut bad = good.clone();
        bad.data[2 * 60 + 37] = poison;
        let error = samples.add(0, "IMG_7.jpg", &bad, None, None).unwrap_err().to_string();
        assert!(error.contains("IMG_7.jpg") && error.contains("channel 2 at cell (7, 3)"), "{error}");
        let pca = Pca::fit(&plane(60, 4, 2, 1.0), 4, 2, 1.0).unwrap();
        assert_eq!(pca.encode("IMG_7.jpg", &bad).unwrap_err().to_string(), error);
    }
    let short = Embedding { data: vec![0.0; 5], ..good.clone() };
    let error = samples.add(0, "short.jpg", &short, None, None).unwrap_err().to_string();
    assert!(error.contains("short.jpg") && error.contains("5 values"), "{error}");
    samples.add(0, "a", &good, None, None).unwrap();
    let other = as_embedding(&plane(60, 5, 2, 1.0), 5, 10);
    assert!(matches!(samples.add(1, "b", &other, None, None), Err(FeatureError::Shape(_))));
    for value in [0.0f32, 1.0, -7.3e5] {
        let flat = Pca::fit(&[value; 400], 4, 2, 1.0);
        assert!(matches!(flat, Err(FeatureError::Flat)), "{value}: {flat:?}");
    }
    let mut nowhere = EmbeddingSamples::new(100, 1, 0);
    nowhere.add(0, "a", &good, Some(&Image::zeros(3, 3, 1)), None).unwrap();
    assert!(matches!(nowhere.fit(4, 1.0), Err(FeatureError::NoSamples)));
    assert!(Pca::fit(&[1.0; 7], 4, 2, 1.0).is_err());
    assert!(Pca::fit(&[1.0; 8], 0, 2, 1.0).is_err());
    assert!(Pca::fit(&[1.0, 2.0, 3.0, 5.0], 2, 0, 1.0).is_err());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn more_channels_never_keep_less_and_cosines_survive(e in 2usize..24, n in 30usize..200, seed in 0u32..99) {
        let mut random = noise(seed);
        let samples: Vec<f32> = (0..n * e).map(|_| random()).collect();
        let mut before = 0.0;
        for c in 1..=e {
            let kept = Pca::fit(&samples, e, c, 1.0).unwrap().explained_variance();
            prop_assert!(kept >= before - 1e-6 && kept <= 1.0);
            before = kept;
        }
        prop_assert!(before > 0.999, "all channels keep all: {}", before);
        // With all channels, compressed vectors are the centred embedding turned and scaled: cosines are unchanged.
        let pca = Pca::fit(&samples, e, e, 1.0).unwrap();
        let compressed = pca.encode("p", &as_embedding(&samples[..2 * e], e, 2)).unwrap();
        let channels_at = |x: usize| -> Vec<f32> { (0..pca.channels).map(|k| compressed.at(k, x, 0)).collect() };
        let centred = |i: usize| -> Vec<f32> { (0..e).map(|j| samples[i * e + j] - pca.mean[j]).collect() };
        let (a, b) = (cosine(&channels_at(0), &channels_at(1)), cosine(&centred(0), &centred(1)));
        prop_assert!((a - b).abs() < 1e-3, "{} {}", a, b);
    }
}
