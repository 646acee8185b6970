//! Numbers of 16 bits, for networks that take or answer them.

use ort::memory::Allocator;
use ort::session::SessionInputValue;
use ort::value::{DynTensor, DynTensorValueType, DynValue, Tensor, TensorElementType};
use segwild_scene::half::{from_half, to_half};

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
