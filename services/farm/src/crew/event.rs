//! What happens to the scenes of a machine.

use serde::Serialize;

/// What happens in a batch.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum BatchEvent {
    /// What a scene's process reads is fetched from the farm's artefacts.
    SceneFetches {
        /// The scene.
        scene: String,
        /// Whether it continues what another attempt stored.
        resumes: bool,
    },
    /// The state of a scene was stored for other machines.
    SceneStored {
        /// The scene.
        scene: String,
        /// How long that took, in seconds.
        seconds: f64,
    },
    /// A worker of the farm has taken a scene.
    SceneTaken {
        /// The scene.
        scene: String,
        /// The worker.
        worker: String,
        /// How often it was taken so far.
        attempt: u32,
    },
    /// The result of a scene was fetched from the farm.
    SceneFetched {
        /// The scene.
        scene: String,
        /// How long that took, in seconds.
        seconds: f64,
    },
    /// The engine does not answer; the scenes go on.
    EngineSilent {
        /// Why.
        reason: String,
    },
    /// The engine answers again.
    EngineBack,
    /// This machine takes no further scenes for now.
    WorkerPaused {
        /// Why.
        reason: String,
    },
    /// This machine takes scenes again.
    WorkerResumed,
    /// A scene's process starts.
    SceneStarted {
        /// The scene.
        scene: String,
        /// Its process.
        pid: u32,
        /// Which attempt it is, from 1.
        attempt: u32,
        /// The cores it was given.
        cores: u32,
    },
    /// A scene cannot start yet.
    SceneWaits {
        /// The scene.
        scene: String,
        /// For what.
        reason: String,
    },
    /// A scene is done.
    SceneDone {
        /// The scene.
        scene: String,
        /// How long this attempt took, in seconds.
        seconds: f64,
    },
    /// An attempt failed; another one follows.
    SceneRetries {
        /// The scene.
        scene: String,
        /// Why it failed.
        error: String,
        /// After how many seconds it is tried again.
        delay_s: f64,
    },
    /// A scene was given up.
    SceneDied {
        /// The scene.
        scene: String,
        /// Why.
        error: String,
    },
    /// A scene was stopped; it can go on.
    SceneStopped {
        /// The scene.
        scene: String,
    },
    /// The wall clock was set, or the machine slept. Nothing depends on it.
    ClockJumped {
        /// By how much, in seconds; back is negative.
        seconds: f64,
    },
}
