//! What to generate.

use crate::error::SyntheticError;
use serde::{Deserialize, Serialize};

segwild_scene::choice! {
    /// What differs from photo to photo.
    pub enum LightVariation {
        /// Nothing: every photo has the canonical light.
        None = "none",
        /// NeRF-W's affine colour.
        Affine = "affine",
        /// Sun, sky, colour temperature and the shadows that go with them.
        Sun = "sun",
        /// Exposure, gamma and vignette.
        Camera = "camera",
        /// One of the three, sampled for each photo.
        Mixed = "mixed",
    }
}

/// What to generate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SyntheticOptions {
    /// Selects the scene and its visitors.
    pub seed: u64,
    /// Number of training photos.
    pub train: usize,
    /// Number of test photos, which have an appearance of their own but no transients.
    pub test: usize,
    /// Long side of every photo in pixels.
    pub long_side: u32,
    /// Share of each training photo that transients cover, 0 to 0.6.
    pub occlusion: f32,
    /// What differs from photo to photo.
    pub photo_light: LightVariation,
    /// How much it differs: 1 is NeRF-W's range for the affine appearance and a day's range for the sun.
    pub appearance_strength: f32,
    /// Number of reconstructed points.
    pub points: usize,
    /// Share of points that are wrong.
    pub outliers: f32,
    /// Standard deviation of observations, in pixels.
    pub pixel_noise: f32,
    /// File units per unit of the scene (which is about 12 across): nothing but the units may depend on it.
    pub units: f64,
}

impl Default for SyntheticOptions {
    fn default() -> Self {
        SyntheticOptions {
            seed: 1,
            train: 60,
            test: 12,
            long_side: 320,
            occlusion: 0.10,
            photo_light: LightVariation::Mixed,
            appearance_strength: 1.0,
            points: 4000,
            outliers: 0.02,
            pixel_noise: 0.5,
            units: 1.0,
        }
    }
}

impl SyntheticOptions {
    /// Few small photos.
    pub fn small() -> SyntheticOptions {
        SyntheticOptions { train: 24, test: 4, long_side: 240, points: 2500, ..SyntheticOptions::default() }
    }

    /// Refuses what is out of its range.
    pub(crate) fn check(&self) -> Result<(), SyntheticError> {
        let refuse = |what: &str| Err(SyntheticError::Options(what.into()));
        if self.train == 0 || self.train + self.test > 4000 {
            return refuse("a set has 1 to 4000 photos, at least one of them for training");
        }
        if !(16..=4096).contains(&self.long_side) {
            return refuse("the long side of the photos is 16 to 4096 pixels");
        }
        if !(0.0..=0.6).contains(&self.occlusion) {
            return refuse("transients cover a share of 0 to 0.6 of a photo");
        }
        if !(0.0..=2.0).contains(&self.appearance_strength) {
            return refuse("the strength of the appearances is 0 to 2");
        }
        if !(0.0..=0.9).contains(&self.outliers) || !(0.0..=20.0).contains(&self.pixel_noise) {
            return refuse("outliers are a share of 0 to 0.9 and the pixel noise is 0 to 20 px");
        }
        if !(self.units > 1e-9 && self.units < 1e9) {
            return refuse("the units are a positive number between 1e-9 and 1e9");
        }
        Ok(())
    }
}
