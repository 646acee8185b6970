//! A run's session with its objects, shared by all viewers: prompts are asked, answers grow, every operation is kept.

use crate::document::{
    Document, DocumentError, Journal, JournalEntry, JournalError, KeptObject, ObjectDraft, ObjectId,
    Operation,
};
use crate::fronts::{FrontMap, FrontMaps};
use crate::messages::{
    ANSWER_LABEL, AnswerMessage, AppearanceMessage, DraftMessage, FrameRequest, HIDDEN_LABEL, HoverRequest,
    LabelMap, ListedDescription, ObjectMessage, PhotoDescription, PickRequest, PickedPixel, RunDescription,
    ShownPrompts, StateMessage, StudioAction,
};
use crate::regions::{Combination, Region};
use crate::store::SelectionStore;
use segwild_flow::{FileError, Stopper};
use segwild_pipeline::{
    BlendedAppearance, ObjectList, Replay, RunError, RunFolder, Selected, Session, SessionOptions,
    ShownParts, ShownScene, TrainingSnapshot, list_objects,
};
use segwild_scene::{Image, Mask, NEAR, PointPrompt, Prompts, SceneError};
use segwild_segmenter::scene_tree::{NONE, TreeQuery};
use segwild_segmenter::{NeighbourGraph, SegmentSettings};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, Weak};
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

/// Neighbours of a splat that grow and shrink step to.
const NEIGHBOURS: usize = 10;

/// Steps of grow and shrink at most.
const MOST_STEPS: i32 = 32;

/// Prompts of one query at most.
const MOST_PROMPTS: usize = 256;

/// Quality of JPEGs that are sent to the page.
const JPEG_QUALITY: u8 = 88;

/// Photos that are tried for what a pixel of the 3D view shows.
const TRIED_PHOTOS: usize = 8;

/// Relative depth by which a point may lie behind what a photo shows there.
const SAME_DEPTH: f32 = 0.03;

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

/// An answer that grows.
#[derive(Default)]
struct GrowingAnswer {
    message: AnswerMessage,
    selected: Option<Arc<Selected>>,
    stopper: Option<Stopper>,
}

struct StudioState {
    document: Document,
    journal: Journal,
    store: SelectionStore,
    answer: GrowingAnswer,
    revision: u64,
    notes: Vec<String>,
}

/// The scene as one revision shows it, with or without marks.
struct CachedScene {
    revision: u64,
    marks: bool,
    appearance: Option<usize>,
    scene: Arc<ShownScene>,
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
                prompts: shown.map(|(photo, prompts)| ShownPrompts::of(photo, prompts)).collect(),
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

