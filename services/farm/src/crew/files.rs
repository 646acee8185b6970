//! The settings and logs of a machine's scenes.

use std::fs::File;
use std::path::{Path, PathBuf};

use segwild_flow::files;

use crate::manifest::SceneJob;

/// Where the settings and logs of scenes are. A scene of a farm is named `BATCH/SCENE`.
#[derive(Clone, Debug)]
pub(crate) struct SceneFiles {
    folder: PathBuf,
}

impl SceneFiles {
    /// In this folder.
    pub fn of(folder: &Path) -> Self {
        Self { folder: folder.to_owned() }
    }

    /// The output of a scene's processes.
    pub fn log(&self, scene: &str) -> PathBuf {
        self.folder.join("logs").join(format!("{scene}.log"))
    }

    /// The settings of a scene.
    pub fn settings_file(&self, scene: &str) -> PathBuf {
        self.folder.join("settings").join(format!("{scene}.toml"))
    }

    /// Writes the settings of a scene.
    pub fn write_settings(&self, scene: &SceneJob) -> std::io::Result<()> {
        let path = self.settings_file(&scene.name);
        folder_of(&path)?;
        let settings = scene.effective().map_err(std::io::Error::other)?;
        files::write_atomic(&path, settings.to_toml().as_bytes()).map_err(std::io::Error::other)
    }

    /// The output of a scene's processes, to write on.
    pub fn open_log(&self, scene: &str) -> std::io::Result<File> {
        let path = self.log(scene);
        folder_of(&path)?;
        files::open_to_append(&path).map_err(|e| e.source)
    }
}

fn folder_of(file: &Path) -> std::io::Result<()> {
    file.parent().map_or(Ok(()), std::fs::create_dir_all)
}
