//! The stages of a run, by name.

use serde::Serialize;
use std::fmt;

/// A stage of a run. Stages are ordered as they end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// The camera poses of photos that come without, or of a video's frames. A scene with poses has no row of it.
    Poses,
    /// The sky of each photo.
    Sky,
    /// The embedding of each photo.
    Embed,
    /// The masks of each photo, proposed from the snapshot of the training.
    Masks,
    /// The training.
    Geometry,
    /// The visibility of each photo, by comparison with the trained scene; then the scene tree. It has no row in the
    /// ledger's list of stages: there it counts as the start of [`Stage::Features`].
    Visibility,
    /// The feature field.
    Features,
    /// The scores of the held-out photos.
    Evaluate,
    /// The list of the scene's objects.
    Objects,
    /// The report.
    Report,
}

impl Stage {
    /// The stages that ledger, progress, metrics and `--until` name.
    pub const LISTED: [Stage; 9] = [
        Stage::Poses,
        Stage::Sky,
        Stage::Embed,
        Stage::Masks,
        Stage::Geometry,
        Stage::Features,
        Stage::Evaluate,
        Stage::Objects,
        Stage::Report,
    ];

    /// Its name in the ledger, in events, metrics and cache keys.
    pub const fn name(self) -> &'static str {
        match self {
            Stage::Poses => "poses",
            Stage::Sky => "sky",
            Stage::Embed => "embed",
            Stage::Masks => "masks",
            Stage::Geometry => "geometry",
            Stage::Visibility => "visibility",
            Stage::Features => "features",
            Stage::Evaluate => "evaluate",
            Stage::Objects => "objects",
            Stage::Report => "report",
        }
    }

    /// The listed stage of a name.
    ///
    /// ```
    /// use segwild_pipeline::Stage;
    /// assert_eq!(Stage::named("geometry"), Some(Stage::Geometry));
    /// assert_eq!(Stage::named("geometri"), None);
    /// ```
    pub fn named(name: &str) -> Option<Stage> {
        Stage::LISTED.into_iter().find(|stage| stage.name() == name)
    }

    /// The listed stage that a failure counts for.
    pub const fn listed(self) -> Stage {
        match self {
            Stage::Visibility => Stage::Features,
            stage => stage,
        }
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