    /// Does what a person wants.
    ///
    /// # Errors
    /// When it does not fit, or cannot be written.
    pub fn act(self: &Arc<Self>, action: StudioAction) -> Result<(), StudioError> {
        let mut guard = self.state();
        let state = &mut *guard;
        let objects = state.document.objects();
        let operation = match action {
            StudioAction::Undo => return self.enter(state, JournalEntry::Undo),
            StudioAction::Redo => return self.enter(state, JournalEntry::Redo),
            StudioAction::Prompt { prompts, alternative } => {
                let prompts = self.as_taken(&prompts)?;
                let of = objects.draft.of.filter(|_| !prompts.is_empty());
                Operation::Draft { draft: ObjectDraft { prompts, listed: None, alternative, of } }
            }
            StudioAction::Listed { number } => {
                let list =
                    self.listed.as_ref().ok_or(StudioError::Request("this run has no list of objects"))?;
                let listed = Some(list.query(&number.to_string())?);
                Operation::Draft { draft: ObjectDraft { listed, ..ObjectDraft::default() } }
            }
            StudioAction::Refine { id } => {
                let object = objects.get(id)?;
                if object.draft.is_empty() {
                    return Err(StudioError::Request(
                        "a tool made this object: it has no prompts to take up again",
                    ));
                }
                Operation::Draft { draft: ObjectDraft { of: Some(id), ..object.draft.clone() } }
            }
            StudioAction::Keep { name } => {
                let selected = state.answer.selected.clone();
                let selected = selected.ok_or(StudioError::Request("there is no answer to keep yet"))?;
                let draft = objects.draft.clone();
                let wanted = name.unwrap_or_else(|| self.name_for(&draft, objects.next_id()));
                let (id, name) = (draft.of.unwrap_or(objects.next_id()), objects.free_name(&wanted));
                let selection = state.store.put((*selected).clone())?;
                Operation::Keep { id, name, draft, selection }
            }
            StudioAction::Rename { id, name } => Operation::Rename { id, name },
            StudioAction::Show { id, visible } => Operation::Show { id, visible },
            StudioAction::Lock { id, locked } => Operation::Lock { id, locked },
            StudioAction::Isolate { id } => Operation::Isolate { id },
            StudioAction::Colour { id, colour } => Operation::Colour { id, colour },
            StudioAction::Delete { id } => Operation::Delete { id },
            StudioAction::Duplicate { id } => {
                let name = objects.free_name(&objects.get(id)?.name.clone());
                Operation::Duplicate { id, copy: objects.next_id(), name }
            }
            StudioAction::Combine { id, with, how } => {
                let (selection, other) =
                    (objects.get(id)?.selection.clone(), objects.get(with)?.selection.clone());
                let other = state.store.get(&other).ok_or(LOST)?;
                let mut selected = (*state.store.get(&selection).ok_or(LOST)?).clone();
                how.apply(&mut selected.labels, &other.labels);
                Operation::Edit { id, tool: "combine".into(), selection: store(state, selected)? }
            }
            StudioAction::Grow { id, steps } => {
                let selection = objects.get(id)?.selection.clone();
                let mut selected = (*state.store.get(&selection).ok_or(LOST)?).clone();
                self.grow(&mut selected.labels, steps.clamp(-MOST_STEPS, MOST_STEPS));
                let tool = if steps < 0 { "shrink" } else { "grow" };
                Operation::Edit { id, tool: tool.into(), selection: store(state, selected)? }
            }
            StudioAction::Region { id, view, region, how, rule } => {
                if let Some(flaw) = region.flaw() {
                    return Err(StudioError::Request(flaw));
                }
                let (camera, pose) = view.view().map_err(StudioError::Request)?;
                let taken = region.splats(&self.session, &camera, &pose, rule)?;
                match id {
                    Some(id) => {
                        let selection = objects.get(id)?.selection.clone();
                        let mut selected = (*state.store.get(&selection).ok_or(LOST)?).clone();
                        how.apply(&mut selected.labels, &taken);
                        Operation::Edit { id, tool: "region".into(), selection: store(state, selected)? }
                    }
                    None => {
                        let id = objects.next_id();
                        let name = objects.free_name(&format!("object {id}"));
                        let selection = store(state, Selected::of_labels(taken))?;
                        Operation::Paint { id, name, selection }
                    }
                }
            }
            StudioAction::Appearance { id, photo, towards, share } => {
                let appearance =
                    BlendedAppearance { photo: self.lit_by(photo)?, towards: self.lit_by(towards)?, share };
                if !(0.0..=1.0).contains(&share) {
                    return Err(StudioError::Request("a share is from 0 to 1"));
                }
                Operation::Appearance { id, appearance }
            }
            StudioAction::Transients { photo, region, how } => {
                self.paint_transients(state, photo, &region, how)?
            }
            StudioAction::CutSpikes { cut } => Operation::CutSpikes { cut },
        };
        self.enter(state, JournalEntry::Apply(operation))
    }

    /// The name of a photo that has an appearance; empty for the scene's own.
    fn lit_by(&self, photo: Option<usize>) -> Result<String, StudioError> {
        let Some(photo) = photo else { return Ok(String::new()) };
        self.check_photo(photo)?;
        if self.session.model().appearance_index(Some(photo)) != photo {
            return Err(StudioError::Request(
                "this photo took no part in the training: it has no appearance",
            ));
        }
        Ok(self.session.scene().views[photo].name.clone())
    }

