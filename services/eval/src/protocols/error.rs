//! Why a benchmark cannot be made.

use crate::metrics::MetricError;
use crate::perturb::PerturbError;
use crate::record::RecordError;
use crate::trial::TrialError;
use segwild_pipeline::{RunError, SettingsError};
use segwild_scene::SceneError;
use segwild_synthetic::SyntheticError;

/// Data that a protocol needs and that is not here.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Missing {
    /// What is missing, a line each.
    pub what: Vec<String>,
    /// How the data must lie, and where it comes from.
    pub layout: String,
}

/// Most lines of what is missing that are shown.
const SHOWN: usize = 12;

impl std::fmt::Display for Missing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "this benchmark needs data that is not here:")?;
        for what in self.what.iter().take(SHOWN) {
            writeln!(f, "  - {what}")?;
        }
        if self.what.len() > SHOWN {
            writeln!(f, "  and {} more", self.what.len() - SHOWN)?;
        }
        f.write_str(&self.layout)
    }
}

/// Why a benchmark cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum ProtocolError {
    /// Its data is not here.
    #[error("{0}")]
    Missing(Missing),
    /// A file beside the data is not what it should be.
    #[error("{file}: {reason}")]
    File {
        /// The file.
        file: String,
        /// What is wrong in it.
        reason: String,
    },
    /// A synthetic trial failed.
    #[error(transparent)]
    Trial(#[from] TrialError),
    /// A run failed.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A setting does not fit.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A photo or mask cannot be read or written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The results cannot be written.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A photo cannot be perturbed.
    #[error(transparent)]
    Perturb(#[from] PerturbError),
    /// A mask does not fit its truth.
    #[error("{target}, {photo}: {source}")]
    Metric {
        /// The target.
        target: String,
        /// The photo.
        photo: String,
        /// What does not fit.
        source: MetricError,
    },
}

impl ProtocolError {
    /// One thing is missing. `layout` says how the data must lie.
    pub(super) fn missing(what: impl Into<String>, layout: &str) -> ProtocolError {
        ProtocolError::Missing(Missing { what: vec![what.into()], layout: layout.into() })
    }
}

impl From<SyntheticError> for ProtocolError {
    fn from(error: SyntheticError) -> ProtocolError {
        TrialError::from(error).into()
    }
}
