//! Answers that grow, and objects that are requested again.

use super::state::{GrowingAnswer, Studio, StudioError, StudioState};
use crate::document::{Document, JournalEntry, KeptObject, ObjectDraft, ObjectId, Operation};
use crate::messages::ConfidenceMessage;
use segwild_flow::{Phase, Stopper};
use segwild_pipeline::{Answer, Replay, RunError, Session};
use segwild_segmenter::SegmentSettings;
use std::sync::{Arc, Weak};
use std::time::{Duration, Instant};

/// Time between two checks whether a person still waits for an answer.
pub(crate) const BUSY: Duration = Duration::from_millis(20);

impl Studio {
    /// Cancels the answer that is being made, and starts the one to the present draft.
    pub(super) fn start_answer(self: &Arc<Self>, state: &mut StudioState) {
        if let Some(stopper) = state.answer.stopper.take() {
            stopper.stop();
        }
        let number = state.answer.message.number + 1;
        let draft = &state.document.objects().draft;
        state.answer = GrowingAnswer::default();
        state.answer.message.number = number;
        if draft.is_empty() {
            return;
        }
        let stopper = Stopper::new();
        let replay = self.replay(draft);
        std::mem::replace(&mut state.aside, Stopper::new()).stop();
        state.answer.message.state = "working";
        state.answer.stopper = Some(stopper.clone());
        let studio = Arc::downgrade(self);
        let work = move || answer(&studio, number, &replay, &stopper);
        if let Err(e) = std::thread::Builder::new().name("studio answer".into()).spawn(work) {
            state.answer.message.state = "failed";
            state.answer.message.error = Some(format!("no thread can be started: {e}"));
        }
    }

    pub(super) fn replay(&self, draft: &ObjectDraft) -> Replay {
        let settings = SegmentSettings { alternative: draft.alternative, ..self.settings.clone() };
        Replay {
            prompts: draft.prompts.clone(),
            object: draft.listed.clone(),
            text: draft.text.clone(),
            settings: Some(settings),
        }
    }

    /// The whole answer to a query beside the one that a person waits for. A click ends it, and it starts again after
    /// the click's answer: queries are answered one after the other. `cancel` ends it for good, if whoever stops it stops
    /// [`StudioState::aside`] as well.
    ///
    /// # Errors
    /// As [`Session::ask`] and [`segwild_pipeline::PendingAnswer::wait`].
    pub(super) fn answer_aside(&self, replay: &Replay, cancel: &Stopper) -> Result<Answer, RunError> {
        let settings = self.settings_of(replay);
        loop {
            if [&self.stopper, cancel].into_iter().any(|stopper| stopper.phase() != Phase::Running) {
                return Err(RunError::Interrupted);
            }
            let state = self.state();
            let (busy, stopper) = (state.answer.message.state == "working", state.aside.clone());
            drop(state);
            if busy {
                std::thread::park_timeout(BUSY);
                continue;
            }
            let pending = self.session.ask(replay, &settings, &stopper);
            match pending.and_then(|pending| pending.wait(|_, _| ())) {
                Err(RunError::Interrupted) if stopper.phase() != Phase::Running => {}
                answer => return answer,
            }
        }
    }

    pub(super) fn settings_of(&self, replay: &Replay) -> SegmentSettings {
        replay.settings.clone().unwrap_or_else(|| self.settings.clone())
    }

    /// Changes the answer of a number, if it is still the present one; returns whether it is.
    pub(super) fn update(&self, number: u64, change: impl FnOnce(&mut GrowingAnswer)) -> bool {
        let mut state = self.state();
        if state.answer.message.number != number {
            return false;
        }
        change(&mut state.answer);
        self.changed(&mut state);
        true
    }

    /// After a restart: the draft's answer is not kept, so it is requested again.
    pub(super) fn ask_again(self: &Arc<Self>) {
        let mut state = self.state();
        self.start_answer(&mut state);
        self.changed(&mut state);
    }

