//! A run's session with its objects, shared by all viewers: prompts are queries, answers grow, every operation is kept.

mod act;
mod answer;
mod archive;
mod archive_turn;
mod changes;
mod export;
mod hover;
mod kept;
mod saving;
mod show;
mod state;
mod transients;
mod turns;
mod writes;

pub(crate) use answer::BUSY;
pub(crate) use archive::MaskArchive;
pub(crate) use show::{JPEG_QUALITY, PhotoSearch, three_planes};
pub(crate) use state::REPLACED;
pub use state::{ANSWER_COLOUR, COLOURS, Studio, StudioError};

use crate::document::{Journal, JournalEntry};
use crate::fronts::FrontMaps;
use crate::messages::{
    AnswerMessage, AppearanceMessage, DraftMessage, ListedDescription, ObjectMessage, PhotoDescription,
    RunDescription, ShownPrompts, StateMessage,
};
use crate::photo_splats::PhotoSplats;
use crate::store::SelectionStore;
use archive_turn::MaskArchives;
use segwild_flow::{Stopper, lock};
use segwild_pipeline::{
    Code, ObjectList, RunFolder, Session, SessionOptions, ShownScene, TrainingSnapshot, list_objects,
};
use segwild_scene::statistics::upper_median;
use state::{GrowingAnswer, NO_PHOTO, StudioState};
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Arc, Mutex, OnceLock};
use tokio::sync::watch;

impl Studio {
    /// Opens a run's session and what was done in it before. Objects of an earlier training, and those whose splats are lost,
    /// are requested again by their prompts.
    ///
    /// # Errors
    /// When the run cannot be read, or another process has its session open.
    pub fn open(folder: &RunFolder, name: &str, stopper: &Stopper) -> Result<Arc<Studio>, StudioError> {
        Studio::open_at(folder, name, None, &Code::given(&[]), stopper)
    }

    /// The same for a run that is still trained, as it was at a snapshot. What is kept there is requested again by its prompts once
    /// the scene is trained.
    ///
    /// # Errors
    /// As [`Studio::open`].
    pub fn open_at(
        folder: &RunFolder,
        name: &str,
        snapshot: Option<&TrainingSnapshot>,
        code: &Code,
        stopper: &Stopper,
    ) -> Result<Arc<Studio>, StudioError> {
        let (code, settings) = (code.clone(), folder.settings()?.segment);
        // Snapshots are replaced by the next one, most of them without a click.
        let neighbours = snapshot.is_none().then_some(settings.neighbours);
        let options =
            SessionOptions { code, neighbours, stopper: stopper.clone(), ..SessionOptions::default() };
        let session = match snapshot {
            Some(snapshot) => Session::open_snapshot(folder, snapshot, options)?,
            None => Session::open(folder, options)?,
        };
        let listed = match (session.tree(), ObjectList::read(folder)) {
            (None, _) => None,
            (Some(_), Some(list)) if list.is_of(&session) => Some(list),
            (Some(_), _) => Some(list_objects(&session, stopper)?.list),
        };
        let own = folder.path().join("studio");
        let scene = match snapshot {
            Some(snapshot) => format!("training, step {}", snapshot.step),
            None => session.training().unwrap_or_default().to_owned(),
        };
        let opened = Journal::open(&own.join("session.jsonl"), &scene)?;
        let store = SelectionStore::new(&own.join("selections"), session.model().splats.len());
        let mut notes = Vec::new();
        if opened.skipped > 0 {
            notes.push(format!(
                "{} lines of session.jsonl could not be read and are left out",
                opened.skipped
            ));
        }
        let state = StudioState {
            document: opened.document,
            journal: opened.journal,
            store,
            answer: GrowingAnswer::default(),
            aside: Stopper::new(),
            saving: Vec::new(),
            revision: 1,
            sequence: 1,
            notes,
        };
        let studio = Arc::new(Studio {
            name: name.to_owned(),
            snapshot: snapshot.map(|snapshot| snapshot.step),
            session,
            settings,
            listed,
            state: Mutex::new(state),
            changes: watch::Sender::new(1),
            fronts: FrontMaps::default(),
            photo_splats: PhotoSplats::default(),
            graph: OnceLock::new(),
            shown: Mutex::new(Vec::new()),
            kept: Mutex::default(),
            turns: Mutex::default(),
            prepared: AtomicUsize::new(NO_PHOTO),
            preparing: AtomicBool::new(false),
            writes: Mutex::default(),
            archives: MaskArchives::default(),
            stopper: stopper.clone(),
        });
        studio.recover(opened.earlier);
        studio.ask_again();
        Ok(studio)
    }

