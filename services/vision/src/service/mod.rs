//! 2D models on other machines: [`serve_vision`] answers with the providers of this machine, [`RemoteVision`] asks such services.
//!
//! The messages are those of `proto/segwild/v1/vision.proto`, so that a service may be written in any language.

mod address;
mod client;
mod error;
mod member;
mod pool;
mod queue;
mod server;
mod wire;

pub use address::{AddressError, ServiceAddress};
pub use client::RemoteVision;
pub use error::{ServiceError, TokenFileError};
pub use pool::ServiceTerms;
pub use server::{VisionServer, VisionServiceOptions, serve_vision};
