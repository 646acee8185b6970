//! What a person does to the objects of a scene.

use segwild_pipeline::{BlendedAppearance, ObjectQuery, PhotoPrompts};
use serde::{Deserialize, Serialize};

/// The number of an object. It stays when the name changes, and is never used again.
pub type ObjectId = u32;

/// What is being requested.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ObjectDraft {
    /// Clicks and boxes, in pixels of the photos as taken.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub prompts: Vec<PhotoPrompts>,
    /// An object of the scene's list, in the stead of prompts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub listed: Option<ObjectQuery>,
    /// A text that describes the object, in the stead of prompts.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub text: Option<String>,
    /// Which of the answer's alternatives is selected.
    #[serde(default)]
    pub alternative: u32,
    /// The object that the answer replaces when it is kept; `None` makes a new one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub of: Option<ObjectId>,
}

impl ObjectDraft {
    /// Whether nothing is requested.
    pub fn is_empty(&self) -> bool {
        self.prompts.is_empty() && self.listed.is_none() && self.text.is_none()
    }
}

/// Splats of an object, by the name of their record in the session's folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StoredSelection {
    /// Hash of the record.
    pub hash: String,
    /// Splats that are selected.
    pub splats: usize,
}

/// An operation on a session's objects. Operations are written to `session.jsonl`, one per line, and can be undone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case")]
pub enum Operation {
    /// Requests something else.
    Draft {
        /// All of what is requested now.
        draft: ObjectDraft,
    },
    /// Keeps the answer as an object.
    Keep {
        /// The object; a new number, or that of [`ObjectDraft::of`].
        id: ObjectId,
        /// The name of a new object.
        name: String,
        /// What was requested.
        draft: ObjectDraft,
        /// The answer.
        selection: StoredSelection,
    },
    /// Makes an object of splats that a tool selected.
    Paint {
        /// The new object's number.
        id: ObjectId,
        /// Its name.
        name: String,
        /// Its splats.
        selection: StoredSelection,
    },
    /// Changes the splats of an object without prompts.
    Edit {
        /// The object.
        id: ObjectId,
        /// What changed it, in a word or two.
        tool: String,
        /// Its splats from now on.
        selection: StoredSelection,
    },
    /// Renames an object.
    Rename {
        /// The object.
        id: ObjectId,
        /// Its new name.
        name: String,
    },
    /// Shows or hides an object.
    Show {
        /// The object.
        id: ObjectId,
        /// Whether it is shown.
        visible: bool,
    },
    /// Locks or unlocks an object: a locked one cannot be changed.
    Lock {
        /// The object.
        id: ObjectId,
        /// Whether it is locked.
        locked: bool,
    },
    /// Shows one object alone, or everything again.
    Isolate {
        /// The object.
        id: Option<ObjectId>,
    },
    /// Gives an object another colour.
    Colour {
        /// The object.
        id: ObjectId,
        /// Index into the palette.
        colour: u8,
    },
    /// Removes an object. Undo brings it back.
    Delete {
        /// The object.
        id: ObjectId,
    },
    /// Copies an object.
    Duplicate {
        /// The object.
        id: ObjectId,
        /// The copy's number.
        copy: ObjectId,
        /// The copy's name.
        name: String,
    },
    /// Chooses the appearance of the scene or of one object.
    Appearance {
        /// The object; `None` is the scene.
        id: Option<ObjectId>,
        /// The appearance.
        appearance: BlendedAppearance,
    },
    /// Changes the mask of a photo's transients.
    Transients {
        /// The photo.
        photo: String,
        /// Name of the mask in the session's folder.
        mask: String,
        /// Name of the mask as it was before a person changed it; empty where there was none.
        before: String,
    },
    /// Shows objects with their spikes cut, or as they were.
    CutSpikes {
        /// Whether they are cut.
        cut: bool,
    },
}

impl Operation {
    /// What it does, in a few words.
    pub fn label(&self) -> &'static str {
        match self {
            Operation::Draft { draft } if draft.is_empty() => "clear prompts",
            Operation::Draft { .. } => "prompt",
            Operation::Keep { .. } => "keep object",
            Operation::Paint { .. } => "select by a tool",
            Operation::Edit { .. } => "edit",
            Operation::Rename { .. } => "rename",
            Operation::Show { visible: true, .. } => "show",
            Operation::Show { .. } => "hide",
            Operation::Lock { locked: true, .. } => "lock",
            Operation::Lock { .. } => "unlock",
            Operation::Isolate { id: Some(_) } => "isolate",
            Operation::Isolate { id: None } => "show everything",
            Operation::Colour { .. } => "colour",
            Operation::Delete { .. } => "delete",
            Operation::Duplicate { .. } => "duplicate",
            Operation::Appearance { .. } => "appearance",
            Operation::Transients { .. } => "paint transients",
            Operation::CutSpikes { .. } => "spike cut",
        }
    }
}

/// A line of a journal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JournalEntry {
    /// An operation.
    Apply(Operation),
    /// The last operation is undone.
    Undo,
    /// The last undone operation is done again.
    Redo,
}
