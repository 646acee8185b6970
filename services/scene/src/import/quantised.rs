//! Numbers that packed formats store in a few bits.

use crate::logit;

/// The logit of an opacity that was stored in a byte: half a step in from the ends, so that it is finite.
pub(super) fn stored_logit(opacity: f32) -> f32 {
    logit(opacity.clamp(0.5 / 255.0, 254.5 / 255.0))
}

/// Four components of length 1, of which the largest is not stored.
pub(super) fn with_largest(largest: usize, others: [f32; 3]) -> [f32; 4] {
    let rest = (1.0 - others.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt();
    let mut others = others.into_iter();
    std::array::from_fn(|k| if k == largest { rest } else { others.next().unwrap_or_default() })
}
