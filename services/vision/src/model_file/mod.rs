//! The file of an ONNX network, walked before the runtime loads it: what is refused then cannot harm the process.

mod inspect;
mod wire;

pub(crate) use inspect::inspect;
pub use inspect::{ModelFileError, OnnxError};
pub use wire::WireError;
