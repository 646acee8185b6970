//! The networks of the look `gsw` on the device, forward and back: kernel by kernel what `segwild_nn` and
//! `raster/src/appearance/gsw/` do.

mod layer;
mod plan;
mod points;

pub(crate) use layer::CONSTANTS;
pub(crate) use plan::{Link, Plan, Tape, Weights};
pub(crate) use points::{GpuNetworks, Lighting, PIECE, Visible, bytes, floor};
