//! Actor: photo to embedding to compressed target; lifting and refinement of the feature field (method,
//! section 4; paper Eq. 9-14).
//!
//! Embeddings are sampled ([`EmbeddingSamples`]), compressed ([`Pca`]) and become targets ([`ViewTarget`]); [`build`]
//! lifts these onto the splats ([`Lifter`]) and refines them by the losses of [`segwild_objective::field`] to a
//! [`FeatureField`].

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
pub use field::FeatureField;
pub use lift::{Lifted, Lifter};
pub use pca::{EmbeddingSamples, FeatureDecoder, MAX_SAMPLES, Pca};
pub use refine::{Progress, build};
pub use settings::{Compression, FeatureSettings};
pub use target::{TargetSource, ViewTarget};
