//! The stages of a run, by name.

use serde::Serialize;
use std::fmt;

/// Defines the stages, each with its name in the ledger, in events, metrics and cache keys.
macro_rules! stages {
    ($($(#[$doc:meta])* $stage:ident = $name:literal,)*) => {
        /// A stage of a run. Stages are ordered as they end.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
        #[serde(rename_all = "lowercase")]
        pub enum Stage {
            $($(#[$doc])* $stage,)*
        }

        impl Stage {
            const ALL: &[Stage] = &[$(Stage::$stage,)*];

            /// Its name in the ledger, in events, metrics and cache keys.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Stage::$stage => $name,)*
                }
            }
        }
    };
}

stages! {
    /// The camera poses of photos that come without, or of a video's frames. A scene with poses has no row of it.
    Poses = "poses",
    /// The sky of each photo.
    Sky = "sky",
    /// The embedding of each photo.
    Embed = "embed",
    /// The masks of each photo, proposed from the snapshot of the training.
    Masks = "masks",
    /// The training.
    Geometry = "geometry",
    /// The visibility of each photo, by comparison with the trained scene; then the scene tree. It has no row in the
    /// ledger's list of stages: there it counts as the start of [`Stage::Features`].
    Visibility = "visibility",
    /// The feature field.
    Features = "features",
    /// The scores of the held-out photos.
    Evaluate = "evaluate",
    /// The list of the scene's objects.
    Objects = "objects",
    /// The report.
    Report = "report",
}

impl Stage {
    /// The stages that ledger, progress, metrics and `--until` name.
    pub fn all_listed() -> impl Iterator<Item = Stage> {
        Stage::ALL.iter().copied().filter(|stage| stage.listed() == *stage)
    }

    /// The listed stage of a name.
    ///
    /// ```
    /// use segwild_pipeline::Stage;
    /// assert_eq!(Stage::named("geometry"), Some(Stage::Geometry));
    /// assert_eq!(Stage::named("geometri"), None);
    /// ```
    pub fn named(name: &str) -> Option<Stage> {
        Stage::all_listed().find(|stage| stage.name() == name)
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
