//! 2D models behind traits (docs/method.md, sections 4 and 5): the built-in provider, which needs no weights, ONNX
//! networks run by ort, and services on other machines.
//!
//! It knows no scene in 3D: images, clicks and boxes go in, embeddings and masks come out.
//!
//! ```
//! use segwild_scene::{Image, Prompts};
//! use segwild_vision::{Builtin, PromptSegmenter};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // A white square on black, 64 x 64, and a click on it.
//! let square = |i: usize| (16..48).contains(&(i % 64)) && (16..48).contains(&(i / 64));
//! let plane = (0..64 * 64).map(|i| if square(i) { 1.0 } else { 0.0 });
//! let data: Vec<f32> = plane.clone().chain(plane.clone()).chain(plane).collect();
//! let image = Image { width: 64, height: 64, channels: 3, data };
//! let mask = Builtin::new().segment(&image, &Prompts::click(32.0, 32.0))?.mask;
//! assert!(mask.get(32, 32) && !mask.get(4, 4));
//! # Ok(())
//! # }
//! ```
//!
//! Start reading at `provider.rs` (the traits), then `builtin/mod.rs`.

mod builtin;
mod clip;
mod clip_file_error;
mod clip_files;
mod clip_interface;
mod contours;
mod family;
mod geometry;
pub mod linkage;
mod links;
mod model_file;
mod model_name;
mod network_file;
mod networks;
mod onnx;
mod provider;
mod providers;
mod registry;
mod sam;
mod sam_file_error;
mod sam_interface;
mod server;
mod service;
mod service_address;
mod service_error;
mod service_tls;
mod settings;
mod survey;

pub use builtin::{
    Builtin, EdgeDetector, PromptInterpretation, PromptQuery, PromptStep, RegionCache, Regions, TraitWeights,
};
pub use clip::{CLIP_MEAN, ClipScaling, ClipTokenizer};
pub use clip_file_error::{ClipFileError, TokenizerError};
pub use contours::ContourTree;
pub use family::Family;
pub use model_file::{ModelFileError, OnnxError, WireError};
pub use network_file::NetworkFile;
pub use networks::{EdgeNetwork, SkyNetwork, TransientNetwork};
pub use onnx::Runtime;
pub use provider::{
    Embedder, MaskProposer, PromptSegmenter, Prompted, SkyDetector, TextEmbedder, TransientDetector,
    VisionError, Work,
};
pub use providers::{BUILT_IN, Providers};
pub use registry::{ModelFile, models_in};
pub use sam::Sam;
pub use sam_file_error::SamFileError;
pub use server::{VisionServer, VisionServiceOptions, serve_vision};
pub use service::{RemoteVision, ServiceTerms};
pub use service_address::{AddressError, ServiceAddress};
pub use service_error::{ServiceError, TokenFileError};
pub use service_tls::{ServiceIdentity, TlsFileError, TrustedCertificates};
pub use settings::{DeviceChoice, EdgeChoice, ModelChoice, SkyChoice, VisionSettings};
pub use survey::FileUse;
