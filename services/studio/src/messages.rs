//! What the page and the server say to each other, as JSON. Positions on photos are pixels of the undistorted photo at full size.
//!
//! `proto/segwild/v1/session.proto` has the same messages with the same names of fields: `tests/it/openapi.rs` compares the two.

use crate::document::{KeptObject, ObjectId};
use crate::regions::{Combination, Region, RegionRule};
use segwild_pipeline::{AnswerStep, BlendedAppearance, Moment};
use segwild_scene::{Camera, Pose, Prompts};
use segwild_segmenter::{
    Alternative, Lopsided, PhotoAgreement, SelectionConfidence, ShownSide, SideAgreement,
};
use serde::{Deserialize, Serialize};

/// A run, as the list of runs names it.
#[derive(Clone, Debug, Serialize)]
pub struct RunEntry {
    /// Its name, the last part of its folder's path.
    pub name: String,
    /// Whether its session can be opened: `open`, `opening`, `trained`, `training` or `failed`.
    pub state: &'static str,
    /// Why not, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

/// What does not change while a session is open.
#[derive(Clone, Debug, Serialize)]
pub struct RunDescription {
    /// The run's name.
    pub name: String,
    /// The provider of masks: `built-in`, or `sam:` and a model's name.
    pub provider: String,
    /// Splats of the scene.
    pub splats: usize,
    /// Long side in pixels at which photos are worked with.
    pub size: u32,
    /// The photos.
    pub photos: Vec<PhotoDescription>,
    /// Middle of what the photos see, in the scene's frame.
    pub centre: [f32; 3],
    /// Up in the scene's frame.
    pub up: [f32; 3],
    /// Objects that were found without a click.
    pub listed: Vec<ListedDescription>,
    /// Colours of objects, sRGB.
    pub palette: Vec<[u8; 3]>,
    /// Whether hovering shows nested groups: there is a scene tree.
    pub tree: bool,
    /// The step of the training that the scene is of; `null` where the training is over.
    pub snapshot: Option<u32>,
    /// Whether texts are answered: there is a model of texts, and a scene tree.
    pub texts: bool,
}

/// A run that is being trained, before and after its first scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TrainingMessage {
    /// Names of its photos, as far as they are known.
    pub photos: Vec<String>,
    /// Loss, PSNR and splats over the steps, taken evenly up to the last.
    pub history: Vec<Moment>,
    /// The step of its newest scene; `null` where there is none yet, or the training is over.
    pub snapshot: Option<u32>,
}

/// A photo of a run.
#[derive(Clone, Debug, Serialize)]
pub struct PhotoDescription {
    /// Its name.
    pub name: String,
    /// Intrinsics at full size, without distortion.
    pub camera: Camera,
    /// World to camera: rows of the rotation.
    pub rotation: [f32; 9],
    /// World to camera.
    pub translation: [f32; 3],
    /// Whether it was held out, so that it has no appearance of its own.
    pub held_out: bool,
}

/// An object of the scene's own list.
#[derive(Clone, Debug, Serialize)]
pub struct ListedDescription {
    /// Its number.
    pub number: usize,
    /// Its name, or `object-N`.
    pub name: String,
    /// Its splats.
    pub splats: usize,
    /// Photos in which it shows.
    pub photos: usize,
    /// Index of the photo that shows it best.
    pub photo: usize,
}

/// Prompts on one photo.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ShownPrompts {
    /// Index of the photo.
    pub photo: usize,
    /// Clicks and boxes.
    #[serde(flatten)]
    pub prompts: Prompts,
}

