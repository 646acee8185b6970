//! Puts actors behind the mailboxes of a run.

use super::outcome::ActorOutcome;
use crate::RunError;
use segwild_features::{FeatureActor, FeatureSettings, FeatureTask};
use segwild_flow::{ActorOptions, Cache, Receiver, Sender, System};
use segwild_masks::{MaskActor, MaskMaker, MaskTask};
use segwild_objective::Engine;
use segwild_scene::PhotoStore;
use segwild_trainer::{TrainActor, TrainOrder};
use segwild_vision::{Embedder, SkyDetector};
use std::sync::Arc;

/// The mailboxes that the actors of a run receive from, and where their outcomes go.
pub struct ActorInboxes {
    /// Of the masks actor.
    pub masks: Receiver<MaskTask>,
    /// Of the features actor.
    pub features: Receiver<FeatureTask>,
    /// Of the trainer.
    pub training: Receiver<TrainOrder>,
    /// The coordinator's mailbox.
    pub out: Sender<ActorOutcome>,
}

/// What the actors of a run are built from, at first and again after a panic.
#[derive(Clone)]
pub struct ActorParts {
    /// The photos.
    pub photos: Arc<PhotoStore>,
    /// Renders and trains.
    pub engine: Arc<dyn Engine>,
    /// Where artefacts are stored.
    pub cache: Cache,
    /// Finds skies.
    pub sky: Arc<dyn SkyDetector>,
    /// Makes masks.
    pub maker: Arc<MaskMaker>,
    /// Embeds photos.
    pub embedder: Arc<dyn Embedder>,
    /// How the feature field is made.
    pub features: FeatureSettings,
    /// Photos that are worked on at once.
    pub photos_at_once: usize,
}

/// Spawns the actors of a run. Tests spawn simulated ones.
pub trait Wiring: Sync {
    /// Spawns an actor behind each mailbox.
    ///
    /// # Errors
    /// When a thread cannot be started, or the system is stopping.
    fn spawn(&self, system: &System, inboxes: ActorInboxes, parts: ActorParts) -> Result<(), RunError>;
}

/// The actors that compute: masks, trainer and features.
pub struct ComputingActors;

impl Wiring for ComputingActors {
    fn spawn(&self, system: &System, inboxes: ActorInboxes, parts: ActorParts) -> Result<(), RunError> {
        let ActorInboxes { masks, features, training, out } = inboxes;
        // Photos do not depend on each other: on many cores several are worked on at once.
        let parallel = ActorOptions { workers: parts.photos_at_once, ..ActorOptions::default() };
        let (engine, o) = (parts.engine.clone(), out.clone());
        system.spawn(training, ActorOptions { attempts: 2, ..ActorOptions::default() }, move || {
            Ok(TrainActor { engine: engine.clone(), out: o.clone() })
        })?;
        let (p, o) = (parts.clone(), out.clone());
        system.spawn(masks, parallel, move || {
            let (sky, maker, cache) = (p.sky.clone(), p.maker.clone(), p.cache.clone());
            Ok(MaskActor { sky, maker, cache, out: o.clone() })
        })?;
        system.spawn(features, parallel, move || {
            let ActorParts { photos, engine, cache, embedder, features: settings, .. } = parts.clone();
            Ok(FeatureActor { photos, embedder, engine, cache, settings, out: out.clone() })
        })?;
        Ok(())
    }
}
