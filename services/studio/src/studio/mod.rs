//! A run's session with its objects, shared by all viewers: prompts are asked, answers grow, every operation is kept.

mod act;
mod answer;
mod export;
mod show;
mod transients;

use crate::document::{Document, DocumentError, Journal, JournalEntry, JournalError};
use crate::fronts::FrontMaps;
use crate::messages::{
    AnswerMessage, AppearanceMessage, DraftMessage, ListedDescription, ObjectMessage, PhotoDescription,
    RunDescription, ShownPrompts, StateMessage,
};
use crate::store::SelectionStore;
use answer::GrowingAnswer;
use segwild_flow::{FileError, Stopper};
use segwild_pipeline::{
    ObjectList, RunError, RunFolder, Session, SessionOptions, TrainingSnapshot, list_objects,
};
use segwild_scene::SceneError;
use segwild_segmenter::{NeighbourGraph, SegmentSettings};
use show::CachedScene;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tokio::sync::watch;

/// Colours of objects, sRGB: apart from one another for most eyes, and from the answer's.
pub const COLOURS: [[u8; 3]; crate::document::PALETTE] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [0, 114, 178],
    [213, 94, 0],
    [204, 121, 167],
    [148, 103, 189],
    [140, 200, 90],
    [120, 220, 210],
    [250, 150, 130],
    [170, 170, 180],
];

/// Colour of the answer.
pub const ANSWER_COLOUR: [u8; 3] = [255, 64, 160];

/// Why something cannot be done.
#[derive(Debug, thiserror::Error)]
pub enum StudioError {
    /// The session cannot do it.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The operation does not fit.
    #[error(transparent)]
    Document(#[from] DocumentError),
    /// The journal cannot be used.
    #[error(transparent)]
    Journal(#[from] JournalError),
    /// A file cannot be written.
    #[error(transparent)]
    File(#[from] FileError),
    /// A mask cannot be written.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The request makes no sense.
    #[error("{0}")]
    Request(&'static str),
}

struct StudioState {
    document: Document,
    journal: Journal,
    store: SelectionStore,
    answer: GrowingAnswer,
    revision: u64,
    notes: Vec<String>,
}

/// A run's session with its objects.
pub struct Studio {
    name: String,
    /// The step of the training that the scene is of; `None` where the training is over.
    snapshot: Option<u32>,
    session: Session,
    settings: SegmentSettings,
    listed: Option<ObjectList>,
    state: Mutex<StudioState>,
    changes: watch::Sender<u64>,
    fronts: FrontMaps,
    graph: OnceLock<NeighbourGraph>,
    shown: Mutex<Vec<CachedScene>>,
}

impl Studio {
    /// Opens a run's session and what was done in it before. Objects of an earlier training, and those whose splats are lost,
    /// are asked for again by their prompts.
    ///
    /// # Errors
    /// When the run cannot be read, or another process has its session open.
    pub fn open(folder: &RunFolder, name: &str, stopper: &Stopper) -> Result<Arc<Studio>, StudioError> {
        Studio::open_at(folder, name, None, stopper)
    }

    /// The same for a run that is still trained, as it was at a snapshot. What is kept there is asked for again by its prompts once
    /// the scene is trained.
    ///
    /// # Errors
    /// As [`Studio::open`].
    pub fn open_at(
        folder: &RunFolder,
        name: &str,
        snapshot: Option<&TrainingSnapshot>,
        stopper: &Stopper,
    ) -> Result<Arc<Studio>, StudioError> {
        let options = SessionOptions { stopper: stopper.clone(), ..SessionOptions::default() };
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
        let settings = folder.settings()?.segment;
        let state = StudioState {
            document: opened.document,
            journal: opened.journal,
            store,
            answer: GrowingAnswer::default(),
            revision: 1,
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
            graph: OnceLock::new(),
            shown: Mutex::new(Vec::new()),
        });
        studio.recover(opened.earlier);
        studio.ask_again();
        Ok(studio)
    }

    fn state(&self) -> MutexGuard<'_, StudioState> {
        // A panic elsewhere leaves a state that is whole: operations are applied after they were written.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn changed(&self, state: &mut StudioState) {
        state.revision += 1;
        self.changes.send_replace(state.revision);
    }

    /// Follows the revision of the state.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// The session.
    pub fn session(&self) -> &Session {
        &self.session
    }

    /// About how many bytes it takes in memory.
    pub fn bytes(&self) -> usize {
        let shown = self.shown.lock().unwrap_or_else(PoisonError::into_inner);
        let shown: usize = shown.iter().map(|cached| cached.scene.bytes()).sum();
        self.session.bytes() + self.fronts.bytes() + shown
    }

    /// The step of the training that the scene is of; `None` where the training is over.
    pub fn snapshot(&self) -> Option<u32> {
        self.snapshot
    }

    /// Whether nobody has asked for anything yet.
    pub fn is_untouched(&self) -> bool {
        let state = self.state();
        state.document.objects().draft.is_empty() && state.document.objects().all.is_empty()
    }

    fn photo_named(&self, name: &str) -> Option<usize> {
        self.session.scene().view_named(name)
    }

    fn check_photo(&self, photo: usize) -> Result<(), StudioError> {
        let known = photo < self.session.scene().views.len();
        if known { Ok(()) } else { Err(StudioError::Request("there is no such photo")) }
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
        }
    }

    /// The middle of the scene as the photos see it, and its up direction: the mean of theirs.
    fn orientation(&self) -> ([f32; 3], [f32; 3]) {
        let views = &self.session.scene().views;
        let up: glam::Vec3 = views.iter().map(|view| -view.pose.rotation.row(1)).sum();
        let mut means = self.session.model().splats.means.clone();
        let mut middle = [0.0; 3];
        if !means.is_empty() {
            for (k, middle) in middle.iter_mut().enumerate() {
                let half = means.len() / 2;
                *middle = means.select_nth_unstable_by(half, |a, b| a[k].total_cmp(&b[k])).1[k];
            }
        }
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
            draft: DraftMessage {
                prompts: shown.map(|(photo, prompts)| ShownPrompts { photo, prompts }).collect(),
                listed: objects.draft.listed.as_ref().map(|listed| listed.number),
                of: objects.draft.of,
                alternative: objects.draft.alternative,
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
            undo: state.document.undo_label(),
            redo: state.document.redo_label(),
            notes: state.notes.clone(),
        }
    }

    /// Writes an entry and applies it; the answer starts again where the draft changed.
    fn enter(self: &Arc<Self>, state: &mut StudioState, entry: JournalEntry) -> Result<(), StudioError> {
        let mut next = state.document.clone();
        next.enter(&entry)?;
        self.write_transients(state, &next)?;
        state.journal.append(&entry)?;
        let draft_changed = next.objects().draft != state.document.objects().draft;
        state.document = next;
        if draft_changed {
            self.start_answer(state);
        }
        self.changed(state);
        Ok(())
    }
}

impl Drop for Studio {
    fn drop(&mut self) {
        if let Some(stopper) = self.state().answer.stopper.take() {
            stopper.stop();
        }
    }
}

/// The splats of an object are needed and not there.
const LOST: StudioError =
    StudioError::Request("the splats of this object are lost: refine it to ask for it again");

fn mark(to: &mut [u8], labels: &[bool], with: u8) {
    to.iter_mut().zip(labels).filter(|(_, label)| **label).for_each(|(to, _)| *to = with);
}
