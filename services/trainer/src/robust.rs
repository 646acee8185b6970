//! Residuals of every photo so far, by which transients are left out ([`segwild_raster::compare::leave_out`]).

use segwild_raster::compare::Residuals;
use wincode::{SchemaRead, SchemaWrite};

/// Residual histograms per photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct Robust {
    /// Largest share of a photo left out.
    share: f32,
    /// Per photo, decaying counts of residuals; empty until the photo was seen.
    histograms: Vec<Vec<f32>>,
}

impl Robust {
    pub fn new(photos: usize, share: f32) -> Robust {
        Robust { share, histograms: vec![Vec::new(); photos] }
    }

    /// What is known of a photo's residuals.
    pub fn known(&self, photo: usize) -> Residuals<'_> {
        Residuals { before: &self.histograms[photo], share: self.share }
    }

    /// Stores the histogram after a visit of the photo.
    pub fn update(&mut self, photo: usize, residuals: Vec<f32>) {
        self.histograms[photo] = residuals;
    }
}
