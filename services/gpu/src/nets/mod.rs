//! The networks of the appearance model `gsw` on the device, forward and backward: twins of `segwild_nn` and
//! `objective/src/appearance/gsw/`, kernel by kernel.

mod layer;
mod plan;
mod points;

pub(crate) use plan::{GpuTape, GpuWeights, Link, NetworkPlan};
pub(crate) use points::{GpuNetworks, NetworkLighting, PIECE, Visible, bytes, floor};