    /// The operation that changes a photo's transient mask by a region.
    fn paint_transients(
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
    fn write_transients(&self, state: &StudioState, next: &Document) -> Result<(), StudioError> {
        let (now, then) = (&state.document.objects().transients, &next.objects().transients);
        for (name, [mask, before]) in now.iter().chain(then) {
            let wanted = then.get(name).map_or(before, |[wanted, _]| wanted);
            if now.get(name).map_or(before, |[present, _]| present) == wanted {
                continue;
            }
            let lost = StudioError::Request("the mask of these transients is lost: paint it again");
            let Some(photo) = self.photo_named(name) else { continue };
            let empty = || self.session.transient_mask(photo).map(|m| Mask::empty(m.width(), m.height()));
            let wanted = if wanted.is_empty() { empty() } else { state.store.mask(wanted) };
            self.session.correct_transients(photo, &wanted.ok_or(lost)?)?;
            let _ = mask;
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

    fn as_taken(&self, prompts: &[ShownPrompts]) -> Result<Vec<segwild_pipeline::PhotoPrompts>, StudioError> {
        let many = prompts.iter().map(|p| p.points.len() + p.boxes.len()).sum::<usize>();
        if many > MOST_PROMPTS {
            return Err(StudioError::Request("a query has 256 clicks and boxes at most"));
        }
        let with_prompts = prompts.iter().filter(|p| !p.points.is_empty() || !p.boxes.is_empty());
        let taken = |p: &ShownPrompts| {
            self.check_photo(p.photo)?;
            let outside = StudioError::Request("a click lies outside of its photo");
            self.session.prompts_as_taken(p.photo, &p.prompts()).ok_or(outside)
        };
        with_prompts.map(taken).collect()
    }

    /// The name of a new object: that of the listed one, or a number.
    fn name_for(&self, draft: &ObjectDraft, id: ObjectId) -> String {
        let listed =
            draft.listed.as_ref().and_then(|query| self.listed.as_ref()?.objects.get(query.number - 1));
        let named = listed.map(|object| object.name.clone()).filter(|name| !name.is_empty());
        named.unwrap_or_else(|| format!("object {id}"))
    }

    /// Adds the neighbours of labelled splats, or takes away those with neighbours outside.
    fn grow(&self, labels: &mut [bool], steps: i32) {
        let splats = &self.session.model().splats;
        let graph = self.graph.get_or_init(|| NeighbourGraph::new(splats, NEIGHBOURS));
        let to = steps >= 0;
        for _ in 0..steps.abs() {
            let before = labels.to_vec();
            for i in (0..before.len()).filter(|&i| before[i] == to) {
                for edge in graph.edges(i) {
                    labels[graph.neighbour(edge)] = to;
                }
            }
        }
    }

    /// Cancels the answer that is being made, and starts the one to the present draft.
    fn start_answer(self: &Arc<Self>, state: &mut StudioState) {
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
        state.answer.message.state = "working";
        state.answer.stopper = Some(stopper.clone());
        let studio = Arc::downgrade(self);
        let work = move || answer(&studio, number, &replay, &stopper);
        if let Err(e) = std::thread::Builder::new().name("studio answer".into()).spawn(work) {
            state.answer.message.state = "failed";
            state.answer.message.error = Some(format!("no thread can be started: {e}"));
        }
    }

    fn replay(&self, draft: &ObjectDraft) -> Replay {
        let settings = SegmentSettings { alternative: draft.alternative, ..self.settings.clone() };
        Replay { prompts: draft.prompts.clone(), object: draft.listed.clone(), settings: Some(settings) }
    }

    /// Changes the answer of a number, if it is still the present one; returns whether it is.
    fn update(&self, number: u64, change: impl FnOnce(&mut GrowingAnswer)) -> bool {
        let mut state = self.state();
        if state.answer.message.number != number {
            return false;
        }
        change(&mut state.answer);
        self.changed(&mut state);
        true
    }

    /// After a restart: the draft's answer is not kept, so it is asked for again.
    fn ask_again(self: &Arc<Self>) {
        let mut state = self.state();
        self.start_answer(&mut state);
        self.changed(&mut state);
    }

    /// Asks again for objects whose splats are lost or of an earlier training.
    fn recover(self: &Arc<Self>, earlier: Option<Document>) {
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
                .push("the scene was trained again: its objects are asked for again by their prompts".into());
            lost.extend(earlier.objects().all.iter().map(|object| (object.clone(), None)));
        }
        if lost.is_empty() {
            return;
        }
        drop(state);
        let studio = Arc::downgrade(self);
        let work = move || lost.into_iter().for_each(|(object, of)| recover_one(&studio, &object, of));
        if let Err(e) = std::thread::Builder::new().name("studio recovery".into()).spawn(work) {
            self.note(format!("no thread can be started to ask for objects again: {e}"));
        }
    }

    fn note(&self, text: String) {
        let mut state = self.state();
        state.notes.push(text);
        self.changed(&mut state);
    }

    /// The candidate at a position of a photo, without a click; `None` where there is none.
    ///
    /// # Errors
    /// When the photo cannot be read or rendered.
    pub fn hover(&self, request: &HoverRequest) -> Result<Option<LabelMap>, StudioError> {
        let HoverRequest { photo, x, y, granularity } = *request;
        self.check_photo(photo)?;
        let camera = &self.session.scene().views[photo].camera;
        let share = [x / camera.width as f32, y / camera.height as f32];
        if !share.iter().all(|v| (0.0..1.0).contains(v))
            || granularity.is_some_and(|g| !(0.0..=1.0).contains(&g))
        {
            return Ok(None);
        }
        let Some(tree) = self.session.tree() else {
            let small = self.session.working_camera(photo);
            let point = PointPrompt {
                x: share[0] * small.width as f32,
                y: share[1] * small.height as f32,
                inside: true,
            };
            let prompts = Prompts { points: vec![point], boxes: Vec::new(), granularity };
            return Ok(Some(label_map(&self.session.candidate_mask(photo, &prompts)?, 0)));
        };
        let front = self.fronts.of(&self.session, photo)?;
        let leaf =
            front.at(share[0], share[1]).map(|splat| tree.leaf[splat as usize]).filter(|leaf| *leaf != NONE);
        let Some(leaf) = leaf else { return Ok(None) };
        let query = TreeQuery { inside: &[leaf], outside: &[] };
        let found = match granularity {
            Some(granularity) => tree.candidates_of_size(&query, granularity),
            None => tree.candidates(&query),
        };
        let Some(first) = found.first() else { return Ok(None) };
        let labels = tree.labels(first);
        let runs = front.runs(|splat| if labels[splat as usize] { ANSWER_LABEL } else { 0 });
        Ok(Some(LabelMap { width: front.width, height: front.height, runs, revision: 0 }))
    }

    /// The labels of a photo's pixels: visible objects, and the answer over them.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn labels(&self, photo: usize) -> Result<LabelMap, StudioError> {
        self.check_photo(photo)?;
        let front = self.fronts.of(&self.session, photo)?;
        let (labels, revision) = self.splat_labels();
        let visible = |label| if label == HIDDEN_LABEL { 0 } else { label };
        let runs = front.runs(|splat| visible(labels[splat as usize]));
        Ok(LabelMap { width: front.width, height: front.height, runs, revision })
    }

    /// Per splat, the label of the object or answer that it belongs to or [`HIDDEN_LABEL`], and the revision.
    pub fn splat_labels(&self) -> (Vec<u8>, u64) {
        let mut state = self.state();
        let objects = state.document.objects();
        let alone = objects.isolated;
        let label = |(i, object): (usize, &KeptObject)| {
            let shown = alone.map_or(object.visible, |id| object.id == id);
            (object.selection.clone(), if shown { i as u8 + 1 } else { HIDDEN_LABEL })
        };
        // Of hidden and shown objects that overlap, the shown one counts.
        let mut labelled: Vec<_> = objects.all.iter().enumerate().map(label).collect();
        labelled.sort_by_key(|(_, label)| *label != HIDDEN_LABEL);
        let all = if alone.is_some() { HIDDEN_LABEL } else { 0 };
        let mut labels = vec![all; self.session.model().splats.len()];
        for (selection, label) in labelled {
            if let Some(selected) = state.store.get(&selection) {
                mark(&mut labels, &selected.labels, label);
            }
        }
        if let Some(selected) = &state.answer.selected {
            mark(&mut labels, &selected.labels, ANSWER_LABEL);
        }
        (labels, state.revision)
    }

    /// Pixels of each photo that show an object. Photos on which a person could not see it have few or none.
    ///
    /// # Errors
    /// When there is no such object, or the scene cannot be rendered.
    pub fn photos_of(&self, id: ObjectId) -> Result<Vec<usize>, StudioError> {
        let selected = self.selection_of(id)?;
        let count = |photo: usize| {
            let front = self.fronts.of(&self.session, photo)?;
            let inside = |splat: &&u32| selected.labels.get(**splat as usize).copied().unwrap_or(false);
            Ok(front.splats.iter().filter(inside).count())
        };
        (0..self.session.scene().views.len()).map(count).collect()
    }

    fn selection_of(&self, id: ObjectId) -> Result<Arc<Selected>, StudioError> {
        let mut state = self.state();
        let selection = state.document.objects().get(id)?.selection.clone();
        state.store.get(&selection).ok_or(LOST)
    }

    /// A photo as JPEG, with a long side of at most `size` pixels.
    ///
    /// # Errors
    /// When there is no such photo, or it cannot be read any more.
    pub fn photo(&self, photo: usize, size: u32) -> Result<Vec<u8>, StudioError> {
        self.check_photo(photo)?;
        let image = self.session.photo(photo, size.clamp(16, 4096))?;
        Ok(three_planes(image).to_jpeg(JPEG_QUALITY))
    }

    /// A view of the scene as JPEG.
    ///
    /// # Errors
    /// When the camera is none, or the engine fails.
    pub fn frame(&self, request: &FrameRequest) -> Result<Vec<u8>, StudioError> {
        let (camera, pose) = request.view.view().map_err(StudioError::Request)?;
        let scene = self.shown(request.marks, request.appearance)?;
        let image = match request.background {
            true => self.session.background(&scene, &camera, &pose),
            false => self.session.render(&scene, &camera, &pose)?,
        };
        Ok(image.to_jpeg(JPEG_QUALITY))
    }

    /// The scene as the present state shows it.
    fn shown(&self, marks: bool, appearance: Option<usize>) -> Result<Arc<ShownScene>, StudioError> {
        if let Some(photo) = appearance {
            self.check_photo(photo)?;
        }
        let mut state = self.state();
        let revision = state.revision;
        let mut cached = self.shown.lock().unwrap_or_else(PoisonError::into_inner);
        let same = |c: &&CachedScene| (c.revision, c.marks, c.appearance) == (revision, marks, appearance);
        if let Some(known) = cached.iter().find(same) {
            return Ok(known.scene.clone());
        }
        let objects = state.document.objects().clone();
        let selected: Vec<_> = objects.all.iter().map(|object| state.store.get(&object.selection)).collect();
        let answer = state.answer.selected.clone();
        drop(state);
        let views = &self.session.scene().views;
        let mut parts = ShownParts {
            appearance: match appearance {
                Some(photo) => BlendedAppearance { photo: views[photo].name.clone(), ..Default::default() },
                None => objects.appearance.clone(),
            },
            alone: objects.isolated.is_some(),
            ..ShownParts::default()
        };
        for (object, selected) in objects.all.iter().zip(&selected) {
            let Some(selected) = selected else { continue };
            let isolated = objects.isolated == Some(object.id);
            let hidden = match objects.isolated {
                Some(_) if isolated => Some(false),
                Some(_) => None,
                None if object.visible => None,
                None => Some(true),
            };
            if let Some(hides) = hidden {
                if parts.hidden.is_empty() {
                    parts.hidden = vec![objects.isolated.is_some(); selected.labels.len()];
                }
                let inside = parts.hidden.iter_mut().zip(&selected.labels).filter(|(_, label)| **label);
                inside.for_each(|(hidden, _)| *hidden = hides);
            }
            if !objects.spikes && objects.isolated.is_none_or(|id| id == object.id) {
                parts.cut.push(selected);
            }
            if let Some(own) = &object.appearance {
                parts.appearances.push((&selected.labels, own));
            }
            if marks && object.visible && !isolated {
                parts.highlights.push((&selected.labels, unit(COLOURS[usize::from(object.colour)])));
            }
        }
        if let Some(answer) = answer.as_ref().filter(|_| marks) {
            parts.highlights.push((&answer.labels, unit(ANSWER_COLOUR)));
        }
        let scene = Arc::new(self.session.show(&parts)?);
        cached.retain(|c| c.revision == revision);
        cached.push(CachedScene { revision, marks, appearance, scene: scene.clone() });
        // One with marks, one without, and one of another appearance.
        if cached.len() > 3 {
            cached.remove(0);
        }
        Ok(scene)
    }

    /// The splats for the page's own rasteriser ([`Session::packed_splats`]).
    ///
    /// # Errors
    /// When there is no such photo, or it has no appearance.
    pub fn packed(&self, appearance: Option<usize>) -> Result<Vec<u8>, StudioError> {
        let appearance = match appearance {
            Some(photo) => BlendedAppearance { photo: self.lit_by(Some(photo))?, ..Default::default() },
            None => self.state().document.objects().appearance.clone(),
        };
        Ok(self.session.packed_splats(&appearance)?)
    }

    /// The photo that shows best what a pixel of a view shows; `None` where the pixel shows nothing.
    ///
    /// # Errors
    /// When the camera is none, or the scene cannot be rendered.
    pub fn pick(&self, request: &PickRequest) -> Result<Option<PickedPixel>, StudioError> {
        let (camera, pose) = request.view.view().map_err(StudioError::Request)?;
        let at = glam::Vec2::from(request.at);
        if !camera.contains(at) {
            return Ok(None);
        }
        // One pixel is enough.
        let one = segwild_scene::Camera {
            width: 1,
            height: 1,
            cx: camera.cx - at.x.floor(),
            cy: camera.cy - at.y.floor(),
            ..camera
        };
        let front = FrontMap::from(self.session.front_from(&one, &pose)?);
        let Some(splat) = front.at(0.5, 0.5) else { return Ok(None) };
        let splats = &self.session.model().splats;
        // The point on the ray, at the splat's depth.
        let depth = pose.to_camera(splats.mean(splat as usize)).z;
        let point = pose.rotation.transpose() * (camera.ray(at) * depth - pose.translation);
        let views = &self.session.scene().views;
        let seen = |view: &segwild_scene::View| {
            let p = view.pose.to_camera(point);
            let pixel =
                (p.z > NEAR).then(|| view.camera.pixel(p)).filter(|pixel| view.camera.contains(*pixel))?;
            Some((pixel, p.z, self.session.size() as f32 / view.camera.width.max(view.camera.height) as f32))
        };
        let mut found: Vec<_> = views
            .iter()
            .enumerate()
            .filter(|(_, view)| !view.test)
            .filter_map(|(i, view)| {
                let (pixel, z, scale) = seen(view)?;
                Some((i, pixel, z, view.camera.fx * scale / z))
            })
            .collect();
        found.sort_by(|a, b| b.3.total_cmp(&a.3).then(a.0.cmp(&b.0)));
        let picked = |(photo, pixel): (usize, glam::Vec2)| PickedPixel {
            photo,
            x: pixel.x,
            y: pixel.y,
            point: point.to_array(),
        };
        for &(photo, pixel, z, _) in found.iter().take(TRIED_PHOTOS) {
            let camera = &views[photo].camera;
            let front = self.fronts.of(&self.session, photo)?;
            let share = [pixel.x / camera.width as f32, pixel.y / camera.height as f32];
            let Some(before) = front.at(share[0], share[1]) else { continue };
            let depth = views[photo].pose.to_camera(splats.mean(before as usize)).z;
            if before == splat || depth > z * (1.0 - SAME_DEPTH) {
                return Ok(Some(picked((photo, pixel))));
            }
        }
        Ok(found.first().map(|&(photo, pixel, ..)| picked((photo, pixel))))
    }

    /// An object as a `.ply`, and its name. It has its own appearance where it has one, and the scene's otherwise.
    ///
    /// # Errors
    /// When there is no such object, or its splats are lost.
    pub fn object_ply(&self, id: ObjectId) -> Result<(String, Vec<u8>), StudioError> {
        let selected = self.selection_of(id)?;
        let (object, scene) = {
            let state = self.state();
            let objects = state.document.objects();
            (objects.get(id)?.clone(), objects.appearance.clone())
        };
        let appearance = object.appearance.unwrap_or(scene);
        Ok((object.name, self.session.object_ply(&selected, &appearance)?))
    }

    /// The names of the kept objects, and per splat of the scene the number of its object from 1, 0 for none.
    fn numbered(&self) -> (Vec<String>, Vec<u8>) {
        let mut state = self.state();
        let all = state.document.objects().all.clone();
        let mut labels = vec![0u8; self.session.model().splats.len()];
        for (object, number) in all.iter().zip(1..) {
            if let Some(selected) = state.store.get(&object.selection) {
                mark(&mut labels, &selected.labels, number);
            }
        }
        (all.into_iter().map(|object| object.name).collect(), labels)
    }

    /// The whole scene as a `.ply` whose property `object` numbers the kept objects.
    ///
    /// # Errors
    /// When an appearance is gone.
    pub fn labelled_ply(&self) -> Result<Vec<u8>, StudioError> {
        let appearance = self.state().document.objects().appearance.clone();
        Ok(self.session.labelled_ply(&self.numbered().1, &appearance)?)
    }

    /// The masks of all kept objects on all photos, as a COCO file.
    ///
    /// # Errors
    /// When the scene cannot be rendered.
    pub fn coco(&self) -> Result<Vec<u8>, StudioError> {
        let (names, labels) = self.numbered();
        Ok(self.session.coco_masks(&names, labels, &Stopper::new())?)
    }

    /// Writes an object as a selection of the run, as `segwild segment` does; returns the selection's name.
    ///
    /// # Errors
    /// When tools made or changed the object, or a file cannot be written.
    pub fn save(&self, id: ObjectId) -> Result<String, StudioError> {
        let object = self.state().document.objects().get(id)?.clone();
        if object.draft.is_empty() || object.edited {
            return Err(StudioError::Request(
                "a tool made or changed this object: its splats can be exported, but a selection of the run is made by prompts alone",
            ));
        }
        let plain = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
        let name: String = object.name.chars().map(plain).collect();
        let replay = self.replay(&object.draft);
        let answer =
            self.session.ask(&replay, &self.settings_of(&replay), &Stopper::new())?.wait(|_, _| ())?;
        let selection = name.as_str();
        self.session.save(selection, &answer)?;
        Ok(name)
    }

    /// The sheet of the listed objects' thumbnails, as PNG.
    ///
    /// # Errors
    /// When there is none.
    pub fn sheet(&self) -> Result<Vec<u8>, StudioError> {
        let path = ObjectList::sheet(self.session.folder());
        Ok(segwild_flow::files::read_plain(&path).map_err(|e| FileError::new("read", &path, e))?)
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

fn store(
    state: &mut StudioState,
    selected: Selected,
) -> Result<crate::document::StoredSelection, StudioError> {
    if !selected.labels.contains(&true) {
        return Err(StudioError::Request("nothing would be left of the object"));
    }
    Ok(state.store.put(selected)?)
}

/// A mask as labels.
fn label_map(mask: &Mask, revision: u64) -> LabelMap {
    let (width, height) = (mask.width() as usize, mask.height() as usize);
    let pixels = (0..height as u32).flat_map(|y| (0..width as u32).map(move |x| (x, y)));
    let splats = pixels.map(|(x, y)| u32::from(mask.get(x, y))).collect();
    let map = FrontMap { width, height, splats };
    let runs = map.runs(|inside| if inside == 1 { ANSWER_LABEL } else { 0 });
    LabelMap { width, height, runs, revision }
}

fn mark(to: &mut [u8], labels: &[bool], with: u8) {
    to.iter_mut().zip(labels).filter(|(_, label)| **label).for_each(|(to, _)| *to = with);
}

fn unit(colour: [u8; 3]) -> [f32; 3] {
    colour.map(|c| f32::from(c) / 255.0)
}

/// A photo with exactly three planes.
fn three_planes(mut image: Image) -> Image {
    if image.channels > 3 {
        image.data.truncate(3 * image.pixels());
        image.channels = 3;
    }
    image
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
        pending.wait(|step, labels| {
            show(&|answer| {
                answer.message.step = Some(step);
                answer.message.splats = labels.iter().filter(|label| **label).count();
                answer.selected = Some(Arc::new(Selected::of_labels(labels.to_vec())));
            });
        })
    });
    match result {
        Ok(done) => {
            let selected = Arc::new(Session::selected(&done));
            show(&|answer| {
                answer.message.state = "done";
                answer.message.splats = selected.labels.iter().filter(|label| **label).count();
                answer.message.alternatives.clone_from(&done.segmented.alternatives);
                answer.selected = Some(selected.clone());
            });
        }
        Err(RunError::Interrupted) => {}
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
    let pending = studio.session.ask(&replay, &studio.settings_of(&replay), &Stopper::new());
    let answer = match pending.and_then(|pending| pending.wait(|_, _| ())) {
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

impl Studio {
    fn settings_of(&self, replay: &Replay) -> SegmentSettings {
        replay.settings.clone().unwrap_or_else(|| self.settings.clone())
    }
}
