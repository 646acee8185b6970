//! Objects that are being written as selections: how far each is, and its end.

use super::state::{SaveInProgress, Studio, StudioError, StudioState};
use crate::document::ObjectId;
use crate::messages::SavingMessage;
use segwild_flow::Stopper;
use std::time::{Duration, Instant};

/// Time between two messages how far a save is.
const PAUSE: Duration = Duration::from_millis(250);

/// The save of an object; it is over when this is dropped.
pub(super) struct SaveTurn<'a> {
    studio: &'a Studio,
    id: ObjectId,
    stopper: Stopper,
}

impl Studio {
    /// Notes that an object is being written.
    ///
    /// # Errors
    /// When it is already.
    pub(super) fn start_save(
        &self,
        state: &mut StudioState,
        id: ObjectId,
    ) -> Result<SaveTurn<'_>, StudioError> {
        if state.saving.iter().any(|save| save.message.object == id) {
            return Err(StudioError::Request("this object is being written already"));
        }
        let stopper = Stopper::new();
        let message = SavingMessage { object: id, done: 0, photos: self.session.scene().views.len() };
        state.saving.push(SaveInProgress { message, stopper: stopper.clone(), sent: Instant::now() });
        self.show_again(state);
        Ok(SaveTurn { studio: self, id, stopper })
    }

    /// Ends the writing of an object.
    ///
    /// # Errors
    /// When it is not being written.
    pub(super) fn stop_save(&self, state: &mut StudioState, id: ObjectId) -> Result<(), StudioError> {
        let found = state.saving.iter().find(|save| save.message.object == id);
        let save = found.ok_or(StudioError::Request("this object is not being written"))?;
        save.stopper.stop();
        // Its answer may still be in the making.
        std::mem::replace(&mut state.aside, Stopper::new()).stop();
        Ok(())
    }

    /// Sends the state to all viewers although nothing was done: objects and labels are those of the same revision.
    fn show_again(&self, state: &StudioState) {
        self.changes.send_replace(state.revision);
    }
}

impl SaveTurn<'_> {
    pub fn stopper(&self) -> &Stopper {
        &self.stopper
    }

    /// Notes on how many photos the object is written.
    pub fn progress(&self, done: usize, photos: usize) {
        let mut state = self.studio.state();
        let Some(save) = state.saving.iter_mut().find(|save| save.message.object == self.id) else { return };
        (save.message.done, save.message.photos) = (done, photos);
        if save.sent.elapsed() >= PAUSE {
            save.sent = Instant::now();
            self.studio.show_again(&state);
        }
    }
}

impl Drop for SaveTurn<'_> {
    fn drop(&mut self) {
        let mut state = self.studio.state();
        state.saving.retain(|save| save.message.object != self.id);
        self.studio.show_again(&state);
    }
}