/// What a person wants done.
#[derive(Clone, Debug, Deserialize)]
#[serde(tag = "do", rename_all = "snake_case", deny_unknown_fields)]
pub enum StudioAction {
    /// Requests the selection of these prompts; none ends the query.
    Prompt {
        /// All prompts of the query.
        prompts: Vec<ShownPrompts>,
        /// Which of the answer's alternatives is wanted.
        #[serde(default)]
        alternative: u32,
    },
    /// Requests an object of the scene's own list.
    Listed {
        /// Its number.
        number: usize,
    },
    /// Requests what a text describes.
    Text {
        /// Some words, such as `the dome` or `all windows`; 300 characters at most.
        text: String,
        /// Which of the answer's alternatives is wanted.
        #[serde(default)]
        alternative: u32,
    },
    /// Takes up an object's prompts again: the next answer that is kept replaces it.
    Refine {
        /// The object.
        id: ObjectId,
    },
    /// Keeps the answer as an object.
    Keep {
        /// Its name; chosen where none is given.
        #[serde(default)]
        name: Option<String>,
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
    /// Locks or unlocks an object.
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
    /// Removes an object.
    Delete {
        /// The object.
        id: ObjectId,
    },
    /// Copies an object.
    Duplicate {
        /// The object.
        id: ObjectId,
    },
    /// Changes an object by another one.
    Combine {
        /// The object that changes.
        id: ObjectId,
        /// The other one, which stays as it is.
        with: ObjectId,
        /// How.
        how: Combination,
    },
    /// Adds the splats next to an object, or takes its outermost ones away.
    Grow {
        /// The object.
        id: ObjectId,
        /// Steps; negative ones shrink.
        steps: i32,
    },
    /// Changes an object by a region of a view.
    Region {
        /// The object; `null` makes a new one.
        id: Option<ObjectId>,
        /// The view.
        view: ViewMessage,
        /// The region, in the view's pixels.
        region: Region,
        /// How.
        how: Combination,
        /// Which splats of the region are taken.
        #[serde(default)]
        rule: RegionRule,
    },
    /// Chooses the appearance of the scene or of one object.
    Appearance {
        /// The object; `null` is the scene.
        id: Option<ObjectId>,
        /// Index of the photo; `null` is the scene's own appearance.
        photo: Option<usize>,
        /// Index of the photo towards whose appearance it goes; `null` is the scene's own.
        #[serde(default)]
        towards: Option<usize>,
        /// How far it goes, 0 to 1.
        #[serde(default)]
        share: f32,
    },
    /// Changes the mask of a photo's transients by a region of the photo.
    Transients {
        /// Index of the photo.
        photo: usize,
        /// The region, in pixels of the photo as it is shown, at full size.
        region: Region,
        /// How.
        how: Combination,
    },
    /// Shows objects with their spikes cut, or as they were.
    CutSpikes {
        /// Whether they are cut.
        cut: bool,
    },
    /// Ends the writing of an object as a selection: nothing of it is left. It is no operation, and is not undone.
    StopSave {
        /// The object.
        id: ObjectId,
    },
    /// Undoes the last operation.
    Undo,
    /// Does the last undone operation again.
    Redo,
}

/// A camera and its pose.
#[derive(Clone, Debug, Deserialize)]
pub struct ViewMessage {
    /// Intrinsics in pixels.
    pub camera: Camera,
    /// World to camera: rows of the rotation.
    pub rotation: [f32; 9],
    /// World to camera.
    pub translation: [f32; 3],
}

/// Longest side of a rendered view in pixels.
const LONGEST_SIDE: u32 = 2048;

impl ViewMessage {
    /// The camera and the pose.
    ///
    /// # Errors
    /// Why they cannot be used.
    pub fn view(&self) -> Result<(Camera, Pose), &'static str> {
        let Camera { width, height, fx, fy, cx, cy } = self.camera;
        if width == 0 || height == 0 || width > LONGEST_SIDE || height > LONGEST_SIDE {
            return Err("a view has 1 to 2048 pixels on each side");
        }
        let numbers = || [fx, fy, cx, cy].into_iter().chain(self.rotation).chain(self.translation);
        if numbers().any(|x| !x.is_finite() || x.abs() > 1e9) || fx < 1.0 || fy < 1.0 {
            return Err("the camera's numbers are none");
        }
        let rotation = glam::Mat3::from_cols_array(&self.rotation).transpose();
        if (rotation * rotation.transpose()).abs_diff_eq(glam::Mat3::IDENTITY, 1e-2) {
            return Ok((self.camera, Pose { rotation, translation: self.translation.into() }));
        }
        Err("the rotation is none")
    }
}

/// A request for the candidate at a position of a photo, or of a view of the scene.
#[derive(Clone, Debug, Default, Deserialize)]
pub struct HoverRequest {
    /// Index of the photo; of no account where there is a view.
    #[serde(default)]
    pub photo: usize,
    /// Position, x.
    pub x: f32,
    /// Position, y.
    pub y: f32,
    /// As in [`Prompts::granularity`].
    #[serde(default)]
    pub granularity: Option<f32>,
    /// The view in whose pixels the position is, and the candidate is wanted; `null` for the photo.
    #[serde(default)]
    pub view: Option<ViewMessage>,
}

