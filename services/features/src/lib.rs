//! Actor: photo to embedding to compressed target; lifting and refinement of the feature field (method,
//! section 4; paper Eq. 9-14).
//!
//! Embeddings are sampled ([`EmbeddingSamples`]), compressed ([`Pca`]) and become targets ([`ViewTarget`]); [`build`]
//! lifts these onto the splats ([`Lifter`]) and refines them by the losses of [`segwild_objective::field`] to a
//! [`FeatureField`].
//!
//! It neither trains splats nor makes masks: it reads both, and makes one vector per splat.
//!
//! ```
//! use segwild_features::EmbeddingSamples;
//!
//! // Embeddings of one direction need one principal component.
//! let mut samples = EmbeddingSamples::new(100, 1, 7);
//! assert!(samples.is_empty());
//! ```
//!
//! Start reading at `lift.rs`, then `refine.rs`.

mod actor;
mod bilinear;
mod colours;
mod error;
mod field;
mod lift;
mod pca;
mod refine;
mod settings;
mod target;

pub use actor::{EMBEDDING, EmbedError, FeatureActor, FeatureOutcome, FeatureTask, FieldInputs, describe};
pub use colours::FeatureColours;
pub use error::FeatureError;
pub use field::{FeatureField, WideFeatureField};
pub use lift::{Lifted, Lifter};
pub use pca::{EmbeddingSamples, FeatureDecoder, MAX_SAMPLES, Pca};
pub use refine::{Progress, build};
pub use settings::{Compression, FeatureSettings};
pub use target::{TargetSource, ViewTarget};
