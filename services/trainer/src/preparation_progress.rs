//! How far what comes before a training is.

use std::fmt;

/// A part of what comes before a training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PreparationPart {
    /// Points without a colour get that of the photos.
    PointColours,
    /// Short trainings, in steps.
    ShortTrainings,
    /// What contradicts the short trainings, in photos that each is made without.
    CrossChecks,
    /// Depths of photos for stereo initialisation.
    Stereo,
}

impl fmt::Display for PreparationPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            PreparationPart::PointColours => "colours of points",
            PreparationPart::ShortTrainings => "short trainings",
            PreparationPart::CrossChecks => "cross-checks",
            PreparationPart::Stereo => "stereo",
        })
    }
}

/// How far what comes before a training is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PreparationProgress {
    /// The part that is under way.
    pub part: PreparationPart,
    /// Its units done.
    pub done: usize,
    /// Its units in all.
    pub total: usize,
}
