//! Numbers of 16 bits (IEEE 754 binary16): 11 significant bits, from 6e-8 to 65504.

/// 2^112, by which the biases of the exponents of 32 and 16 bits differ.
const BIAS: f32 = f32::from_bits(0x7780_0000);

/// Rounds to the nearest number of 16 bits, to the even one of two that are as near. From 65520 on that is infinity.
pub fn to_half(value: f32) -> u16 {
    let bits = value.to_bits();
    let sign = ((bits >> 16) & 0x8000) as u16;
    let magnitude = bits & 0x7fff_ffff;
    if magnitude > 0x7f80_0000 {
        return sign | 0x7e00;
    }
    if magnitude >= 0x477f_f000 {
        return sign | 0x7c00;
    }
    // Below 2^-14 numbers are multiples of 2^-24.
    if magnitude < 0x3880_0000 {
        return sign | (f32::from_bits(magnitude) * 16_777_216.0).round_ties_even() as u16;
    }
    let rounded = magnitude + 0x0fff + ((magnitude >> 13) & 1);
    sign | ((rounded - 0x3800_0000) >> 13) as u16
}

/// The same number in 32 bits. It has no branch, so that loops over it vectorise.
#[inline(always)]
pub fn from_half(bits: u16) -> f32 {
    // The product is exact below 2^-14, too.
    let magnitude = f32::from_bits(u32::from(bits & 0x7fff) << 13) * BIAS;
    let special = if bits & 0x7c00 == 0x7c00 { 0x7f80_0000 } else { 0 };
    f32::from_bits(magnitude.to_bits() | special | (u32::from(bits & 0x8000) << 16))
}

/// Whether a number of 16 bits is neither infinite nor no number.
pub fn is_finite(bits: u16) -> bool {
    bits & 0x7c00 != 0x7c00
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn numbers_of_16_bits_are_those_of_the_standard() {
        for (value, bits) in [
            (0.0, 0x0000),
            (-0.0, 0x8000),
            (1.0, 0x3c00),
            (-2.0, 0xc000),
            (65504.0, 0x7bff),
            (0.333_251_95, 0x3555),
            (6.103_515_6e-5, 0x0400),
            (5.960_464_5e-8, 0x0001),
            (f32::INFINITY, 0x7c00),
            (f32::NEG_INFINITY, 0xfc00),
        ] {
            assert_eq!((to_half(value), from_half(bits)), (bits, value), "{value}");
        }
        // Halfway, the even one is taken; beyond the largest there is only infinity.
        assert_eq!((to_half(1.0 + 1.0 / 2048.0), to_half(1.0 + 3.0 / 2048.0)), (0x3c00, 0x3c02));
        assert_eq!((to_half(65519.0), to_half(65520.0), to_half(1e30)), (0x7bff, 0x7c00, 0x7c00));
        assert_eq!((to_half(1e-10), to_half(-1e-10)), (0x0000, 0x8000));
        assert!(from_half(to_half(f32::NAN)).is_nan());
    }

    #[test]
    fn every_number_of_16_bits_survives() {
        for bits in 0..=u16::MAX {
            let value = from_half(bits);
            assert_eq!(value.is_nan(), bits & 0x7fff > 0x7c00, "{bits:#06x} is {value}");
            assert!(value.is_nan() || to_half(value) == bits, "{bits:#06x} is {value}");
            assert_eq!(value.is_finite(), is_finite(bits), "{bits:#06x} is {value}");
        }
    }

    proptest! {
        #[test]
        fn rounding_loses_half_of_the_last_bit_and_keeps_the_order(a in -65504f32..65504.0, b in -2f32..2.0) {
            for value in [a, b, a * 1e-6] {
                let rounded = from_half(to_half(value));
                let most = (value.abs() / 2048.0).max(1.0 / 33_554_432.0);
                prop_assert!((rounded - value).abs() <= most, "{} for {}", rounded, value);
                prop_assert_eq!(to_half(rounded), to_half(value));
            }
            let (low, high) = (a.min(b), a.max(b));
            prop_assert!(from_half(to_half(low)) <= from_half(to_half(high)));
        }
    }
}