    /// Asks again for objects whose splats are lost or of an earlier training.
    pub(super) fn recover(self: &Arc<Self>, earlier: Option<Document>) {
        let mut state = self.state();
        let mut lost: Vec<(KeptObject, Option<ObjectId>)> = Vec::new();
        for object in state.document.objects().all.clone() {
            if state.store.get(&object.selection).is_none() {
                let id = Some(object.id);
                lost.push((object, id));
            }
        }
        if let Some(earlier) = earlier {
            state
                .notes
                .push("the scene was trained again: its objects are selected again by their prompts".into());
            lost.extend(earlier.objects().all.iter().map(|object| (object.clone(), None)));
        }
        if lost.is_empty() {
            return;
        }
        drop(state);
        let studio = Arc::downgrade(self);
        let work = move || lost.into_iter().for_each(|(object, of)| recover_one(&studio, &object, of));
        if let Err(e) = std::thread::Builder::new().name("studio recovery".into()).spawn(work) {
            self.note(format!("no thread can be started to select objects again: {e}"));
        }
    }

    pub(super) fn note(&self, text: String) {
        let mut state = self.state();
        state.notes.push(text);
        self.changed(&mut state);
    }
}

/// Waits for an answer and shows its steps.
fn answer(studio: &Weak<Studio>, number: u64, replay: &Replay, stopper: &Stopper) {
    let began = Instant::now();
    let Some(pending) = studio.upgrade().map(|s| s.session.ask(replay, &s.settings_of(replay), stopper))
    else {
        return;
    };
    let show = |change: &dyn Fn(&mut GrowingAnswer)| {
        if let Some(studio) = studio.upgrade() {
            studio.update(number, |answer| {
                change(answer);
                answer.message.seconds = began.elapsed().as_secs_f64();
            });
        }
    };
    let result = pending.and_then(|pending| {
        pending.wait(|step, selected| {
            let selected = Arc::new(selected);
            show(&|answer| {
                answer.message.step = Some(step);
                answer.message.splats = selected.labels.iter().filter(|label| **label).count();
                answer.selected = Some(selected.clone());
            });
        })
    });
    match result {
        Ok(done) => {
            let (selected, done) = (Arc::new(Session::selected(&done)), Arc::new(done));
            let sure = &done.segmented.confidence;
            let sure = studio.upgrade().map(|s| ConfidenceMessage::of(sure, |name| s.photo_named(name)));
            show(&|answer| {
                answer.message.state = "done";
                answer.message.splats = selected.labels.iter().filter(|label| **label).count();
                answer.message.alternatives.clone_from(&done.segmented.alternatives);
                answer.message.confidence.clone_from(&sure);
                let matches = done.ranking.iter().flat_map(|ranking| &ranking.matches);
                answer.message.scores = matches.map(|found| found.score).collect();
                answer.selected = Some(selected.clone());
                answer.done = Some(done.clone());
            });
        }
        // One that a further click has ended is not the present one any more; one that ends with the server has failed.
        Err(error) => show(&|answer| {
            answer.message.state = "failed";
            answer.message.error = Some(error.to_string());
            answer.message.splats = 0;
            answer.selected = None;
        }),
    }
}

/// Asks again for an object whose splats are lost. Without `of` it becomes a new object of the same name.
fn recover_one(studio: &Weak<Studio>, object: &KeptObject, of: Option<ObjectId>) {
    let Some(studio) = studio.upgrade() else { return };
    let lost = |why: &str| studio.note(format!("object `{}` is lost: {why}", object.name));
    if object.draft.is_empty() {
        return lost("a tool selected it, and the scene was trained again since");
    }
    let replay = studio.replay(&object.draft);
    let answer = match studio.answer_aside(&replay, &Stopper::new()) {
        Ok(answer) => answer,
        Err(error) => return lost(&error.to_string()),
    };
    let mut guard = studio.state();
    let state = &mut *guard;
    let kept = state.store.put(Session::selected(&answer)).map_err(StudioError::from).and_then(|selection| {
        let objects = state.document.objects();
        let (id, name) = (of.unwrap_or(objects.next_id()), objects.free_name(&object.name));
        let draft = objects.draft.clone();
        let keep = Operation::Keep { id, name, draft: ObjectDraft { of, ..object.draft.clone() }, selection };
        studio.enter(state, JournalEntry::Apply(keep))?;
        // What a person was asking for stays.
        match draft.is_empty() {
            true => Ok(()),
            false => studio.enter(state, JournalEntry::Apply(Operation::Draft { draft })),
        }
    });
    drop(guard);
    if let Err(error) = kept {
        lost(&error.to_string());
    }
}