/// Labels of a photo's pixels.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct LabelMap {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Runs of equal labels, row by row: label and length, one after the other. 0 is none, [`ANSWER_LABEL`] the answer, others
    /// are the positions of objects in their list, from 1.
    pub runs: Vec<u32>,
    /// The revision of the state that they show.
    pub revision: u64,
}

/// The number that stands for the answer where that of an object is wanted.
pub const ANSWER_OBJECT: ObjectId = 0;

/// The label of what the answer selects.
pub const ANSWER_LABEL: u8 = 255;

/// The label of splats that the 3D view does not show.
pub const HIDDEN_LABEL: u8 = 254;

/// A request for a rendered view.
#[derive(Clone, Debug, Deserialize)]
pub struct FrameRequest {
    /// The view.
    #[serde(flatten)]
    pub view: ViewMessage,
    /// Whether objects and the answer are highlighted.
    #[serde(default)]
    pub marks: bool,
    /// Whether only what stands behind all splats is rendered.
    #[serde(default)]
    pub background: bool,
    /// Photo whose appearance is shown instead of the chosen one.
    #[serde(default)]
    pub appearance: Option<usize>,
}

/// A request for the photo that shows best what a pixel of a view shows.
#[derive(Clone, Debug, Deserialize)]
pub struct PickRequest {
    /// The view.
    #[serde(flatten)]
    pub view: ViewMessage,
    /// The pixel.
    pub at: [f32; 2],
}

/// A position on a photo.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PickedPixel {
    /// Index of the photo.
    pub photo: usize,
    /// Position, x.
    pub x: f32,
    /// Position, y.
    pub y: f32,
    /// The point in the scene's frame.
    pub point: [f32; 3],
}

/// The state of a session: sent whole at every change.
#[derive(Clone, Debug, Serialize)]
pub struct StateMessage {
    /// Counts the changes.
    pub revision: u64,
    /// Counts the messages: of two states, the later one has the larger number. It grows with the revision, and while objects are
    /// being written.
    pub sequence: u64,
    /// What is being requested.
    pub draft: DraftMessage,
    /// The answer to it.
    pub answer: AnswerMessage,
    /// The objects.
    pub objects: Vec<ObjectMessage>,
    /// The object that is shown alone.
    pub isolated: Option<ObjectId>,
    /// The appearance of the scene.
    pub appearance: AppearanceMessage,
    /// Indices of the photos whose transient masks were changed.
    pub corrected: Vec<usize>,
    /// Whether objects are shown with their spikes cut.
    pub cut_spikes: bool,
    /// Names what objects change of the splats: shapes that are cut, and appearances of their own. Empty where they change nothing.
    pub changes: String,
    /// What undo would take back.
    pub undo: Option<&'static str>,
    /// What redo would do again.
    pub redo: Option<&'static str>,
    /// Warnings, a sentence each.
    pub notes: Vec<String>,
    /// Objects that are being written as selections, or wait for that, in their order.
    pub saving: Vec<SavingMessage>,
}

/// How far the writing of an object is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct SavingMessage {
    /// The object.
    pub object: ObjectId,
    /// Photos whose masks are written; 0 while the object waits or is still selected.
    pub done: usize,
    /// All photos.
    pub photos: usize,
}

/// An appearance between two.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct AppearanceMessage {
    /// Index of the photo; `null` is the scene's own.
    pub photo: Option<usize>,
    /// Index of the photo towards whose appearance it goes; `null` is the scene's own.
    pub towards: Option<usize>,
    /// How far it goes, 0 to 1.
    pub share: f32,
}

impl AppearanceMessage {
    /// An appearance; `index` finds a photo by its name.
    pub fn of(appearance: &BlendedAppearance, index: impl Fn(&str) -> Option<usize>) -> AppearanceMessage {
        let BlendedAppearance { photo, towards, share } = appearance;
        AppearanceMessage { photo: index(photo), towards: index(towards), share: *share }
    }
}

/// What is being requested.
#[derive(Clone, Debug, Serialize)]
pub struct DraftMessage {
    /// Clicks and boxes.
    pub prompts: Vec<ShownPrompts>,
    /// The number of an object of the scene's list.
    pub listed: Option<usize>,
    /// The object that the answer replaces when it is kept.
    pub of: Option<ObjectId>,
    /// Which of the answer's alternatives is selected.
    pub alternative: u32,
    /// A text that describes the object.
    pub text: Option<String>,
}

