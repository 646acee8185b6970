//! Rotations as the formats want them.

/// A unit quaternion (x, y, z, w) of (w, x, y, z); the identity for one that is none.
pub(super) fn unit_rotation([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    let length = (w * w + x * x + y * y + z * z).sqrt();
    if length > 0.0 && length.is_finite() { [x, y, z, w].map(|v| v / length) } else { [0.0, 0.0, 0.0, 1.0] }
}
