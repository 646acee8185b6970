//! Small dense networks, trained on the CPU: what the looks of photos are made of.
//!
//! Layers are descriptions: what they are, and where their weights lie in one flat slice of f32. `forward` takes the
//! slice and the input, `backward` adds the gradient of the weights to a slice of the same layout and returns that of the
//! input. A network is a list of layers and of the maps between them ([`Graph`]). One optimiser step is therefore a step of
//! one flat slice, a checkpoint is its numbers, and another engine needs the slice and the list.
//!
//! Sums run in a fixed order, so that the result is the same whatever the number of threads.

mod conv;
mod graph;
mod layer;
mod map;
mod matmul;
mod mlp;
#[cfg(test)]
mod noise;
mod norm;
mod product;
mod sample;
mod unet;

pub use conv::{Conv, Up};
pub use graph::{Form, Graph, Id, Op, Tape, What};
pub use layer::{Kind, Layer, Layout};
pub use map::Map;
pub use matmul::{matmul, transpose};
pub use mlp::{Activations, Mlp};
pub use norm::{EPSILON, GroupNorm, NormState};
pub use product::{Strided, product};
pub use sample::{Spot, scatter, take};
pub use unet::{Shape, UNet};
