//! All settings of a run in one struct: flags, `segwild.toml` and `docs/reference/settings.md` are generated from it.

mod composed;
mod former;
mod layers;
mod reference;
mod whole_run;

pub(crate) use composed::AT_ONCE;
pub use composed::Settings;
pub(crate) use former::is_removed;
pub use former::renamed;
pub use layers::SettingsError;
pub use whole_run::{DescribedPhotos, EngineKind, RunBudget, RunSettings, Scoring, WhenLost};
