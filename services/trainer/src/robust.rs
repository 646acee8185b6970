//! Residuals of every photo so far, by which transients are left out ([`segwild_raster::compare::leave_out`]).

use segwild_raster::compare::Residuals;
use wincode::{SchemaRead, SchemaWrite};

/// Residual histograms per photo.
#[derive(Clone, Debug, PartialEq, SchemaRead, SchemaWrite)]
pub(crate) struct Robust {
    /// Per photo, the largest share left out; 0 where it shows no transients.
    shares: Vec<f32>,
    /// Per photo, the share that contradicts trainings made without it; `None` where that was not searched for.
    evidence: Vec<Option<f32>>,
    /// Per photo, decaying counts of residuals; empty until the photo was seen.
    histograms: Vec<Vec<f32>>,
}

impl Robust {
    /// Of photos with these largest shares, and with this evidence of transients.
    pub fn new(shares: Vec<f32>, evidence: Vec<Option<f32>>) -> Robust {
        Robust { histograms: vec![Vec::new(); shares.len()], shares, evidence }
    }

    /// Per photo, the share that contradicts trainings made without it.
    pub fn evidence(&self) -> &[Option<f32>] {
        &self.evidence
    }

    /// Per photo, the largest share that may be left out.
    pub fn shares(&self) -> &[f32] {
        &self.shares
    }

    /// What is known of a photo's residuals.
    pub fn known(&self, photo: usize) -> Residuals<'_> {
        Residuals { before: &self.histograms[photo], share: self.shares[photo] }
    }

    /// Stores the histogram after a visit of the photo.
    pub fn update(&mut self, photo: usize, residuals: Vec<f32>) {
        self.histograms[photo] = residuals;
    }
}
