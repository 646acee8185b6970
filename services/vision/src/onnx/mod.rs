//! Network files, run by ONNX Runtime: found at run time ([`runtime`]), looked at before they are loaded ([`inspect`]),
//! run within limits of time and memory ([`model`]).

mod inspect;
mod model;
mod network;
mod runtime;
mod wire;

pub(crate) use inspect::inspect;
pub use inspect::{ModelFileError, OnnxError};
pub(crate) use model::{NetworkDevice, NetworkModel, NetworkOutput, Options, TensorSpec};
pub(crate) use network::Network;
pub(crate) use runtime::MEMORY_MIB;
pub use runtime::Runtime;
pub use wire::WireError;
