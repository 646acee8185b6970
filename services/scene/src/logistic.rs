//! The logistic function and its inverse: from logits, which may be any number, to opacities and probabilities, and back.

/// The opacity or probability of a logit, `1 / (1 + exp(-x))`, in [0, 1]. It rounds to 0 below about -88 and to 1 above about 17;
/// NaN stays NaN.
///
/// ```
/// use segwild_scene::sigmoid;
/// assert_eq!(sigmoid(0.0), 0.5);
/// assert_eq!([f32::NEG_INFINITY, f32::INFINITY].map(sigmoid), [0.0, 1.0]);
/// assert!(sigmoid(f32::NAN).is_nan());
/// ```
#[inline]
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

/// The logit of an opacity or probability, `ln(p / (1 - p))`: the logarithm of its odds. Infinite at 0 and 1; NaN outside of
/// [0, 1], and of NaN.
///
/// ```
/// use segwild_scene::{logit, sigmoid};
/// assert_eq!(logit(0.5), 0.0);
/// assert_eq!([0.0, 1.0].map(logit), [f32::NEG_INFINITY, f32::INFINITY]);
/// assert!(logit(1.5).is_nan());
/// assert!((logit(sigmoid(2.0)) - 2.0).abs() < 1e-5);
/// ```
#[inline]
pub fn logit(p: f32) -> f32 {
    (p / (1.0 - p)).ln()
}
