//! Values of pixels that have 8 bits.

use crate::Image;

/// The value of an 8-bit pixel in [0, 1], in the arithmetic of decoding.
pub(crate) fn value(byte: u8) -> f32 {
    f32::from(byte) / 255.0
}

/// The 8-bit pixel nearest to a value.
fn nearest(value: f32) -> u8 {
    (value * 255.0).round() as u8
}

/// The byte of a value, if it is that of an 8-bit pixel.
pub(crate) fn byte(of: f32) -> Option<u8> {
    Some(nearest(of)).filter(|&b| value(b).to_bits() == of.to_bits())
}

/// Whether all values are those of 8-bit pixels.
pub(crate) fn is_of_bytes(image: &Image) -> bool {
    image.data.iter().all(|&v| byte(v).is_some())
}

/// The image with each value that of the nearest 8-bit pixel.
pub(crate) fn to_bytes(mut image: Image) -> Image {
    image.data.iter_mut().for_each(|v| *v = value(nearest(*v)));
    image
}
