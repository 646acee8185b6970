//! The objects of a session, and the operations that made them.

mod journal;
mod operation;

pub use journal::{Journal, JournalError, JournalStart};
pub use operation::{JournalEntry, ObjectDraft, ObjectId, Operation, StoredSelection};

use segwild_pipeline::BlendedAppearance;
use serde::Serialize;
use std::collections::BTreeMap;

/// Colours that objects have.
pub const PALETTE: usize = 12;

/// Objects that a session holds at most, deleted ones included: a photo's label map numbers them by bytes.
pub const MOST_OBJECTS: usize = 200;

/// Letters of a name at most.
const LONGEST_NAME: usize = 80;

/// Why an operation is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DocumentError {
    /// There is no such object.
    #[error("there is no object {0}")]
    NoObject(ObjectId),
    /// Nothing was selected that could be shown.
    #[error("there is no answer yet")]
    NoAnswer,
    /// The object is locked.
    #[error("`{0}` is locked: unlock it first")]
    Locked(String),
    /// The name is empty, too long, or has control characters.
    #[error("a name has 1 to {LONGEST_NAME} letters and no control characters")]
    Name,
    /// Another object has the name.
    #[error("another object is named `{0}` already")]
    Taken(String),
    /// There are as many objects as a session may hold.
    #[error("a session holds {MOST_OBJECTS} objects at most")]
    Full,
    /// There is no such colour.
    #[error("there are {PALETTE} colours")]
    NoColour,
    /// There is no operation to undo.
    #[error("there is nothing to undo")]
    NothingToUndo,
    /// There is no operation to redo.
    #[error("there is nothing to redo")]
    NothingToRedo,
}

/// An object.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KeptObject {
    /// Its number.
    pub id: ObjectId,
    /// Its name.
    pub name: String,
    /// Index into the palette.
    pub colour: u8,
    /// Whether it is shown.
    pub visible: bool,
    /// Whether it is locked.
    pub locked: bool,
    /// Its own appearance; `None` where it has the scene's.
    pub appearance: Option<BlendedAppearance>,
    /// What was requested; empty where a tool selected it.
    pub draft: ObjectDraft,
    /// Whether tools changed its splats after the answer.
    pub edited: bool,
    /// Its splats.
    pub selection: StoredSelection,
}

/// The objects, and how they are shown.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Objects {
    /// What is being requested.
    pub draft: ObjectDraft,
    /// The objects, by their numbers.
    pub all: Vec<KeptObject>,
    /// The one that is shown alone.
    pub isolated: Option<ObjectId>,
    /// The appearance of the scene.
    pub appearance: BlendedAppearance,
    /// Masks of transients that were changed, by photo: the present one, and the one before any change.
    pub transients: BTreeMap<String, [String; 2]>,
    /// Whether spikes are shown as they were before the cut.
    pub spikes: bool,
    /// The next object's number.
    next: ObjectId,
}

impl Objects {
    /// An object by its number.
    pub fn get(&self, id: ObjectId) -> Result<&KeptObject, DocumentError> {
        self.all.iter().find(|object| object.id == id).ok_or(DocumentError::NoObject(id))
    }

    /// Whether an object is shown with its spikes cut.
    pub fn cuts(&self, object: &KeptObject) -> bool {
        !self.spikes && self.isolated.is_none_or(|id| id == object.id)
    }

    fn get_mut(&mut self, id: ObjectId) -> Result<&mut KeptObject, DocumentError> {
        self.all.iter_mut().find(|object| object.id == id).ok_or(DocumentError::NoObject(id))
    }

    /// The object if it may be changed.
    fn unlocked(&mut self, id: ObjectId) -> Result<&mut KeptObject, DocumentError> {
        let object = self.get_mut(id)?;
        if object.locked { Err(DocumentError::Locked(object.name.clone())) } else { Ok(object) }
    }

    /// The number that the next object gets.
    pub fn next_id(&self) -> ObjectId {
        self.next.saturating_add(1)
    }

    /// A name that no object has: the given one, with a number if it is taken.
    pub fn free_name(&self, wanted: &str) -> String {
        let taken = |name: &str| self.all.iter().any(|object| object.name.eq_ignore_ascii_case(name));
        if !taken(wanted) {
            return wanted.to_owned();
        }
        (2..).map(|n| format!("{wanted} {n}")).find(|name| !taken(name)).unwrap_or_default()
    }

    fn check_name(&self, name: &str, of: ObjectId) -> Result<(), DocumentError> {
        let length = name.chars().count();
        if length == 0 || length > LONGEST_NAME || name.trim() != name || name.chars().any(char::is_control) {
            return Err(DocumentError::Name);
        }
        let other = |object: &&KeptObject| object.id != of && object.name.eq_ignore_ascii_case(name);
        match self.all.iter().find(other) {
            Some(other) => Err(DocumentError::Taken(other.name.clone())),
            None => Ok(()),
        }
    }

    fn add(&mut self, object: KeptObject) -> Result<(), DocumentError> {
        self.check_name(&object.name, object.id)?;
        if self.all.len() >= MOST_OBJECTS {
            return Err(DocumentError::Full);
        }
        if object.id <= self.next {
            return Err(DocumentError::NoObject(object.id));
        }
        self.next = object.id;
        self.all.push(object);
        Ok(())
    }

