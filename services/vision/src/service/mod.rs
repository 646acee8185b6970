//! 2D models on other machines: [`RemoteVision`] sends them photos and prompts.
//!
//! The messages are those of `proto/segwild/v1/vision.proto`, so that a service may be written in any language.

mod client;
mod member;
mod pool;
mod queue;
pub(crate) mod wire;

pub use client::RemoteVision;
pub use pool::ServiceTerms;
