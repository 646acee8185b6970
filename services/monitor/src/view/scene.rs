//! A scene of a batch.

use std::collections::BTreeMap;
use std::path::PathBuf;

use segwild_farm::Needs;
use serde::{Deserialize, Serialize};

use super::run::RunView;

/// How a scene of a batch is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SceneState {
    /// Waits for its turn, for space, for the end of its rest, or for its run folder.
    Waiting,
    /// A process works on it.
    Running,
    /// Done.
    Done,
    /// Given up: a dead letter.
    Dead,
}

impl SceneState {
    /// Every state.
    pub const ALL: [SceneState; 4] = [Self::Waiting, Self::Running, Self::Done, Self::Dead];

    /// As a word.
    pub fn word(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Running => "running",
            Self::Done => "done",
            Self::Dead => "dead",
        }
    }
}

/// A scene of a batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneView {
    /// Its name.
    pub name: String,
    /// How it is.
    pub state: SceneState,
    /// Higher goes first.
    pub priority: i32,
    /// What it needs.
    pub needs: Needs,
    /// How often it was started.
    pub attempt: u32,
    /// Failed attempts that count.
    pub failures: u32,
    /// Attempts that may fail.
    pub attempts: u32,
    /// Why the last attempt failed.
    pub error: Option<String>,
    /// Seconds until it is tried again, if it rests.
    pub rests_s: Option<f64>,
    /// When the last attempt began, in seconds since 1970.
    pub started: Option<f64>,
    /// How long the last attempt has taken, in seconds.
    pub wall_s: Option<f64>,
    /// The machine of a farm that works on it, if one does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub worker: Option<String>,
    /// Why it waits, if it does.
    pub why: Option<String>,
    /// Where it stops, if not at the end: a stage, or a step of the training.
    #[serde(default)]
    pub until: Option<String>,
    /// Its run folder.
    pub out: PathBuf,
    /// Its run, if it was ever started.
    pub run: Option<Box<RunView>>,
}

impl SceneView {
    /// Whether the batch has taken it and cannot start its process yet.
    pub(super) fn is_held_up(&self, waits: &BTreeMap<String, String>, batch_runs: bool) -> bool {
        batch_runs && self.state == SceneState::Waiting && waits.contains_key(&self.name)
    }
}
