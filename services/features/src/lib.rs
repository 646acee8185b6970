//! Actor: photo to embedding to compressed target; lifting and refinement of the feature field (method,
//! section 4; paper Eq. 9-14).
//!
//! Embeddings are sampled ([`Samples`]), compressed ([`Pca`]) and become targets ([`ViewTarget`]); [`build`]
//! lifts these onto the splats ([`Lifter`]) and refines them by the losses of [`segwild_raster::field`] to a
//! [`FeatureField`].

mod actor;
mod bilinear;
mod eigen;
mod error;
mod field;
mod lift;
mod pca;
mod picture;
mod refine;
mod settings;
mod target;

pub use actor::{EMBEDDING, FeatureActor, FeatureOutcome, FeatureTask, FieldInputs, describe};
pub use error::FeatureError;
pub use field::FeatureField;
pub use lift::{Lifted, Lifter};
pub use pca::{Decoder, MAX_SAMPLES, Pca, Samples};
pub use picture::FeatureColours;
pub use refine::{Progress, build};
pub use settings::{Compression, FeatureSettings};
pub use target::{TargetSource, ViewTarget};
