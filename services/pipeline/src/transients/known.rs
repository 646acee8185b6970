//! The transients that are known of a photo before the training: by hand, and by a network.

use super::corrections::Corrections;
use segwild_flow::{Cache, Key, MakeError};
use segwild_scene::Mask;
use segwild_trainer::TrainPhoto;
use segwild_vision::{TransientDetector, VisionError};
use std::sync::Arc;

/// Kind of the cache's records of what the network finds.
const KIND: &str = "transients";

/// The transients that are known of each photo before anything is trained.
#[derive(Clone)]
pub struct KnownTransients {
    /// Masks that a person has corrected.
    pub corrections: Arc<Corrections>,
    /// The network that finds people and vehicles.
    pub network: Option<Arc<dyn TransientDetector>>,
    /// The cache of the network's masks.
    pub cache: Cache,
    /// The keys of the network's masks, by view.
    pub keys: Arc<Vec<Key>>,
}

impl KnownTransients {
    /// Writes what is known into a photo. A corrected mask is final. What the network finds is left out of the photo's
    /// valid pixels, and the training may find more.
    ///
    /// # Errors
    /// When the network fails or the cache cannot be read.
    pub fn apply(&self, view: usize, photo: &mut TrainPhoto) -> Result<(), MakeError<VisionError>> {
        let (w, h) = (photo.image.width as u32, photo.image.height as u32);
        if let Some(mask) = self.corrections.mask(view, w, h) {
            photo.transients = Some(mask);
        } else if let Some(network) = &self.network {
            let find = || network.transients(&photo.image);
            let (mask, _) = self.cache.get_or_make(&self.keys[view], KIND, find)?;
            let valid = photo.valid.take().unwrap_or_else(|| Mask::full(w, h));
            photo.valid = Some(valid.minus(&mask));
        }
        Ok(())
    }

    /// The network's mask of a photo, if it is in the cache.
    pub(super) fn network_mask(&self, view: usize) -> Option<Mask> {
        self.network.as_ref()?;
        self.cache.get_typed(&self.keys[view], KIND).ok().flatten()
    }
}
