//! Small networks, trained on the CPU: the appearance model `gsw` uses them.
//!
//! A layer is a description: its type, and the range of its weights in one flat slice of f32. `forward` takes the slice
//! and the input. `backward` adds the gradient of the weights to a slice of the same layout and returns the gradient of the
//! input. A network is a list of operations and of the maps that they read and write ([`NetworkGraph`]). An optimiser step
//! therefore updates one flat slice, a checkpoint stores it, and another engine needs only the slice and the list.
//!
//! Sums run in a fixed order, so that the result is the same whatever the number of threads.
//!
//! It is no framework: there are the layers that the appearance models and [`Lpips`] need, and no graph is differentiated for
//! you.
//!
//! ```
//! use segwild_nn::{matmul, solve};
//!
//! // (1 2; 3 4) (5; 6), added to what is there.
//! let mut product = [0.0; 2];
//! matmul(&[1.0, 2.0, 3.0, 4.0], &[5.0, 6.0], 2, 2, 1, &mut product);
//! assert_eq!(product, [17.0, 39.0]);
//! let [[x], [y]] = solve([[2.0, 1.0], [1.0, 3.0]], [[4.0], [7.0]]);
//! assert!((x - 1.0).abs() < 1e-12 && (y - 2.0).abs() < 1e-12);
//! ```
//!
//! Start reading at `layer.rs` (a description and its weights), then `mlp.rs`; `lpips/mod.rs` stands by itself.

mod cholesky;
mod conv;
pub mod eigen;
mod graph;
mod layer;
mod lpips;
mod map;
mod matmul;
mod mlp;
#[cfg(test)]
mod noise;
mod norm;
mod product;
mod sample;
mod unet;

pub use cholesky::solve;
pub use conv::{Conv, Up};
pub use graph::{Form, Id, NetworkGraph, Op, OpKind, Tape};
pub use layer::{Layer, LayerKind, WeightLayout};
pub use lpips::{Lpips, LpipsError, LpipsNet};
pub use map::Map;
pub use matmul::{matmul, transpose};
pub use mlp::{Activations, Mlp};
pub use norm::{EPSILON, GroupNorm, NormState};
pub use product::{Strided, product};
pub use sample::{BilinearSample, scatter, take};
pub use unet::{UNet, UNetShape};
