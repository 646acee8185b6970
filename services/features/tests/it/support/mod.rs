//! What several tests need.
#![allow(dead_code)] // each test file uses a part

use segwild_scene::{Mask, MaskSet, ScoredMask};

/// A deterministic stream of numbers in (-1, 1).
pub fn noise(seed: u32) -> impl FnMut() -> f32 {
    let mut state = u64::from(seed) * 2_654_435_761 + 1;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 40) as f32 / (1u64 << 23) as f32) - 1.0
    }
}

/// Masks with full scores.
pub fn set(width: u32, height: u32, masks: Vec<Mask>) -> MaskSet {
    let masks =
        masks.into_iter().map(|mask| ScoredMask { mask, predicted_iou: 1.0, stability: 1.0 }).collect();
    MaskSet { width, height, masks }
}

/// Cosine of two vectors.
pub fn cosine(a: &[f32], b: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum::<f64>();
    dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
}