/// How far an answer has come.
#[derive(Clone, Debug, Default, Serialize)]
pub struct AnswerMessage {
    /// Counts the queries.
    pub number: u64,
    /// `none`, `working`, `done` or `failed`.
    pub state: &'static str,
    /// What the present answer comes from.
    pub step: Option<AnswerStep>,
    /// Splats that it selects.
    pub splats: usize,
    /// What else the prompts may select.
    pub alternatives: Vec<Alternative>,
    /// Why there is no answer.
    pub error: Option<String>,
    /// Seconds from the prompts to the present answer.
    pub seconds: f64,
    /// How sure the answer is; `null` until it is done.
    pub confidence: Option<ConfidenceMessage>,
    /// Score of each alternative, 0 to 1: it compares matches of one text. Empty without a text.
    pub scores: Vec<f32>,
}

/// How sure an answer is.
#[derive(Clone, Debug, Serialize)]
pub struct ConfidenceMessage {
    /// The IoU with what is meant that is to be expected, 0 to 1.
    pub value: f32,
    /// Mean agreement of the photos, 0 to 1; `null` where none was compared.
    pub agreement: Option<f32>,
    /// Agreement of the side that agrees least, 0 to 1.
    pub worst_side_agreement: Option<f32>,
    /// IoU of the answer with the next alternative of the scene tree, 0 to 1.
    pub levels_agreement: Option<f32>,
    /// The side that was prompted.
    pub prompted_side: SideAgreement,
    /// The rest of the object.
    pub far_side: SideAgreement,
    /// Why the answer may be good on the prompted side only.
    pub lopsided: Option<Lopsided>,
    /// Index of the photo in which one more click would help most.
    pub next_click: Option<usize>,
    /// The photos that were compared.
    pub photos: Vec<PhotoConfidence>,
}

/// How well a photo agrees with an answer.
#[derive(Clone, Debug, Serialize)]
pub struct PhotoConfidence {
    /// Index of the photo.
    pub photo: usize,
    /// Whether it was prompted.
    pub prompted: bool,
    /// Whether it shows another side of the object than the prompted photos.
    pub far: bool,
    /// IoU of the answer's silhouette in it with its own mask, 0 to 1.
    pub agreement: f32,
    /// Share of its pixels that show the answer, 0 to 1.
    pub shown: f32,
    /// Whether it agrees by less than a mask needs to count.
    pub disagrees: bool,
}

impl ConfidenceMessage {
    /// How sure a selection is; `index` finds a photo by its name.
    pub fn of(confidence: &SelectionConfidence, index: impl Fn(&str) -> Option<usize>) -> ConfidenceMessage {
        let photo = |p: &PhotoAgreement| {
            Some(PhotoConfidence {
                photo: index(&p.photo)?,
                prompted: p.prompted,
                far: p.side == ShownSide::Far,
                agreement: p.agreement,
                shown: p.shown,
                disagrees: p.disagrees,
            })
        };
        ConfidenceMessage {
            value: confidence.value,
            agreement: confidence.agreement,
            worst_side_agreement: confidence.worst_side_agreement,
            levels_agreement: confidence.levels_agreement,
            prompted_side: confidence.prompted_side,
            far_side: confidence.far_side,
            lopsided: confidence.lopsided,
            next_click: confidence.next_click.as_deref().and_then(&index),
            photos: confidence.photos.iter().filter_map(photo).collect(),
        }
    }
}

/// An object.
#[derive(Clone, Debug, Serialize)]
pub struct ObjectMessage {
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
    /// Its own appearance; `null` where it has the scene's.
    pub appearance: Option<AppearanceMessage>,
    /// Its splats.
    pub splats: usize,
    /// Name of its selection: it changes when the splats do.
    pub selection: String,
    /// Whether prompts made it, so that they can be taken up again.
    pub prompted: bool,
    /// Whether tools changed it after its answer.
    pub edited: bool,
}

impl ObjectMessage {
    /// An object; `index` finds a photo by its name.
    pub fn of(object: &KeptObject, index: impl Fn(&str) -> Option<usize>) -> ObjectMessage {
        ObjectMessage {
            id: object.id,
            name: object.name.clone(),
            colour: object.colour,
            visible: object.visible,
            locked: object.locked,
            appearance: object.appearance.as_ref().map(|own| AppearanceMessage::of(own, &index)),
            splats: object.selection.splats,
            selection: object.selection.hash.clone(),
            prompted: !object.draft.is_empty(),
            edited: object.edited,
        }
    }
}
