//! 2D models behind traits (method, sections 4-5): the built-in provider, which needs no weights, and ONNX
//! networks run by ort.

mod builtin;
mod networks;
mod onnx;
mod provider;
mod settings;

pub use builtin::{Builtin, EdgeDetector, Meaning, Question, Step, Weights};
pub use networks::{EdgeNetwork, SkyNetwork};
pub use onnx::Runtime;
pub use provider::{Embedder, MaskProposer, PromptSegmenter, SkyDetector, VisionError};
pub use settings::{EdgeChoice, Providers, SkyChoice, VisionSettings};
