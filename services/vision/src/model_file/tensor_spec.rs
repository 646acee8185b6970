//! An input or output of a network.

use ort::value::{Outlet, TensorElementType};

/// An input or output as the file declares it.
#[derive(Clone, Debug)]
pub(crate) struct TensorSpec {
    pub name: String,
    pub kind: Option<TensorElementType>,
    /// `None` where the size is left open.
    pub shape: Vec<Option<usize>>,
}

impl TensorSpec {
    pub fn of(outlet: &Outlet) -> TensorSpec {
        let size = |&n: &i64| usize::try_from(n).ok().filter(|&n| n > 0);
        let shape = outlet.dtype().tensor_shape().map(|s| s.iter().map(size).collect()).unwrap_or_default();
        TensorSpec { name: outlet.name().to_owned(), kind: outlet.dtype().tensor_type(), shape }
    }

    /// In words: `float32 [1, 256, ?, ?]`.
    pub fn words(&self) -> String {
        let kind = match self.kind {
            None => "no tensor".to_owned(),
            Some(TensorElementType::Float32) => "float32".to_owned(),
            Some(TensorElementType::Uint8) => "uint8".to_owned(),
            Some(TensorElementType::Int64) => "int64".to_owned(),
            Some(TensorElementType::Int32) => "int32".to_owned(),
            Some(TensorElementType::Float16) => "float16".to_owned(),
            Some(other) => other.to_string(),
        };
        let sizes: Vec<String> = self.shape.iter().map(|n| n.map_or("?".into(), |n| n.to_string())).collect();
        format!("{kind} [{}]", sizes.join(", "))
    }
}
