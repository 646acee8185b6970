//! Transients that a person paints: the run's own mask images.

use super::show::label_map;
use super::state::{Studio, StudioError, StudioState};
use crate::document::{Document, Operation};
use crate::messages::LabelMap;
use crate::regions::{Combination, Region};
use segwild_scene::Mask;

impl Studio {
    /// The operation that changes a photo's transient mask by a region.
    pub(super) fn paint_transients(
        &self,
        state: &StudioState,
        photo: usize,
        region: &Region,
        how: Combination,
    ) -> Result<Operation, StudioError> {
        self.check_photo(photo)?;
        if let Some(flaw) = region.flaw() {
            return Err(StudioError::Request(flaw));
        }
        let view = &self.session.scene().views[photo];
        if view.test {
            return Err(StudioError::Request("this photo is held out: it is not trained on"));
        }
        let own = self.session.transient_mask(photo);
        let before = match (state.document.objects().transients.get(&view.name), &own) {
            (Some([_, before]), _) => before.clone(),
            (None, Some(mask)) => state.store.put_mask(mask)?,
            (None, None) => String::new(),
        };
        let (width, height) = match &own {
            Some(mask) => (mask.width(), mask.height()),
            None => (view.camera.width, view.camera.height),
        };
        let old = own.unwrap_or_else(|| Mask::empty(width, height));
        let scale = [view.camera.width as f32 / width as f32, view.camera.height as f32 / height as f32];
        let mask = Mask::from_fn(width, height, |x, y| {
            let taken = [(x as f32 + 0.5) * scale[0], (y as f32 + 0.5) * scale[1]];
            let inside = view.from_taken(taken).is_some_and(|at| region.holds(at.into()));
            let mut pixel = [old.get(x, y)];
            how.apply(&mut pixel, &[inside]);
            pixel[0]
        });
        let mask = state.store.put_mask(&mask)?;
        Ok(Operation::Transients { photo: view.name.clone(), mask, before })
    }

    /// Writes the transient masks that an operation, or its undoing, changes.
    pub(super) fn write_transients(&self, state: &StudioState, next: &Document) -> Result<(), StudioError> {
        let (now, then) = (&state.document.objects().transients, &next.objects().transients);
        let added = then.iter().filter(|(name, _)| !now.contains_key(*name));
        for (name, [_, before]) in now.iter().chain(added) {
            let wanted = then.get(name).map_or(before, |[wanted, _]| wanted);
            if now.get(name).map_or(before, |[present, _]| present) == wanted {
                continue;
            }
            let lost = StudioError::Request("the mask of these transients is lost: paint it again");
            let Some(photo) = self.photo_named(name) else { continue };
            let empty = || self.session.transient_mask(photo).map(|m| Mask::empty(m.width(), m.height()));
            let wanted = if wanted.is_empty() { empty() } else { state.store.mask(wanted) };
            self.session.correct_transients(photo, &wanted.ok_or(lost)?)?;
        }
        Ok(())
    }

    /// The mask of a photo's transients, as labels of the photo's pixels.
    ///
    /// # Errors
    /// When there is no such photo.
    pub fn transients(&self, photo: usize) -> Result<LabelMap, StudioError> {
        self.check_photo(photo)?;
        let camera = self.session.working_camera(photo);
        let revision = self.state().revision;
        let taken = self.session.transient_mask(photo);
        let mask = taken.map(|mask| self.session.scene().views[photo].mask_from_taken(mask));
        let mask = mask.unwrap_or_else(|| Mask::empty(1, 1)).resized(camera.width, camera.height);
        Ok(label_map(&mask, revision))
    }
}
