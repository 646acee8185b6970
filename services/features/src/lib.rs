//! Actor: photo to embedding to compressed target; lifting and refinement of the feature field (method,
//! section 4; paper Eq. 9-14).
//!
//! Embeddings are sampled ([`Samples`]), compressed ([`Pca`]) and become targets ([`ViewTarget`]); [`build`]
//! lifts these onto the splats ([`Lifter`]) and refines them by the embedding loss and [`compactness`] to a
//! [`FeatureField`].

mod actor;
mod compact;
mod eigen;
mod embedding_loss;
mod error;
mod field;
mod grid;
mod lift;
mod matmul;
mod pca;
mod picture;
mod refine;
mod settings;
mod target;

pub use actor::{EMBEDDING, FeatureActor, FeatureOutcome, FeatureTask, FieldInputs, describe};
pub use compact::{Compactness, compactness};
pub use embedding_loss::embedding_loss;
pub use error::FeatureError;
pub use field::FeatureField;
pub use lift::{Lifted, Lifter};
pub use pca::{Decoder, MAX_SAMPLES, Pca, Samples};
pub use picture::FeatureColours;
pub use refine::{Progress, build};
pub use settings::{Compression, FeatureSettings};
pub use target::{Membership, TargetSource, ViewTarget};
