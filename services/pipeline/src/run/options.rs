//! What a run is given beside its settings, and what it returns.

use super::until::Until;
use crate::artifacts::described::ALL_DESCRIBED;
use crate::output::evaluate::HeldOut;
use crate::transients::TrainFit;
use segwild_flow::{Events, Stopper};
use segwild_scene::Skipped;
use segwild_trainer::SeamCheck;
use segwild_vision::Providers;
use serde::Serialize;

/// What a run is given beside its settings.
#[derive(Clone)]
pub struct RunOptions {
    /// Receives progress, messages and warnings.
    pub events: Events,
    /// Says when to stop.
    pub stopper: Stopper,
    /// Providers to use instead of those the settings name.
    pub providers: Option<Providers>,
    /// Where to stop; `None` goes to the end.
    pub until: Option<Until>,
    /// Photos up to which masks and descriptors are made of all, under `described_photos = auto` (method, section 9).
    pub all_described: usize,
}

impl Default for RunOptions {
    fn default() -> Self {
        RunOptions {
            events: Events::new(),
            stopper: Stopper::new(),
            providers: None,
            until: None,
            all_described: ALL_DESCRIBED,
        }
    }
}

/// What a run did.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Photos that take part.
    pub photos: usize,
    /// Photos that do not take part, and why.
    pub skipped: Vec<Skipped>,
    /// Who makes the masks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// Splats of the trained scene.
    pub splats: usize,
    /// The step that the training stands at, when it was to stop before its end.
    pub paused_at: Option<u32>,
    /// How the scene fits the photos that it was trained on; `None` where the run ended before they were compared.
    pub train_fit: Option<TrainFit>,
    /// How well photos are shown at the seams of a scene that was trained by blocks.
    pub seams: Option<SeamCheck>,
    /// Held-out scores, if photos were held out.
    pub held_out: Option<HeldOut>,
    /// Per-photo artefacts that were made.
    pub made: usize,
    /// Per-photo artefacts that were in the cache.
    pub cached: usize,
    /// Wall time in seconds.
    pub wall_s: f64,
    /// Peak memory of the process in bytes, if the system reports it.
    pub peak_bytes: Option<u64>,
    /// How each actor spent its time, a line each.
    pub actors: String,
}
