//! Objects that are written as selections, or wait for that: how far each is, and its end.

use super::export::file_stem;
use super::state::{SaveInProgress, SaveResult, SaveTurn, Studio, StudioError, StudioState};
use super::writes::{QueuedWrite, WriteOfObject};
use crate::document::ObjectId;
use crate::messages::SavingMessage;
use segwild_flow::{Phase, Stopper, lock};
use segwild_pipeline::RunError;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};
use tokio::sync::oneshot;

/// Time between two messages how far a save is.
const PAUSE: Duration = Duration::from_millis(250);

/// The writing was ended by a person, or with the session.
const STOPPED: StudioError = StudioError::Request("the writing of this object was stopped");

impl WriteOfObject for SaveTurn {
    fn object(&self) -> ObjectId {
        self.id
    }
}

/// The thread that writes objects as selections. A write may need a whole answer, which gives way to clicks: it may take minutes,
/// and the threads of the server are for those who click. Between two writes it holds no session.
struct WriteThread(Weak<Studio>);

impl WriteThread {
    fn run(&self) {
        let WriteThread(studio) = self;
        while let Some(studio) = studio.upgrade() {
            if studio.stopper.phase() != Phase::Running {
                return studio.end_writes();
            }
            let next = lock(&studio.writes).take();
            let Some(QueuedWrite { write, written }) = next else { return };
            let ended = studio.write(&write);
            drop(write);
            // Who waited may have gone: the object is written all the same.
            let _ = written.send(ended);
        }
    }
}

impl Drop for WriteThread {
    fn drop(&mut self) {
        let WriteThread(studio) = self;
        if let (true, Some(studio)) = (std::thread::panicking(), studio.upgrade()) {
            // Those that wait get an answer, and the next one starts a thread. They are dropped without the queue's lock.
            let waiting = std::mem::take(&mut *lock(&studio.writes));
            drop(waiting);
        }
    }
}

impl Studio {
    /// Writes an object as it is now as a selection of the run, as `segwild segment` does, after the writes that were requested
    /// before. What is returned receives the selection's name. The state has how far it is.
    ///
    /// # Errors
    /// When there is no such object, tools made or changed it, it is being written already, too many writes wait, or no thread can
    /// be started.
    pub fn save_in_turn(
        self: &Arc<Self>,
        id: ObjectId,
    ) -> Result<oneshot::Receiver<Result<String, StudioError>>, StudioError> {
        let mut guard = self.state();
        let state = &mut *guard;
        let object = state.document.objects().get(id)?.clone();
        if object.draft.is_empty() || object.edited {
            return Err(StudioError::Request(
                "a tool made or changed this object: its splats can be exported, but a selection of the run is made by prompts alone",
            ));
        }
        if state.saving.iter().any(|save| save.message.object == id) {
            return Err(StudioError::Conflict("this object is being written already"));
        }
        // Whoever needs both locks takes that of the state first.
        let mut writes = lock(&self.writes);
        if writes.has_ended() {
            return Err(STOPPED);
        }
        if writes.is_full() {
            return Err(StudioError::Conflict("too many objects wait to be written: write this one later"));
        }
        if writes.is_idle() {
            // It waits for the lock, and then finds the write.
            let thread = WriteThread(Arc::downgrade(self));
            let started =
                std::thread::Builder::new().name("studio writes".into()).spawn(move || thread.run());
            started.map_err(|_| StudioError::Request("no thread can be started to write it: try again"))?;
        }
        let stopper = Stopper::new();
        let turn = SaveTurn {
            studio: Arc::downgrade(self),
            id,
            name: file_stem(&object.name),
            replay: self.replay(&object.draft),
            selected: state.store.get(&object.selection),
            stopper: stopper.clone(),
        };
        let message = SavingMessage { object: id, done: 0, photos: self.session.scene().views.len() };
        state.saving.push(SaveInProgress { message, stopper, sent: Instant::now() });
        let answer = writes.add(turn);
        drop(writes);
        self.show_again(state);
        Ok(answer)
    }

    /// Writes an object.
    fn write(&self, turn: &SaveTurn) -> SaveResult {
        let SaveTurn { name, replay, selected, stopper, .. } = turn;
        if stopper.phase() != Phase::Running {
            return Err(STOPPED);
        }
        let known = selected.as_ref().and_then(|selected| lock(&self.kept).find(replay, selected));
        let answer = match known {
            Some(answer) => Ok(answer),
            None => self.answer_aside(replay, stopper).map(Arc::new),
        };
        let saved = answer.and_then(|answer| {
            let progress = |done, photos| self.show_progress(turn, done, photos);
            self.session.save_watched(name, &answer, stopper, &progress)
        });
        match saved {
            Ok(_) => Ok(name.clone()),
            Err(RunError::Interrupted) => Err(STOPPED),
            Err(error) => Err(error.into()),
        }
    }

    /// Notes on how many photos an object is written.
    fn show_progress(&self, turn: &SaveTurn, done: usize, photos: usize) {
        let mut state = self.state();
        let Some(save) = state.saving.iter_mut().find(|save| save.message.object == turn.id) else { return };
        if done < photos && save.sent.elapsed() < PAUSE {
            return;
        }
        (save.message.done, save.message.photos) = (done, photos);
        save.sent = Instant::now();
        self.show_again(&mut state);
    }

    /// Ends the writing of an object, or takes it out of those that wait.
    ///
    /// # Errors
    /// When it is not being written.
    pub(super) fn stop_save(&self, state: &mut StudioState, id: ObjectId) -> Result<(), StudioError> {
        let found = state.saving.iter().find(|save| save.message.object == id);
        let save = found.ok_or(StudioError::Request("this object is not being written"))?;
        save.stopper.stop();
        let waiting = lock(&self.writes).remove(id);
        let Some(QueuedWrite { mut write, written }) = waiting else {
            // Its answer may still be in the making.
            std::mem::replace(&mut state.aside, Stopper::new()).stop();
            return Ok(());
        };
        state.saving.retain(|save| save.message.object != id);
        self.show_again(state);
        // Whoever holds the state's lock drops no save that would take it.
        write.studio = Weak::new();
        let _ = written.send(Err(STOPPED));
        Ok(())
    }

    /// Ends all writes, those that wait as well, and takes no more: the session is put away, or the server ends.
    pub(crate) fn end_writes(&self) {
        let waiting = {
            let mut state = self.state();
            if !state.saving.is_empty() {
                state.saving.iter().for_each(|save| save.stopper.stop());
                std::mem::replace(&mut state.aside, Stopper::new()).stop();
            }
            lock(&self.writes).end()
        };
        for QueuedWrite { write, written } in waiting {
            drop(write);
            let _ = written.send(Err(STOPPED));
        }
    }

    /// Whether objects are being written.
    pub(crate) fn is_writing(&self) -> bool {
        !lock(&self.writes).is_idle()
    }
}

impl Drop for SaveTurn {
    fn drop(&mut self) {
        let Some(studio) = self.studio.upgrade() else { return };
        let mut state = studio.state();
        state.saving.retain(|save| save.message.object != self.id);
        studio.show_again(&mut state);
    }
}
