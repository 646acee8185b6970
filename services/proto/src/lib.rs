//! Messages that cross a process, generated from the files of `proto/`, and the [`Token`] that clients of a service show.
//!
//! It knows nothing of scenes and photos: each crate converts its own types where a message comes in or goes out.
//!
//! ```
//! use segwild_proto::v1::Mask;
//!
//! // A row of four pixels, the middle two inside.
//! let mask = Mask { width: 4, height: 1, runs: vec![1, 2, 1] };
//! assert_eq!(mask.runs.iter().sum::<u32>(), mask.width * mask.height);
//! ```
//!
//! Start reading at `proto/segwild/v1/vision.proto`, `session.proto` and `farm.proto`.

mod token;

pub use token::{Token, UnknownToken};

/// The messages and services of `proto/segwild/v1`.
#[allow(missing_docs, clippy::all)]
pub mod v1 {
    tonic::include_proto!("segwild.v1");
}

/// What the files of `proto/` describe, as a `google.protobuf.FileDescriptorSet`.
pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
