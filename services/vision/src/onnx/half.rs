//! Numbers of 16 bits, for networks that take or answer them.

use ort::memory::Allocator;
use ort::session::SessionInputValue;
use ort::value::{DynTensor, DynTensorValueType, DynValue, Tensor, TensorElementType};

/// Numbers as an input of a network: as they are, or rounded to 16 bits where the file declares these.
pub(crate) fn floats(
    kind: Option<TensorElementType>,
    shape: &[usize],
    data: Vec<f32>,
) -> ort::Result<SessionInputValue<'static>> {
    if kind != Some(TensorElementType::Float16) {
        return Ok(Tensor::from_array((shape, data))?.into());
    }
    let mut tensor = DynTensor::new(&Allocator::default(), TensorElementType::Float16, shape)?;
    let count = shape.iter().product::<usize>().min(data.len());
    let to = tensor.data_ptr_mut().cast::<u16>();
    if !to.is_null() {
        for (i, value) in data.iter().take(count).enumerate() {
            // SAFETY: the tensor was made just now, on the CPU, for as many numbers of two bytes as `shape` has, and `i` is
            // below that count.
            unsafe { to.add(i).write(to_half(*value)) };
        }
    }
    Ok(tensor.into())
}

/// The shape and the numbers of an output, of 32 or 16 bits.
pub(super) fn extract(value: &DynValue) -> ort::Result<(Vec<usize>, Vec<f32>)> {
    let sizes =
        |shape: &[i64]| -> Vec<usize> { shape.iter().map(|&n| usize::try_from(n).unwrap_or(0)).collect() };
    if !value.is_tensor() || *value.data_type() != TensorElementType::Float16 {
        let (shape, data) = value.try_extract_tensor::<f32>()?;
        return Ok((sizes(shape), data.to_vec()));
    }
    let shape = sizes(value.shape());
    let count = shape.iter().product::<usize>();
    let tensor = value.view().downcast::<DynTensorValueType>()?;
    let from = tensor.data_ptr().cast::<u16>();
    if from.is_null() || count == 0 {
        return Ok((shape, Vec::new()));
    }
    // SAFETY: the runtime gives outputs in the CPU's memory, the type is one of two bytes, and the shape is the value's own.
    let bits = unsafe { std::slice::from_raw_parts(from, count) };
    Ok((shape, bits.iter().map(|&b| from_half(b)).collect()))
}

/// Rounds to the nearest number of 16 bits, to the even one of two that are as near (IEEE 754 binary16).
fn to_half(value: f32) -> u16 {
    let bits = value.to_bits();
    let sign = ((bits >> 16) & 0x8000) as u16;
    let magnitude = bits & 0x7fff_ffff;
    if magnitude > 0x7f80_0000 {
        return sign | 0x7e00;
    }
    // From 65,520 on the nearest is infinity.
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

fn from_half(bits: u16) -> f32 {
    let sign = u32::from(bits & 0x8000) << 16;
    let (exponent, fraction) = (u32::from((bits >> 10) & 0x1f), u32::from(bits & 0x03ff));
    let magnitude = match exponent {
        0 => (fraction as f32 / 16_777_216.0).to_bits(),
        31 => 0x7f80_0000 | (fraction << 13),
        _ => ((exponent + 112) << 23) | (fraction << 13),
    };
    f32::from_bits(sign | magnitude)
}

#[cfg(test)]
mod tests {
    use super::*;

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
            assert!(value.is_nan() || to_half(value) == bits, "{bits:#06x} is {value}");
        }
    }
}
