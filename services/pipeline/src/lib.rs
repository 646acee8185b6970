//! One scene's graph: wires the four actors, decides what overlaps, resumes.
//!
//! A run lives in a [`RunFolder`]. [`run()`] fills it: sky and embeddings while geometry trains, masks from a
//! snapshot while geometry trains on, then the feature field, held-out scores and the report. [`segment()`],
//! [`render()`] and [`score()`] read what it left.

mod accelerator;
mod anew;
mod artefacts;
mod board;
mod checkpoints;
mod choice;
mod code;
mod coordinator;
mod doubts;
mod engine;
mod error;
mod evaluate;
mod explain;
mod folder;
mod graph;
mod history;
mod inputs;
mod intact;
mod keep;
mod light;
mod made;
mod mask_source;
mod memory;
mod onward;
mod outcome;
mod pictures;
mod prompts;
mod render;
mod report;
mod segment;
mod settings;
mod shelf;
mod skies;
mod strangers;
mod traces;
mod until;
mod visibility;

pub use accelerator::accelerator;
pub use artefacts::Keys;
pub use code::{Code, providers_for};
pub(crate) use engine::log_loss;
pub use engine::{Chosen, EngineKind, WhenLost, choose_engine};
pub use error::RunError;
pub use evaluate::{HeldOut, MaskScore, Score, score};
pub use explain::{Plan, Verdict, explain};
pub use folder::{Loaded, RunFolder};
pub use graph::{RunOptions, STAGES, Summary, needs, run, stages_of};
pub use intact::{DamagedFile, verify_selections};
pub use keep::{CacheLine, cache_gc, cache_list, cache_verify};
pub use light::{BakeRequest, Baked, LookRequest, OWN, Part, bake};
pub use memory::MemoryNeed;
pub use prompts::{PhotoPrompts, Replay};
pub use render::{Drawn, Mode, RenderRequest, What, render};
pub use report::write_report;
pub use segment::{SegmentOutcome, Selected, Shortened, segment};
pub use segwild_trainer::{BudgetChoice, LookChoice, Preset};
pub use settings::{Budget, RunSettings, Scoring, Settings, SettingsError};
pub use strangers::{StrangerScore, StrangerScores, score_strangers};
pub use until::Until;
