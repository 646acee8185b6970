//! Networks, run by ONNX Runtime: found at run time ([`runtime`]), run within limits of time and memory ([`model`]).

mod half;
mod model;
mod network;
mod runtime;

pub(crate) use half::floats;
pub(crate) use model::{NetworkDevice, NetworkModel, NetworkOutput, Options};
pub(crate) use network::Network;
pub(crate) use runtime::MEMORY_MIB;
pub use runtime::Runtime;
