//! What a run's session holds for all viewers.

use super::archive_turn::MaskArchives;
use super::kept::KeptAnswers;
use super::turns::ProviderTurns;
use super::writes::WriteQueue;
use crate::document::{Document, DocumentError, Journal, JournalError, ObjectId};
use crate::fronts::FrontMaps;
use crate::messages::{AnswerMessage, SavingMessage};
use crate::photo_splats::PhotoSplats;
use crate::store::SelectionStore;
use segwild_flow::{FileError, Stopper, lock};
use segwild_pipeline::{Answer, ObjectList, Replay, RunError, Selected, Session, ShownScene};
use segwild_scene::SceneError;
use segwild_segmenter::{NeighbourGraph, SegmentSettings};
use std::sync::atomic::{AtomicBool, AtomicUsize};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, Weak};
use std::time::Instant;
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
    /// The request does not fit what is being done at present.
    #[error("{0}")]
    Conflict(&'static str),
}

pub(super) struct StudioState {
    pub(super) document: Document,
    pub(super) journal: Journal,
    pub(super) store: SelectionStore,
    pub(super) answer: GrowingAnswer,
    /// Ends answers that nobody looks at, once a person asks for one.
    pub(super) aside: Stopper,
    /// Objects that are being written, or wait for that.
    pub(super) saving: Vec<SaveInProgress>,
    pub(super) revision: u64,
    /// Counts the messages to viewers: also those that change no revision.
    pub(super) sequence: u64,
    pub(super) notes: Vec<String>,
}

/// An object that is being written as a selection, or waits for that.
pub(super) struct SaveInProgress {
    pub(super) message: SavingMessage,
    pub(super) stopper: Stopper,
    /// When viewers were last sent how far it is.
    pub(super) sent: Instant,
}

/// How a save ended: the name of the selection.
pub(super) type SaveResult = Result<String, StudioError>;

/// The save of an object as it was when that was requested; it is over when this is dropped.
pub(super) struct SaveTurn {
    /// A session is not held by writes that wait.
    pub(super) studio: Weak<Studio>,
    pub(super) id: ObjectId,
    /// Name of the selection.
    pub(super) name: String,
    pub(super) replay: Replay,
    /// The object's splats, where they are not lost.
    pub(super) selected: Option<Arc<Selected>>,
    pub(super) stopper: Stopper,
}

/// A run's session with its objects.
pub struct Studio {
    pub(super) name: String,
    /// The step of the training that the scene is of; `None` where the training is over.
    pub(super) snapshot: Option<u32>,
    pub(super) session: Session,
    pub(super) settings: SegmentSettings,
    pub(super) listed: Option<ObjectList>,
    pub(super) state: Mutex<StudioState>,
    pub(super) changes: watch::Sender<u64>,
    pub(super) fronts: FrontMaps,
    pub(super) photo_splats: PhotoSplats,
    pub(super) graph: OnceLock<NeighbourGraph>,
    pub(super) shown: Mutex<Vec<CachedScene>>,
    pub(super) kept: Mutex<KeptAnswers>,
    /// The provider's turns to find what is under a pointer.
    pub(super) turns: Mutex<ProviderTurns>,
    /// The photo that was prepared for a click last, or [`NO_PHOTO`].
    pub(super) prepared: AtomicUsize,
    /// Whether a photo is prepared now.
    pub(super) preparing: AtomicBool,
    /// Objects that are to be written as selections.
    pub(super) writes: Mutex<WriteQueue<SaveTurn, SaveResult>>,
    /// Archives of masks that are being made.
    pub(super) archives: MaskArchives,
    /// Ends what nobody waits for any more: the server's.
    pub(super) stopper: Stopper,
}

/// Stands for no photo's index.
pub(super) const NO_PHOTO: usize = usize::MAX;

/// An answer that grows.
#[derive(Default)]
pub(super) struct GrowingAnswer {
    pub(super) message: AnswerMessage,
    pub(super) selected: Option<Arc<Selected>>,
    /// The whole answer, once it is done.
    pub(super) done: Option<Arc<Answer>>,
    pub(super) stopper: Option<Stopper>,
}

/// The scene as one revision shows it, with or without marks.
pub(super) struct CachedScene {
    pub(super) revision: u64,
    pub(super) marks: bool,
    pub(super) appearance: Option<usize>,
    /// Names all that is shown but the highlights.
    pub(super) parts: String,
    pub(super) scene: Arc<ShownScene>,
}

impl Studio {
    pub(super) fn state(&self) -> MutexGuard<'_, StudioState> {
        // A panic elsewhere leaves a state that is whole: operations are applied after they were written.
        lock(&self.state)
    }

    pub(super) fn changed(&self, state: &mut StudioState) {
        state.revision += 1;
        self.show_again(state);
    }

    /// Sends the state to all viewers: objects and labels may be those of the same revision.
    pub(super) fn show_again(&self, state: &mut StudioState) {
        state.sequence += 1;
        self.changes.send_replace(state.sequence);
    }

    pub(super) fn photo_named(&self, name: &str) -> Option<usize> {
        self.session.scene().view_named(name)
    }

    pub(super) fn check_photo(&self, photo: usize) -> Result<(), StudioError> {
        let known = photo < self.session.scene().views.len();
        if known { Ok(()) } else { Err(StudioError::Request("there is no such photo")) }
    }
}

impl Studio {
    /// Ends the answers that are being made, and the writes.
    pub(crate) fn stop_answers(&self) {
        self.end_writes();
        let mut state = self.state();
        state.aside.stop();
        if let Some(stopper) = state.answer.stopper.take() {
            stopper.stop();
        }
    }
}

impl Drop for Studio {
    fn drop(&mut self) {
        self.stop_answers();
    }
}

/// The splats of an object are needed and not there.
pub(super) const LOST: StudioError =
    StudioError::Request("the splats of this object are lost: refine it to ask for it again");

/// A newer scene has taken the session's stead.
pub(crate) const REPLACED: StudioError =
    StudioError::Conflict("the scene was replaced meanwhile: request it again");

pub(super) fn mark(to: &mut [u8], labels: &[bool], with: u8) {
    to.iter_mut().zip(labels).filter(|(_, label)| **label).for_each(|(to, _)| *to = with);
}
