//! Why a manifest cannot be used.

use std::path::PathBuf;

use segwild_pipeline::{SettingsError, UntilError};
use segwild_scene::text::TextError;

use super::run_folders::FolderTaken;
use crate::job::{Needs, words};

/// Why a manifest cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {source}", file.display())]
    Read {
        /// The file.
        file: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// The file is not what it should be.
    #[error("{}: {reason}", file.display())]
    File {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: ManifestFileError,
    },
    /// A scene of it is not what it should be.
    #[error("{}: scene `{scene}`: {reason}", file.display())]
    Scene {
        /// The file.
        file: PathBuf,
        /// The scene.
        scene: String,
        /// What is wrong.
        reason: Box<SceneEntryError>,
    },
}

/// What is wrong in a manifest outside of its scenes.
#[derive(Debug, thiserror::Error)]
pub enum ManifestFileError {
    /// It is not the text that it should be.
    #[error(transparent)]
    Text(#[from] TextError),
    /// It is no TOML, or has keys or values that no manifest has.
    #[error(transparent)]
    Toml(#[from] toml::de::Error),
    /// It has no scene.
    #[error("it has no [[scene]]")]
    NoScene,
    /// The budget's memory is no amount of memory.
    #[error(transparent)]
    Memory(#[from] MemorySizeError),
    /// The patience is no time, in seconds.
    #[error("[budget] patience = {0} makes no sense: say seconds")]
    Patience(f64),
}

/// What is wrong with a scene of a manifest.
#[derive(Debug, thiserror::Error)]
pub enum SceneEntryError {
    /// Its name cannot be that of its files.
    #[error("its name must be usable as a file's name, and {0}: set `name`")]
    Name(&'static str),
    /// Another scene has the same name.
    #[error("there are two scenes of this name: set `name`")]
    SameName,
    /// It runs in the folder of another one.
    #[error("{0}: set `out`")]
    Folder(#[from] FolderTaken),
    /// No scene has such a key.
    #[error("there is no key named `{0}`")]
    UnknownKey(String),
    /// A setting is a table or a list.
    #[error("the setting `{0}` must be a single value")]
    NotSingle(String),
    /// The setting is one that the batch decides.
    #[error("`{setting}` is not set here: say `{instead}`")]
    Reserved {
        /// The setting.
        setting: &'static str,
        /// The key of the manifest.
        instead: &'static str,
    },
    /// A setting is unknown, or its value does not fit.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// It is to stop where no scene can.
    #[error("`until = {until}`: {reason}")]
    Until {
        /// Where it is to stop.
        until: String,
        /// What is wrong with that.
        reason: UntilError,
    },
    /// Its memory is no amount of memory.
    #[error(transparent)]
    MemorySize(#[from] MemorySizeError),
    /// It cannot run with the memory that it gets.
    #[error("it needs about {need}, and {whose} is {given_mib} MiB: give more, or lower `splats` or `size`")]
    Memory {
        /// The memory that it needs, in words.
        need: String,
        /// Who gives it the memory.
        whose: &'static str,
        /// The memory that it gets, in MiB.
        given_mib: u64,
    },
    /// It needs more than the whole budget.
    #[error("it needs {}, the budget is {}", words(needs), words(budget))]
    OverBudget {
        /// What it needs.
        needs: Needs,
        /// What there is.
        budget: Needs,
    },
    /// Its record cannot be written as JSON.
    #[error(transparent)]
    Record(#[from] serde_json::Error),
}

/// A text that is no amount of memory.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no amount of memory: write `512 MiB` or `8 GiB`")]
pub struct MemorySizeError(pub(super) String);
