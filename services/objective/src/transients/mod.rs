//! Which pixels of a photo show something that the scene lacks, and are left out of its losses (method, section 3): by
//! the residuals of the photo so far, or by a visibility map that a network predicts.

mod residuals;
mod visibility;

pub use residuals::{
    BINS, CONTRAST, DECAY, FLOOR, INITIAL_TRANSIENT, ResidualHistograms, Residuals, SURPRISE, contradicted,
    leave_out, limit, relative, residual_limits, smoothed, window,
};
pub use visibility::{LEAST, MOST, OCCLUDED, SURE, VisibilityMap, WRONG};
pub(crate) use visibility::{part_residuals, visibility_weights};
