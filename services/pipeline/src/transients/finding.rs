//! Finds the transients of a photo: by hand and by a network before the training, by comparison with the scene after it.

use super::images::{PendingMask, TransientMaskWriter};
use super::odd::MOST;
use rayon::prelude::*;
use segwild_flow::ActorFailure;
use segwild_scene::Mask;
use segwild_trainer::{TrainPhoto, TransientEvidence, transient_evidence};

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
