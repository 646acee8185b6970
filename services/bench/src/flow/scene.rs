//! Scenes, settings and folders that rows are measured with.

use super::row::{FlowError, io};
use segwild_pipeline::Settings;
use segwild_synthetic::{LightVariation, Manifest, SyntheticOptions, SyntheticPlan};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

/// A small synthetic scene with `train` photos, written to `dir` photo by photo: this process keeps none of them.
pub(super) fn write_scene(dir: &Path, train: usize, long_side: u32) -> Result<Manifest, FlowError> {
    let options = SyntheticOptions {
        train,
        test: train.div_ceil(10),
        long_side,
        points: 800,
        occlusion: 0.0,
        photo_light: LightVariation::Affine,
        ..SyntheticOptions::small()
    };
    Ok(SyntheticPlan::new(&options)?.write(dir, |_| ControlFlow::Continue(()))?)
}

/// A quick preset, with changes. The appearance model is named: the short fits that would choose one come before the dataflow,
/// and are no part of the chain that its time is compared with.
pub(super) fn settings(changes: &[(&str, &str)]) -> Result<Settings, FlowError> {
    let pairs: Vec<(String, String)> = [("preset", "draft"), ("appearance_model", "affine")]
        .iter()
        .chain(changes)
        .map(|(name, value)| ((*name).to_owned(), (*value).to_owned()))
        .collect();
    Ok(Settings::layered(None, &pairs)?)
}

/// A folder of its own, empty.
pub(super) fn fresh(dir: &Path) -> Result<PathBuf, FlowError> {
    if dir.exists() {
        io(format!("remove {}", dir.display()), std::fs::remove_dir_all(dir))?;
    }
    io(format!("create {}", dir.display()), std::fs::create_dir_all(dir))?;
    Ok(dir.to_owned())
}
