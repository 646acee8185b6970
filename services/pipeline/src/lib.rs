//! One scene's run: its stages, what they keep on disk, and what comes of it.
//!
//! A run is kept in a [`RunFolder`]. [`run()`] fills it: sky and embeddings while geometry trains, masks from a
//! snapshot while geometry trains on, then the feature field, held-out scores and the report. A stopped or killed run
//! goes on where it was, and what is in the cache is not made again. A [`Session`] keeps a run in memory for prompts;
//! [`render()`] and [`score()`] read the folder.
//!
//! What it is not: it computes nothing by itself. The four actors train, segment and lift, the 2D models are
//! `segwild_vision`'s, and many scenes are the farm's.
//!
//! | folder | what it has | start at |
//! |---|---|---|
//! | `run` | prepare, plan, execute, finish; the stages and their graph | `run/mod.rs`, `run/stages/` |
//! | `artifacts` | the run folder, the cache and its keys, checkpoints | `artifacts/folder.rs`, `artifacts/keys.rs` |
//! | `import` | views of splats that come without photos | `import/hull.rs` |
//! | `session` | what a click holds | `session/resident.rs` |
//! | `output` | renders, appearances, scores, objects, the report | `output/render.rs` |
//! | `transients` | masks of transients, and who wrote them | `transients/mod.rs` |
//!
//! Which stage needs what is data, and schedules a run:
//!
//! ```
//! use segwild_pipeline::{Extent, Stage, needs};
//! let sky = needs(Stage::Geometry)[0];
//! // The training starts at once, and waits for the sky of each photo when it comes to it.
//! assert_eq!((sky.stage, sky.extent), (Stage::Sky, Extent::PerPhoto));
//! ```
//!
//! A run of a scene, with every setting at its default:
//!
//! ```no_run
//! use segwild_pipeline::{RunFolder, RunOptions, Settings, run};
//! let folder = RunFolder::create("runs/trevi".as_ref())?;
//! let summary = run("photos/trevi".as_ref(), &folder, &Settings::default(), &RunOptions::default())?;
//! println!("{} splats of {} photos", summary.splats, summary.photos);
//! # Ok::<_, segwild_pipeline::RunError>(())
//! ```

mod accelerator;
mod artifacts;
mod code;
mod engine;
mod error;
mod import;
mod output;
mod run;
mod session;
mod settings;
mod transients;

pub use accelerator::accelerator;
pub use artifacts::cache::{CacheLine, cache_gc, cache_list, cache_verify};
pub use artifacts::folder::{Loaded, RunFolder, TrainingSnapshot};
pub use artifacts::history::Moment;
pub use artifacts::intact::{DamagedFile, verify_selections};
pub use artifacts::keys::Keys;
pub use artifacts::prompts::{ObjectQuery, PhotoPrompts, Replay};
pub use artifacts::selected::{Selected, SelectedError, Shortened};
pub use code::{Code, providers_for};
pub(crate) use engine::log_loss;
pub use engine::{ChosenEngine, choose_engine};
pub use error::RunError;
pub use import::render_views;
pub use output::bake::{BakeRequest, Baked, ScenePart, bake};
pub use output::camera_path::CameraPath;
pub use output::evaluate::{
    BOUNDARY, HeldOut, HeldOutScore, Score, SelectionMaskScore, held_out_render, score,
};
pub use output::light::{AppearanceRequest, BlendedAppearance, OWN};
pub use output::objects::{ExportedObjects, ListedObjects, ObjectList, SceneObject, SeenOnceShare};
pub use output::provenance::{ExportProvenance, ObjectProvenance};
pub use output::render::{
    FRAMES_AROUND, MOST_FRAMES, Mode, RenderContent, RenderRequest, RenderedFile, UNSEEN, render,
};
pub use output::report::write_report;
pub use output::splat_files::{ConvertedFormat, ExportFormat, SplatTransform};
pub use output::text_query::{TextMatch, TextRanking};
pub use output::video::FRAMES_PER_SECOND;

pub use run::{
    ActorInboxes, ActorOutcome, ActorParts, ComputingActors, DiagramFormat, Extent, MemoryNeed, Need,
    RunOptions, Stage, StagePlan, StageVerdict, Summary, Until, UntilError, Wiring, diagram, explain,
    explain_time, needs, run, run_with_actors, stages_of,
};
pub use segwild_segmenter::AnswerStep;
pub use segwild_trainer::{AppearanceChoice, BudgetChoice, Preset};
pub use session::{
    Answer, MaskedObject, PackedSplats, PendingAnswer, SegmentOutcome, Session, SessionOptions, ShownParts,
    ShownScene, export_objects, list_objects, segment,
};
pub use settings::{
    DescribedPhotos, EngineKind, RunBudget, RunSettings, Scoring, Settings, SettingsError, WhenLost, renamed,
};
pub use transients::{TrainFit, TransientScore, TransientScores, score_transients};
