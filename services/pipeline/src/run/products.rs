//! What the stages of a run have made so far, for the stages that need it.

use super::inputs::Inputs;
use segwild_trainer::Model;
use std::collections::BTreeSet;
use std::sync::Arc;

/// The scene at the snapshot step. It is freed as soon as the masks are made.
#[derive(Default)]
pub enum SnapshotSlot {
    /// The training has not come to it.
    #[default]
    Missing,
    /// It is there.
    Ready(Arc<Model>),
    /// The stage `masks` has it.
    Taken,
}

impl SnapshotSlot {
    /// Fills the slot. A training that was restarted passes its snapshot step again: the second snapshot is dropped.
    pub fn put(&mut self, snapshot: Arc<Model>) {
        if !matches!(self, SnapshotSlot::Taken) {
            *self = SnapshotSlot::Ready(snapshot);
        }
    }

    /// Takes the snapshot out of the slot.
    pub fn take(&mut self) -> Option<Arc<Model>> {
        match std::mem::replace(self, SnapshotSlot::Taken) {
            SnapshotSlot::Ready(snapshot) => Some(snapshot),
            SnapshotSlot::Missing | SnapshotSlot::Taken => None,
        }
    }
}

/// The results of stages, as far as others need them.
#[derive(Default)]
pub struct Products {
    /// Views whose sky was given up.
    pub without_sky: BTreeSet<usize>,
    /// Per view, whether its embedding is in the cache.
    pub embedded: Vec<bool>,
    /// The scene at the snapshot step.
    pub snapshot: SnapshotSlot,
    /// The trained scene.
    pub model: Option<Arc<Model>>,
    /// The training has reached the requested step, this one, and is not over.
    pub paused: Option<u32>,
    /// The inputs of the field, from the end of the training on.
    pub inputs: Option<Arc<Inputs>>,
    /// Views whose visibility could not be computed.
    pub unseen: BTreeSet<usize>,
}
