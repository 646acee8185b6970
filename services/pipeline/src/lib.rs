//! One scene's graph: connects the four actors, overlaps their work, and resumes interrupted runs.
//!
//! A run is kept in a [`RunFolder`]. [`run()`] fills it: sky and embeddings while geometry trains, masks from a
//! snapshot while geometry trains on, then the feature field, held-out scores and the report. A [`Session`] keeps a run
//! in memory for prompts; [`render()`] and [`score()`] read the folder.

mod accelerator;
mod artifacts;
mod code;
mod engine;
mod error;
mod output;
mod run;
mod session;
mod settings;
mod transients;

pub use accelerator::accelerator;
pub use artifacts::cache::{CacheLine, cache_gc, cache_list, cache_verify};
pub use artifacts::folder::{Loaded, RunFolder, TrainingSnapshot};
pub use artifacts::intact::{DamagedFile, verify_selections};
pub use artifacts::keys::Keys;
pub use code::{Code, providers_for};
pub(crate) use engine::log_loss;
pub use engine::{ChosenEngine, choose_engine};
pub use error::RunError;
pub use output::evaluate::{HeldOut, HeldOutScore, Score, SelectionMaskScore, held_out_render, score};
pub use output::light::{AppearanceRequest, BakeRequest, Baked, BlendedAppearance, OWN, ScenePart, bake};
pub use output::objects::{
    ExportedObjects, ListedObjects, ObjectList, SceneObject, export_objects, list_objects,
};
pub use output::render::{Mode, RenderContent, RenderRequest, RenderedFile, render};
pub use output::report::write_report;
pub use run::explain::{StagePlan, StageVerdict, explain};
pub use run::graph::{RunOptions, STAGES, Summary, needs, run, stages_of};
pub use run::memory::MemoryNeed;
pub use session::prompts::{ObjectQuery, PhotoPrompts, Replay};

pub use run::until::Until;
pub use segwild_segmenter::AnswerStep;
pub use segwild_trainer::{AppearanceChoice, BudgetChoice, Preset};
pub use session::{
    Answer, PendingAnswer, SegmentOutcome, Selected, Session, SessionOptions, Shortened, ShownParts,
    ShownScene, segment,
};
pub use settings::{EngineKind, RunBudget, RunSettings, Scoring, Settings, SettingsError, WhenLost, renamed};
pub use transients::{TrainFit, TransientScore, TransientScores, score_transients};
