//! What the measurements that become pages have in common: why one cannot be made.

use crate::plot::PlotError;
use crate::point::PointError;
use segwild_eval::protocols::ProtocolError;
use segwild_eval::record::RecordError;
use segwild_pipeline::SettingsError;
use segwild_raster::RasterError;
use std::path::{Path, PathBuf};

/// Why a chart, curves or slopes cannot be measured or written.
#[derive(Debug, thiserror::Error)]
pub enum PageError {
    /// A name was requested that does not exist.
    #[error("there is no {what} `{requested}`; there are {known}")]
    Unknown {
        /// What it was taken for: a sweep, a row, an axis.
        what: &'static str,
        /// The requested name.
        requested: String,
        /// What there is, with commas.
        known: String,
    },
    /// The folder holds points that do not compare.
    #[error("{0} holds points of other scenes or another default: give another --out, or remove it")]
    Other(PathBuf),
    /// A setting was refused.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// A run failed that should not.
    #[error(transparent)]
    Point(#[from] PointError),
    /// The data that a protocol needs is not there.
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// The kernels refused.
    #[error("the kernels refused: {0}")]
    Raster(#[from] RasterError),
    /// There is no accelerator, or it failed.
    #[error(transparent)]
    Gpu(#[from] segwild_gpu::GpuError),
    /// Results cannot be read or written.
    #[error(transparent)]
    Record(#[from] RecordError),
    /// A figure cannot be drawn.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// A file of the benchmark.
    #[error("{path}: {source}")]
    Io {
        /// Which file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

impl PageError {
    /// Refuses the first of `requested` that is not `known`.
    pub(crate) fn refuse(
        what: &'static str,
        requested: &[String],
        known: &[&str],
        is_known: impl Fn(&str) -> bool,
    ) -> Result<(), PageError> {
        match requested.iter().find(|requested| !is_known(requested)) {
            Some(requested) => {
                Err(PageError::Unknown { what, requested: requested.clone(), known: known.join(", ") })
            }
            None => Ok(()),
        }
    }
}

/// Names the file that something was done to.
pub(crate) fn io<T>(path: &Path, result: std::io::Result<T>) -> Result<T, PageError> {
    result.map_err(|source| PageError::Io { path: path.into(), source })
}
