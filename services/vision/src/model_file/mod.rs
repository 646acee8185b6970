//! The file of an ONNX network, walked before the runtime loads it: what is refused then cannot harm the process.

mod inspect;
mod signature;
mod tensor_spec;
mod wire;

pub(crate) use inspect::inspect;
pub use inspect::{ModelFileError, OnnxError};
pub(crate) use signature::{GraphSignature, signature};
pub(crate) use tensor_spec::TensorSpec;
pub use wire::WireError;
