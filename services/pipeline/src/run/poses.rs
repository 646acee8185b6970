//! Opens the scene of a run. Where its photos have no poses, the stage `poses` computes them first.

use super::options::RunOptions;
use super::stage::Stage;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::{Event, Ledger};
use segwild_poses::{PoseLimits, PosePlan, PoseSource, PoseSpan, PosesError};
use segwild_scene::{Scene, SceneError, SceneSettings};
use std::path::Path;

/// A scene and where its poses are from.
pub struct OpenedScene {
    pub scene: Scene,
    /// Whether the run computed its poses.
    pub posed: bool,
    /// When it did, if this process did.
    pub spans: Vec<PoseSpan>,
}

/// The scene at a path if it has poses, else the photos or the video there.
///
/// # Errors
/// When it is neither, or cannot be used.
pub fn scene_or_photos(path: &Path, settings: &SceneSettings) -> Result<Result<Scene, PoseSource>, RunError> {
    match Scene::open(path, settings) {
        Ok(scene) => Ok(Ok(scene)),
        Err(error @ SceneError::NotAScene { .. }) => Ok(Err(PoseSource::of(path, settings)?.ok_or(error)?)),
        Err(error) => Err(error.into()),
    }
}

/// Opens the scene of a run, and computes its poses where it has none.
///
/// # Errors
/// When the scene cannot be used, the poses cannot be computed, the disk fails, or the run is stopped.
pub fn open(
    path: &Path,
    folder: &RunFolder,
    settings: &Settings,
    ledger: &Ledger,
    options: &RunOptions,
) -> Result<OpenedScene, RunError> {
    let source = match scene_or_photos(path, &settings.scene)? {
        Ok(scene) => return Ok(OpenedScene { scene, posed: false, spans: Vec::new() }),
        Err(source) => source,
    };
    let plan = folder.poses().plan(&source, &settings.poses)?;
    let spans = match plan.is_done() {
        true => {
            let key = plan.key.to_string();
            options.events.tell(Event::StageSkipped { stage: Stage::Poses.name().into(), key });
            Vec::new()
        }
        false => compute(folder, &source, &plan, settings, ledger, options)?,
    };
    // The ledger may be younger than the poses; a row that is done keeps its times.
    if !ledger.stage_is_done(Stage::Poses.name(), &plan.key)? {
        ledger.finish_stage(Stage::Poses.name(), &plan.key, None)?;
    }
    Ok(OpenedScene { scene: folder.open_posed(path, &settings.scene)?, posed: true, spans })
}

fn compute(
    folder: &RunFolder,
    source: &PoseSource,
    plan: &PosePlan,
    settings: &Settings,
    ledger: &Ledger,
    options: &RunOptions,
) -> Result<Vec<PoseSpan>, RunError> {
    let name = Stage::Poses.name();
    let limits = PoseLimits::new(settings.run.threads as usize, settings.run.memory_budget);
    ledger.start_stage(name, &plan.key)?;
    let computed =
        folder.poses().estimate(source, plan, &settings.poses, &limits, &options.events, &options.stopper);
    match computed {
        Ok(spans) => Ok(spans),
        Err(PosesError::Stopped) => {
            ledger.leave_stages()?;
            Err(RunError::Interrupted)
        }
        Err(error) => {
            let reason = error.to_string();
            ledger.fail_stage(name, &plan.key, &reason)?;
            options.events.tell(Event::StageFailed { stage: name.into(), error: reason });
            Err(error.into())
        }
    }
}
