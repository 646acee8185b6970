//! Why a run cannot go on, sorted by what the user can do about it.

use crate::SettingsError;
use segwild_features::FeatureError;
use segwild_flow::{
    ActorFailure, CacheError, CodecError, FileError, LedgerError, Phase, ProgramError, SpawnError, Stopper,
    SystemRefusal,
};
use segwild_gpu::GpuError;
use segwild_poses::PosesError;
use segwild_raster::RasterError;
use segwild_scene::SceneError;
use segwild_segmenter::SegmentError;
use segwild_trainer::TrainError;
use segwild_vision::VisionError;
use std::path::PathBuf;

/// Why a run, or a command on a run, cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// The scene or its photos cannot be used.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// A settings file or value makes no sense.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The poses of the photos cannot be computed.
    #[error(transparent)]
    Poses(Box<PosesError>),
    /// A requested 2D model cannot be used.
    #[error(transparent)]
    Vision(#[from] VisionError),
    /// The run folder holds no run, or not what is needed.
    #[error("{path}: {reason}", path = path.display())]
    Folder {
        /// The folder or file.
        path: PathBuf,
        /// What is wrong and what to do.
        reason: String,
    },
    /// A file of the run cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// The cache cannot be read or written.
    #[error(transparent)]
    Cache(#[from] CacheError),
    /// A record is damaged.
    #[error("{path}: {source}; delete it and run again", path = path.display())]
    Record {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: CodecError,
    },
    /// The ledger cannot be read or written; also when another process uses the run.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// A stage failed; what was computed before is kept.
    #[error("stage `{stage}` failed: {reason}")]
    Stage {
        /// The stage.
        stage: &'static str,
        /// Why.
        reason: String,
    },
    /// The disk, the system or a service elsewhere failed during a stage; what was computed before is kept.
    #[error("stage `{stage}` stopped: {reason}")]
    Storage {
        /// The stage.
        stage: &'static str,
        /// What could not be done, and why.
        reason: String,
        /// What refused it.
        refusal: SystemRefusal,
    },
    /// The prompts make no sense or select nothing.
    #[error(transparent)]
    Segment(#[from] SegmentError),
    /// A request that does not fit this run.
    #[error("{0}")]
    Request(String),
    /// An input beside the scene cannot be used.
    #[error("{0}")]
    Input(String),
    /// A program that a request needs is not on this machine.
    #[error("{purpose}, and {program} is not found on the PATH: install it (`{install}`)")]
    NoProgram {
        /// What needs it.
        purpose: String,
        /// Its name.
        program: &'static str,
        /// A command that installs it.
        install: &'static str,
    },
    /// A program that a request needs failed.
    #[error(transparent)]
    Program(ProgramError),
    /// Stopped by the user.
    #[error("stopped; the same command goes on from here")]
    Interrupted,
    /// The system starts no further thread.
    #[error(transparent)]
    Spawn(#[from] SpawnError),
    /// The requested accelerator cannot be used.
    #[error("{0}. `--engine cpu` needs none; `segwild doctor` lists what there is")]
    Engine(#[from] GpuError),
    /// The rasteriser failed.
    #[error(transparent)]
    Raster(#[from] RasterError),
    /// A model could not be rendered or scored.
    #[error(transparent)]
    Train(#[from] TrainError),
    /// Features could not be rendered.
    #[error(transparent)]
    Features(#[from] FeatureError),
}

impl From<ProgramError> for RunError {
    fn from(error: ProgramError) -> RunError {
        match error {
            ProgramError::Stopped => RunError::Interrupted,
            ProgramError::Log(error) => RunError::File(error),
            error => RunError::Program(error),
        }
    }
}

impl From<PosesError> for RunError {
    fn from(error: PosesError) -> RunError {
        RunError::Poses(Box::new(error))
    }
}

impl RunError {
    /// The error of a stage that failed, by its own fault or the disk's.
    pub(crate) fn of_stage(stage: &'static str, failure: &ActorFailure) -> RunError {
        let reason = failure.to_string();
        match failure.refusal() {
            Some(refusal) => RunError::Storage { stage, reason, refusal },
            None => RunError::Stage { stage, reason },
        }
    }

    /// Ends what `stopper` has stopped, between two parts of it.
    ///
    /// # Errors
    /// [`RunError::Interrupted`] once it is to stop.
    pub(crate) fn unless_running(stopper: &Stopper) -> Result<(), RunError> {
        match stopper.phase() {
            Phase::Running => Ok(()),
            _ => Err(RunError::Interrupted),
        }
    }

    /// The error of a folder of true masks without one that counts, as `reason` says. `unread` has a sentence for each mask that
    /// cannot be read: they may be why.
    pub(crate) fn no_truth(reason: String, unread: &[String]) -> RunError {
        RunError::Input(match unread.first() {
            Some(first) => format!("{reason}; {} could not be read, the first: {first}", unread.len()),
            None => reason,
        })
    }
}
