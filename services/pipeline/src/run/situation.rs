//! A run's scene and the keys that follow from its settings, before it starts.

use super::choice;
use super::continued::ContinuedTraining;
use super::examine::examine_photos;
use super::memory;
use super::poses::scene_or_photos;
use super::time::{ANY_ENGINE, time_before};
use crate::artifacts::auto_choice::AutoChoice;
use crate::artifacts::blocks;
use crate::artifacts::described::ALL_DESCRIBED;
use crate::artifacts::digests::photo_digest;
use crate::artifacts::keys::{End, Keys, TrainingOrigin};
use crate::transients::Corrections;
use crate::{RunError, RunFolder, Settings, choose_engine};
use segwild_flow::{Cache, Ledger};
use segwild_scene::{PhotoStore, Scene};
use segwild_trainer::{Lpips, TimeChoice};
use segwild_vision::{NetworkFile, Providers};
use std::path::Path;
use std::sync::Arc;

/// A run's scene and the keys that follow from its settings.
pub struct Situation {
    /// The scene.
    pub scene: Arc<Scene>,
    /// The keys of what the run makes.
    pub keys: Keys,
    /// Its settings, with what the scene decides and what was chosen before.
    pub settings: Settings,
    /// Whether the steps were left to the scene.
    pub steps_open: bool,
    /// What its time has bought; `None` where that is not decided, or there is no time.
    pub time: Option<TimeChoice>,
    /// Weights of LPIPS, if the settings name any.
    pub lpips: Option<Arc<Lpips>>,
    /// The networks that it uses.
    pub networks: Vec<NetworkFile>,
    /// The photos whose transients were corrected by hand, in words.
    pub corrected: Option<String>,
    /// Where the training starts, if not at step 0.
    pub origin: Option<TrainingOrigin>,
    /// The step that the training ends at, or is to stop at.
    pub goal: u32,
    /// The step that the training ends at by its settings.
    pub end: u32,
    /// The step of the snapshot that masks are made from.
    pub snapshot_step: u32,
}

/// What a run folder has kept of earlier runs.
pub struct KeptResults<'a> {
    /// The cache.
    pub cache: &'a Cache,
    /// The folder.
    pub folder: &'a RunFolder,
    /// Its ledger, if it has one.
    pub ledger: Option<&'a Ledger>,
}

impl Situation {
    /// The situation of a run with these settings that ends at `end`. Reads every photo's file, and changes nothing.
    ///
    /// # Errors
    /// When the scene, the settings or the run folder cannot be used.
    pub fn of(
        path: &Path,
        folder: &RunFolder,
        ledger: Option<&Ledger>,
        settings: &Settings,
        end: &End,
    ) -> Result<Situation, RunError> {
        let scene = match scene_or_photos(path, &settings.scene)? {
            Ok(scene) => scene,
            Err(_) => folder.open_posed(path, &settings.scene)?,
        };
        let providers = Providers::from_settings(&settings.vision)?;
        let steps_open = settings.steps_open(&scene);
        let recorded = blocks::of(folder);
        let settings = &memory::with_blocks(settings, &scene, recorded).decided(&scene);
        let engine = choose_engine(&settings.run, drop)?.engine;
        let corrections = Corrections::find(&scene, folder, &settings.scene.transient_masks)?;
        let corrected = corrections.in_words(&scene);
        let scene = Arc::new(scene);
        // Without a cache: to explain a run changes nothing.
        let photos = PhotoStore::new(scene.clone(), settings.scene.size, 0);
        let digest = |view: usize| photo_digest(&scene.views[view]);
        let digests = examine_photos(&photos, &digest, settings, &corrections, &|| false)?;
        let lpips = digests.lpips.as_ref().map(|file| file.lpips.clone());
        let named_on = |settings: &Settings, corrections: &Corrections, engine: &str, end: &End| {
            Keys::of(
                &scene,
                digests.clone(),
                settings,
                &providers,
                &corrections.digests(),
                engine,
                end,
                ALL_DESCRIBED,
            )
        };
        let named = |settings: &Settings, corrections: &Corrections, end: &End| {
            named_on(settings, corrections, engine.name(), end)
        };
        let name = |settings: &Settings| named(settings, &corrections, end);
        // A choice that is still open leaves its `auto` in the key: all that depends on it is then to be made.
        let cache = Cache::at(folder.path().join("cache"));
        let mut settings = choice::decided_before(&cache, settings, steps_open, &name)?;
        let mut time = None;
        if TimeChoice::is_open(&settings) {
            let choice = named_on(&settings, &corrections, ANY_ENGINE, end).choice;
            time = time_before(&cache, &settings, &choice)?;
        }
        if let Some(bought) = &time {
            settings = bought.decided(&settings, steps_open);
        }
        let (mut keys, mut goal, mut origin) = (name(&settings), end.step(), None);
        if let (End::Settings, Some(ledger)) = (end, ledger) {
            let named = |corrections: &Corrections, end: &End| named(&settings, corrections, end);
            if let Some(continued) =
                ContinuedTraining::find(folder, ledger, &cache, &settings, &corrections, &named)?
            {
                (keys, goal, origin) = (continued.keys, Some(continued.origin.end), Some(continued.origin));
            }
        }
        let (end, snapshot_step) = (settings.train.steps, settings.train.snapshot_step());
        let networks = providers.networks;
        Ok(Situation {
            scene,
            keys,
            settings,
            steps_open,
            time,
            lpips,
            networks,
            corrected,
            origin,
            goal: goal.unwrap_or(end),
            end,
            snapshot_step,
        })
    }
}