    fn new_object(id: ObjectId, name: &str, draft: &ObjectDraft, selection: &StoredSelection) -> KeptObject {
        KeptObject {
            id,
            name: name.to_owned(),
            colour: ((id.max(1) - 1) % PALETTE as u32) as u8,
            visible: true,
            locked: false,
            appearance: None,
            draft: ObjectDraft { of: None, ..draft.clone() },
            edited: false,
            selection: selection.clone(),
        }
    }

    /// Applies an operation, whole or not at all.
    ///
    /// # Errors
    /// When it does not fit the objects.
    pub fn apply(&mut self, operation: &Operation) -> Result<(), DocumentError> {
        match operation {
            Operation::Draft { draft } => {
                if let Some(of) = draft.of {
                    self.unlocked(of)?;
                }
                self.draft = draft.clone();
            }
            Operation::Keep { id, name, draft, selection } => {
                match draft.of {
                    Some(of) => {
                        let object = self.unlocked(of)?;
                        object.draft = ObjectDraft { of: None, ..draft.clone() };
                        (object.selection, object.edited) = (selection.clone(), false);
                    }
                    None => self.add(Objects::new_object(*id, name, draft, selection))?,
                }
                self.draft = ObjectDraft::default();
            }
            Operation::Paint { id, name, selection } => {
                let object = Objects::new_object(*id, name, &ObjectDraft::default(), selection);
                self.add(KeptObject { edited: true, ..object })?;
            }
            Operation::Edit { id, selection, .. } => {
                let object = self.unlocked(*id)?;
                (object.selection, object.edited) = (selection.clone(), true);
            }
            Operation::Rename { id, name } => {
                self.unlocked(*id)?;
                self.check_name(name, *id)?;
                self.get_mut(*id)?.name.clone_from(name);
            }
            Operation::Show { id, visible } => self.get_mut(*id)?.visible = *visible,
            Operation::Lock { id, locked } => self.get_mut(*id)?.locked = *locked,
            Operation::Isolate { id } => {
                if let Some(id) = id {
                    self.get(*id)?;
                }
                self.isolated = *id;
            }
            Operation::Colour { id, colour } => {
                if usize::from(*colour) >= PALETTE {
                    return Err(DocumentError::NoColour);
                }
                self.get_mut(*id)?.colour = *colour;
            }
            Operation::Delete { id } => {
                self.unlocked(*id)?;
                self.all.retain(|object| object.id != *id);
                if self.isolated == Some(*id) {
                    self.isolated = None;
                }
                if self.draft.of == Some(*id) {
                    self.draft = ObjectDraft::default();
                }
            }
            Operation::Duplicate { id, copy, name } => {
                let object = self.get(*id)?.clone();
                let colour = ((copy.max(&1) - 1) % PALETTE as u32) as u8;
                self.add(KeptObject { id: *copy, name: name.clone(), colour, locked: false, ..object })?;
            }
            Operation::Appearance { id, appearance } => match id {
                Some(id) => {
                    let own = *appearance != BlendedAppearance::default();
                    self.unlocked(*id)?.appearance = own.then(|| appearance.clone());
                }
                None => self.appearance.clone_from(appearance),
            },
            Operation::Transients { photo, mask, before } => {
                self.transients
                    .entry(photo.clone())
                    .and_modify(|masks| masks[0].clone_from(mask))
                    .or_insert_with(|| [mask.clone(), before.clone()]);
            }
            Operation::CutSpikes { cut } => self.spikes = !cut,
        }
        Ok(())
    }
}

/// The objects with their past: every operation can be undone.
#[derive(Clone, Debug, Default)]
pub struct Document {
    objects: Objects,
    applied: Vec<Operation>,
    undone: Vec<Operation>,
}

impl Document {
    /// The objects as they are now.
    pub fn objects(&self) -> &Objects {
        &self.objects
    }

    /// What undo would take back, in words.
    pub fn undo_label(&self) -> Option<&'static str> {
        self.applied.last().map(Operation::label)
    }

    /// What redo would do again, in words.
    pub fn redo_label(&self) -> Option<&'static str> {
        self.undone.last().map(Operation::label)
    }

    /// Applies an entry of the journal.
    ///
    /// # Errors
    /// When it does not fit; the document stays as it was.
    pub fn enter(&mut self, entry: &JournalEntry) -> Result<(), DocumentError> {
        match entry {
            JournalEntry::Apply(operation) => {
                self.objects.apply(operation)?;
                self.applied.push(operation.clone());
                self.undone.clear();
            }
            JournalEntry::Undo => {
                let last = self.applied.pop().ok_or(DocumentError::NothingToUndo)?;
                self.undone.push(last);
                let mut objects = Objects::default();
                for operation in &self.applied {
                    objects.apply(operation)?;
                }
                self.objects = objects;
            }
            JournalEntry::Redo => {
                let operation = self.undone.pop().ok_or(DocumentError::NothingToRedo)?;
                self.objects.apply(&operation)?;
                self.applied.push(operation);
            }
        }
        Ok(())
    }

    /// Selections that some operation names, undone ones included.
    pub fn selections(&self) -> impl Iterator<Item = &StoredSelection> {
        self.applied.iter().chain(&self.undone).filter_map(|operation| match operation {
            Operation::Keep { selection, .. }
            | Operation::Paint { selection, .. }
            | Operation::Edit { selection, .. } => Some(selection),
            _ => None,
        })
    }
}