    /// Follows the messages that the state was sent in ([`StateMessage::sequence`]).
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// The session.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// About how many bytes it takes in memory.
    pub fn bytes(&self) -> usize {
        let shown = ShownScene::bytes_of(lock(&self.shown).iter().map(|cached| &*cached.scene));
        // Who changes the state may take long: nobody waits for the size of the present answer.
        let present = self.state.try_lock().ok().and_then(|state| state.answer.done.clone());
        let answers = lock(&self.kept).bytes_with(present.as_ref());
        self.session.bytes()
            + self.fronts.bytes()
            + self.photo_splats.bytes()
            + shown
            + answers
            + self.archives.bytes()
    }

    /// The step of the training that the scene is of; `None` where the training is over.
    pub fn snapshot(&self) -> Option<u32> {
        self.snapshot
    }

    /// Whether nothing was requested yet.
    pub fn is_untouched(&self) -> bool {
        let state = self.state();
        state.document.objects().draft.is_empty() && state.document.objects().all.is_empty()
    }

    /// What does not change.
    pub fn describe(&self) -> RunDescription {
        let scene = self.session.scene();
        let photos = scene.views.iter().map(|view| PhotoDescription {
            name: view.name.clone(),
            camera: view.camera,
            rotation: view.pose.rotation.transpose().to_cols_array(),
            translation: view.pose.translation.to_array(),
            held_out: view.test,
        });
        let listed = self.listed.iter().flat_map(|list| &list.objects).map(|object| ListedDescription {
            number: object.number,
            name: object.label(),
            splats: object.splats,
            photos: object.photos,
            photo: self.photo_named(&object.photo).unwrap_or(0),
        });
        let (centre, up) = self.orientation();
        RunDescription {
            name: self.name.clone(),
            provider: self.session.provider().to_owned(),
            splats: self.session.model().splats.len(),
            size: self.session.size(),
            photos: photos.collect(),
            centre,
            up,
            listed: listed.collect(),
            palette: COLOURS.to_vec(),
            tree: self.session.tree().is_some(),
            snapshot: self.snapshot,
            texts: self.session.tree().is_some() && self.session.answers_texts(),
        }
    }

    /// The middle of the scene as the photos see it, and its up direction: the mean of theirs.
    fn orientation(&self) -> ([f32; 3], [f32; 3]) {
        let views = &self.session.scene().views;
        let up: glam::Vec3 = views.iter().map(|view| -view.pose.rotation.row(1)).sum();
        let means = &self.session.model().splats.means;
        let coordinates = |k: usize| means.iter().map(|mean| mean[k]).collect();
        let middle = [0, 1, 2].map(|k| upper_median(coordinates(k)).unwrap_or(0.0));
        (middle, up.try_normalize().unwrap_or(glam::Vec3::NEG_Y).to_array())
    }

    /// The state as it is now.
    pub fn message(&self) -> StateMessage {
        let state = self.state();
        let objects = state.document.objects();
        let index = |name: &str| self.photo_named(name);
        let shown = objects.draft.prompts.iter().filter_map(|prompts| self.session.prompts_as_shown(prompts));
        StateMessage {
            revision: state.revision,
            sequence: state.sequence,
            draft: DraftMessage {
                prompts: shown.map(|(photo, prompts)| ShownPrompts { photo, prompts }).collect(),
                listed: objects.draft.listed.as_ref().map(|listed| listed.number),
                of: objects.draft.of,
                alternative: objects.draft.alternative,
                text: objects.draft.text.clone(),
            },
            answer: AnswerMessage {
                state: if state.answer.message.state.is_empty() {
                    "none"
                } else {
                    state.answer.message.state
                },
                ..state.answer.message.clone()
            },
            objects: objects.all.iter().map(|object| ObjectMessage::of(object, index)).collect(),
            isolated: objects.isolated,
            appearance: AppearanceMessage::of(&objects.appearance, index),
            corrected: objects.transients.keys().filter_map(|name| index(name)).collect(),
            cut_spikes: !objects.spikes,
            changes: changes::version_of(objects, |_| true),
            undo: state.document.undo_label(),
            redo: state.document.redo_label(),
            notes: state.notes.clone(),
            saving: state.saving.iter().map(|save| save.message).collect(),
        }
    }

    /// Writes an entry and applies it; the answer starts again where the draft changed.
    fn enter(self: &Arc<Self>, state: &mut StudioState, entry: JournalEntry) -> Result<(), StudioError> {
        let mut next = state.document.clone();
        next.enter(&entry)?;
        self.write_transients(state, &next)?;
        state.journal.append(&entry)?;
        if next.objects().transients != state.document.objects().transients {
            // Answers leave transients out.
            lock(&self.kept).clear();
        }
        let draft_changed = next.objects().draft != state.document.objects().draft;
        state.document = next;
        if draft_changed {
            self.start_answer(state);
        }
        self.changed(state);
        Ok(())
    }
}
