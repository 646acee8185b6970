//! Benchmarks that others can repeat: a scene, the queries, the true masks, and the numbers.
//!
//! Each protocol finds its scenes and queries ([`EvalScene`], or a synthetic [`crate::trial::Trial`]), puts every row
//! ([`crate::ablation::Variant`]) through them, and leaves [`crate::record::Results`] in `OUT/results.json`. Tables are
//! printed from those ([`tables`]).

mod base;
pub mod clicks;
mod error;
pub mod folder;
pub mod lego;
pub mod nvos;
pub mod paper;
pub mod photo_tourism;
pub mod scene;
pub mod spin_nerf;
pub mod synthetic;
pub mod tables;

pub use base::{OnRecord, ProtocolBase, Table};
pub use error::{Missing, ProtocolError};
pub use scene::{EvalQuery, EvalScene, FoundScenes, measure};
