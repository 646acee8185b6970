//! Values of pixels that have 8 or 16 bits.

use crate::Image;

/// A pixel as files store it.
pub(crate) trait PixelBits: Copy {
    /// Its value in [0, 1], in the arithmetic of decoding.
    fn value(self) -> f32;

    /// The pixel nearest to a value.
    fn nearest(value: f32) -> Self;

    /// The pixel that has this value, if there is one.
    fn of(value: f32) -> Option<Self> {
        Some(Self::nearest(value)).filter(|pixel| pixel.value().to_bits() == value.to_bits())
    }
}

impl PixelBits for u8 {
    fn value(self) -> f32 {
        f32::from(self) / 255.0
    }

    fn nearest(value: f32) -> u8 {
        (value * 255.0).round() as u8
    }
}

impl PixelBits for u16 {
    fn value(self) -> f32 {
        f32::from(self) / 65535.0
    }

    fn nearest(value: f32) -> u16 {
        (value * 65535.0).round() as u16
    }
}

/// The image with each value that of the nearest pixel of the bits that `taken`, which it was made of, has; of 16 where it has others.
pub(crate) fn with_bits_of(taken: &Image, mut image: Image) -> Image {
    let eight = taken.data.iter().all(|&v| u8::of(v).is_some());
    let rounded = |v: f32| if eight { u8::nearest(v).value() } else { u16::nearest(v).value() };
    image.data.iter_mut().for_each(|v| *v = rounded(*v));
    image
}
