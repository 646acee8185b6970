//! 2D models behind traits (docs/method.md, sections 4 and 5): the built-in provider, which needs no weights, and ONNX
//! networks run by ort.

mod builtin;
mod contours;
mod geometry;
pub mod linkage;
mod network_file;
mod networks;
mod onnx;
mod provider;
mod providers;
mod registry;
mod sam;
mod settings;

pub use builtin::{
    Builtin, EdgeDetector, PromptInterpretation, PromptQuery, PromptStep, RegionCache, Regions, TraitWeights,
};
pub use contours::ContourTree;
pub use network_file::NetworkFile;
pub use networks::{EdgeNetwork, SkyNetwork, TransientNetwork};
pub use onnx::{ModelFileError, OnnxError, Runtime, WireError};
pub use provider::{
    Embedder, MaskProposer, PromptSegmenter, Prompted, SkyDetector, TransientDetector, VisionError, Work,
};
pub use providers::{BUILT_IN, Providers};
pub use registry::{Family, ModelFile, models_in};
pub use sam::Sam;
pub use settings::{DeviceChoice, EdgeChoice, ModelChoice, SkyChoice, VisionSettings};
