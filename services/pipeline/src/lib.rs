//! One scene's graph: connects the four actors, overlaps their work, and resumes interrupted runs.
//!
//! A run is kept in a [`RunFolder`]. [`run()`] fills it: sky and embeddings while geometry trains, masks from a
//! snapshot while geometry trains on, then the feature field, held-out scores and the report. A [`Session`] keeps a run
//! in memory for prompts; [`render()`] and [`score()`] read the folder.

mod accelerator;
mod artefacts;
mod checkpoints;
mod choice;
mod code;
mod continued;
mod coordinator;
mod diagnostics;
mod engine;
mod error;
mod evaluate;
mod explain;
mod folder;
mod graph;
mod history;
mod images;
mod inputs;
mod intact;
mod keep;
mod light;
mod memory;
mod object_masks;
mod objects;
mod outcome;
mod prompts;
mod recompute;
mod region_cache;
mod render;
mod report;
mod session;
mod settings;
mod skies;
mod traces;
mod transients;
mod until;
mod view_slots;

pub use accelerator::accelerator;
pub use artefacts::Keys;
pub use code::{Code, providers_for};
pub(crate) use engine::log_loss;
pub use engine::{ChosenEngine, EngineKind, WhenLost, choose_engine};
pub use error::RunError;
pub use evaluate::{HeldOut, HeldOutScore, Score, SelectionMaskScore, held_out_render, score};
pub use explain::{StagePlan, StageVerdict, explain};
pub use folder::{Loaded, RunFolder, TrainingSnapshot};
pub use graph::{RunOptions, STAGES, Summary, needs, run, stages_of};
pub use intact::{DamagedFile, verify_selections};
pub use keep::{CacheLine, cache_gc, cache_list, cache_verify};
pub use light::{AppearanceRequest, BakeRequest, Baked, BlendedAppearance, OWN, ScenePart, bake};
pub use memory::MemoryNeed;
pub use objects::{ExportedObjects, ListedObjects, ObjectList, SceneObject, export_objects, list_objects};
pub use prompts::{ObjectQuery, PhotoPrompts, Replay};
pub use render::{Mode, RenderContent, RenderRequest, RenderedFile, render};
pub use report::write_report;

pub use segwild_segmenter::AnswerStep;
pub use segwild_trainer::{AppearanceChoice, BudgetChoice, Preset};
pub use session::{
    Answer, PendingAnswer, SegmentOutcome, Selected, Session, SessionOptions, Shortened, ShownParts,
    ShownScene, segment,
};
pub use settings::{RunBudget, RunSettings, Scoring, Settings, SettingsError, renamed};
pub use transients::{TrainFit, TransientScore, TransientScores, score_transients};
pub use until::Until;
