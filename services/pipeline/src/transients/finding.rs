//! Finds the transients of a photo: by hand and by a network before the training, by comparison with the scene after it.

use super::authorship::FOLDER;
use super::corrections::Corrections;
use super::images::{PendingMask, TransientMaskWriter};
use rayon::prelude::*;
use segwild_flow::{ActorFailure, Cache, Key};
use segwild_scene::Mask;
use segwild_trainer::{TrainPhoto, TransientEvidence, transient_evidence};
use segwild_vision::TransientDetector;
use std::sync::Arc;

/// Largest share of a photo that may be transient when the photo is compared with the trained scene.
const MOST: f32 = 0.6;
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
    /// In words, when the network fails or the cache cannot be read.
    pub fn apply(&self, view: usize, photo: &mut TrainPhoto) -> Result<(), String> {
        let (w, h) = (photo.image.width as u32, photo.image.height as u32);
        if let Some(mask) = self.corrections.mask(view, w, h) {
            photo.transients = Some(mask);
        } else if let Some(network) = &self.network {
            let find = || network.transients(&photo.image);
            let (mask, _) =
                self.cache.get_or_make(&self.keys[view], KIND, find).map_err(|e| e.to_string())?;
            let valid = photo.valid.take().unwrap_or_else(|| Mask::full(w, h));
            photo.valid = Some(valid.minus(&mask));
        }
        Ok(())
    }

    /// The network's mask of a photo, if it is in the cache.
    fn network_mask(&self, view: usize) -> Option<Mask> {
        self.network.as_ref()?;
        self.cache.get_typed(&self.keys[view], KIND).ok().flatten()
    }
}

impl TransientMaskWriter<'_> {
    /// Finds the transients of some photos: what contradicts the trained scene, grown to the photo's own boundaries,
    /// together with what was known before. Returns a mask and the photo's PSNR in dB for each. The photos are compared
    /// with the scene one after the other, since an engine may be one device.
    pub(super) fn find(
        &self,
        pending: &[PendingMask],
        photo: &(impl Fn(usize) -> Result<TrainPhoto, ActorFailure> + Sync),
    ) -> Result<Vec<(Mask, f32)>, ActorFailure> {
        let photos: Vec<TrainPhoto> =
            pending.par_iter().map(|pending| photo(pending.view)).collect::<Result<_, ActorFailure>>()?;
        let compare = |(pending, photo): (&PendingMask, &TrainPhoto)| {
            let none = self.model.transient_shares[pending.view] == 0.0;
            let most = if none { 0.0 } else { MOST };
            transient_evidence(self.model, self.engine, self.scene, pending.view, photo, most)
        };
        let evidence = pending.iter().zip(&photos).map(compare).collect::<Result<Vec<_>, _>>()?;
        let snap = |((pending, photo), evidence): ((&PendingMask, &TrainPhoto), &TransientEvidence)| {
            (self.snapped(pending.view, photo, evidence), evidence.psnr)
        };
        Ok(pending.par_iter().zip(&photos).zip(&evidence).map(snap).collect())
    }

    /// The mask of a photo: corrected by hand, else the evidence snapped to the photo's boundaries and the network's
    /// mask.
    fn snapped(&self, view: usize, photo: &TrainPhoto, evidence: &TransientEvidence) -> Mask {
        if let Some(mask) = &photo.transients {
            return mask.clone();
        }
        let found = match &evidence.certainty {
            Some(certainty) => match self.segmenter.refine(&photo.image, certainty) {
                Ok(snapped) => snapped.mask,
                // The provider finds no object there: the comparison with the scene decides alone.
                Err(_) => {
                    let (w, h) = (certainty.width as u32, certainty.height as u32);
                    Mask::over(w, h, certainty.plane(0), 0.5)
                        .resized(photo.image.width as u32, photo.image.height as u32)
                }
            },
            None => Mask::empty(photo.image.width as u32, photo.image.height as u32),
        };
        self.known.network_mask(view).map_or(found.clone(), |known| found.or(&known))
    }
}

/// PSNR in dB under which a photo does not fit the scene. If hardly any of it is transient, the reason is another one.
const MISFIT: f32 = 12.0;

/// What is odd about a photo's mask, in a sentence: nearly all of the photo is transient, or hardly any of a photo that
/// does not fit the scene at all.
pub(super) fn odd(photo: &str, image: &str, mask: &Mask, psnr: f32) -> Option<String> {
    let share = share_of(mask);
    let percent = 100.0 * share;
    if share > MOST {
        return Some(format!(
            "photo {photo}: {percent:.0} % of it contradicts the scene; correct {FOLDER}/{image}, or leave the photo out"
        ));
    }
    (psnr < MISFIT && share < 0.05).then(|| {
        format!(
            "photo {photo} does not fit the scene ({psnr:.1} dB), and only {percent:.0} % of it is found to be transient: its \
             pose may be wrong, or its light beyond what the appearance model fits; paint its transients into {FOLDER}/{image}, or \
             leave it out"
        )
    })
}

/// Share of a photo that its mask covers, 0 to 1.
pub(super) fn share_of(mask: &Mask) -> f32 {
    mask.count() as f32 / (f64::from(mask.width()) * f64::from(mask.height())).max(1.0) as f32
}

/// A photo of which more than this share contradicts the scene is crowded. Fewer transients are found than there are:
/// where transients truly cover 25 % about 20 % is found, and hardly more however much they cover.
const CROWDED: f32 = 0.2;
/// A run warns when more than this share of its photos is crowded.
const MANY: f32 = 0.34;

/// The warning when many photos contradict the scene. `shares` has the transient share of each photo.
pub(super) fn crowded(shares: &[f32]) -> Option<String> {
    let many = shares.iter().filter(|s| **s > CROWDED).count();
    (shares.len() > 2 && many as f32 > MANY * shares.len() as f32).then(|| {
        format!(
            "in {many} of {} photos more than {:.0} % contradicts the scene: transients in most of them, light beyond what the \
             appearance model fits, or poses that do not fit",
            shares.len(),
            100.0 * CROWDED
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_of_everything_and_one_of_nothing_are_named() {
        let words = |mask: &Mask, psnr| odd("a.jpg", "a.png", mask, psnr);
        let all = words(&Mask::full(40, 30), 20.0).expect("all of it");
        assert!(all.contains("a.jpg") && all.contains("100 %") && all.contains("transients/a.png"), "{all}");
        let none = words(&Mask::empty(40, 30), 9.0).expect("nothing, and it does not fit");
        assert!(none.contains("a.jpg") && none.contains("9.0 dB"), "{none}");
        assert!(words(&Mask::empty(40, 30), 25.0).is_none(), "it fits, and shows no transient");
        assert!(words(&Mask::from_fn(40, 30, |x, _| x < 8), 9.0).is_none(), "transients explain it");
    }
}
