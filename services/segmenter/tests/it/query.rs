//! Similarities against an f64 reference, and hostile features.

use proptest::prelude::*;
use segwild_raster::CpuEngine;
use segwild_segmenter::{ClickHit, SegmentError, SplatFeatures};

fn reference(row: &[f32], clicks: &[Vec<f32>], temperature: f64) -> f64 {
    let norm = |v: &[f32]| v.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>().sqrt();
    let s: Vec<f64> = clicks
        .iter()
        .map(|c| {
            c.iter().zip(row).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum::<f64>() / norm(c) / norm(row)
        })
        .collect();
    let w: Vec<f64> = s.iter().map(|s| (s / temperature).exp()).collect();
    s.iter().zip(&w).map(|(s, w)| s * w).sum::<f64>() / w.iter().sum::<f64>()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn similarity_is_the_formula(
        channels in 1usize..70,
        seed in proptest::collection::vec(-1.0f32..1.0, 400),
        clicks in 1usize..5,
        temperature in 0.05f32..3.0,
    ) {
        let value = |i: usize| seed[(i * 7 + i / 400) % 400] + 0.01;
        let rows = 5;
        let values: Vec<f32> = (0..rows * channels).map(value).collect();
        let clicks: Vec<Vec<f32>> = (0..clicks).map(|c| (0..channels).map(|k| value(1000 + c * 131 + k)).collect()).collect();
        let field = SplatFeatures::new(channels, values).unwrap();
        let got = field.similarity(&CpuEngine::new(), &clicks, temperature).unwrap();
        for i in 0..rows {
            let want = reference(&field.row(i), &clicks, f64::from(temperature));
            prop_assert!((f64::from(got[i]) - want).abs() < 1e-4 + 1e-4 / f64::from(temperature), "{} for {}", got[i], want);
        }
    }
}

#[test]
fn features_are_kept_in_16_bits_and_cosines_are_those_of_the_rounded_numbers() {
    let values: Vec<f32> = (0..40 * 33).map(|i| ((i * 7919 % 1013) as f32 - 500.0) * 1e-3).collect();
    let field = SplatFeatures::new(33, values.clone()).unwrap();
    assert_eq!(field.bytes(), 40 * (2 * 33 + 4));
    let rounded = field.values();
    assert!(rounded.iter().zip(&values).all(|(a, b)| (a - b).abs() <= b.abs() / 2048.0));
    let again = SplatFeatures::new(33, rounded).unwrap();
    assert_eq!(again.values(), field.values(), "rounding twice is rounding once");
    for i in 1..field.len() {
        let want = reference(&field.row(0), &[field.row(i)], 1.0);
        assert!((f64::from(field.cosine(0, i)) - want).abs() < 1e-5, "{want}");
    }
}

#[test]
fn the_unit_of_a_field_changes_nothing() {
    let values: Vec<f32> = (0..60 * 16).map(|i| ((i * 7919 % 1013) as f32 - 500.0) * 1e-3).collect();
    let of = |factor: f32| SplatFeatures::new(16, values.iter().map(|v| v * factor).collect()).unwrap();
    let field = of(1.0);
    for factor in [1e6, 1e-6, 1e15, 1e-15] {
        let other = of(factor);
        for splat in 0..other.len() {
            let exact = values[16 * splat..].iter().map(|v| v * factor);
            assert!(other.row(splat).iter().zip(exact).all(|(a, b)| (a - b).abs() <= b.abs() / 2000.0));
            let (cosine, as_before) = (other.cosine(0, splat), field.cosine(0, splat));
            assert!((cosine - as_before).abs() < 1e-3, "{factor}: {cosine} for {as_before}");
        }
        let click = [other.row(1)];
        let similar = other.similarity(&CpuEngine::new(), &click, 0.1).unwrap();
        let as_before = field.similarity(&CpuEngine::new(), &[field.row(1)], 0.1).unwrap();
        assert!(similar.iter().zip(&as_before).all(|(a, b)| (a - b).abs() < 1e-3), "{factor}");
    }
}

#[test]
fn fused_similarity_is_at_least_the_mean_and_at_most_the_largest() {
    let field = SplatFeatures::new(2, vec![1.0, 0.0]).unwrap();
    let clicks = vec![vec![1.0, 0.0], vec![0.0, 1.0]];
    let at = |t| field.similarity(&CpuEngine::new(), &clicks, t).unwrap()[0];
    assert!((at(1e4) - 0.5).abs() < 1e-3 && (at(1e-3) - 1.0).abs() < 1e-6);
    let e = std::f32::consts::E;
    assert!((at(1.0) - e / (e + 1.0)).abs() < 1e-6);
}

#[test]
fn features_that_are_no_numbers_resemble_nothing() {
    let values = vec![1.0, 2.0, f32::NAN, 1.0, f32::INFINITY, 0.0, 0.0, 0.0, 1e30, 1e30, 1e-30, 0.0];
    let field = SplatFeatures::new(2, values).unwrap();
    let s = field.similarity(&CpuEngine::new(), &[vec![1.0, 2.0]], 0.1).unwrap();
    assert!((s[0] - 1.0).abs() < 1e-6 && s[1..].iter().all(|&s| s == 0.0), "{s:?}");
    // They spoil no click either.
    let hit = ClickHit { splats: vec![(0, 0.5), (1, 0.4)], alpha: 0.9 };
    assert_eq!(hit.feature(&field), Some(vec![1.0, 2.0]));
    assert_eq!(ClickHit { splats: vec![(1, 0.4), (3, 0.1)], alpha: 0.5 }.feature(&field), None);
}

#[test]
fn bad_queries_are_refused_with_a_sentence() {
    let field = SplatFeatures::new(2, vec![1.0, 2.0]).unwrap();
    let refusal =
        |clicks: &[Vec<f32>], t| field.similarity(&CpuEngine::new(), clicks, t).unwrap_err().to_string();
    assert!(refusal(&[vec![1.0]], 0.1).contains("2 channels"));
    assert!(refusal(&[vec![0.0, f32::NAN]], 0.1).contains("no usable feature"));
    assert!(refusal(&[vec![1.0, 0.0]], 0.0).contains("click_temperature"));
    assert!(matches!(field.similarity(&CpuEngine::new(), &[], 0.1), Err(SegmentError::NoPrompt)));
    assert!(SplatFeatures::new(0, vec![]).is_err() && SplatFeatures::new(3, vec![0.0; 4]).is_err());
}
