//! The CLIP model that settings name. It is loaded at the first query by text: a run does not need it.

use super::encoders::{ClipEncoders, read};
use super::scaling::other_model;
use crate::clip_files::ClipFiles;
use crate::onnx::Runtime;
use crate::survey::{FileUse, survey};
use crate::{TextEmbedder, VisionError, VisionSettings};
use segwild_files::lock;
use segwild_scene::Image;
use std::path::Path;
use std::sync::{Arc, Mutex};

/// A model of a folder.
pub(crate) struct ClipOnDemand {
    files: ClipFiles,
    settings: VisionSettings,
    loaded: Mutex<Option<Arc<ClipEncoders>>>,
}

/// Finds a model in the folder of networks. The notes say what is used, and what is not with the reason.
pub(crate) fn find_clip(
    settings: &VisionSettings,
    notes: &mut Vec<String>,
) -> Result<Option<ClipOnDemand>, VisionError> {
    if settings.models.is_empty() {
        return Ok(None);
    }
    let found = survey(Path::new(&settings.models), "")?;
    for file in found.files.iter().filter(|file| file.is_clip()) {
        let path = file.path.display();
        notes.push(match &file.usage {
            FileUse::RefusedClip(reason) => format!("text: not used: {path}: {reason}"),
            FileUse::Texts => format!("text: {path} {}", file.usage),
            usage => format!("text: not used: {path} {usage}"),
        });
    }
    let mut texts = found.texts;
    if let Some(files) = &mut texts
        && let Some(file) = files.bare_scaling()
        && let Some(kind) = read(file).ok().and_then(|bytes| other_model(&bytes))
    {
        notes.push(format!("text: not used: {}: it is of another model (`{kind}`)", file.display()));
        files.scaling = None;
    }
    let on_demand = |files| ClipOnDemand { files, settings: settings.clone(), loaded: Mutex::default() };
    Ok(texts.map(on_demand))
}

impl ClipOnDemand {
    /// The model. A failure is not kept: the next query tries again.
    fn loaded(&self) -> Result<Arc<ClipEncoders>, VisionError> {
        let mut loaded = lock(&self.loaded);
        if let Some(encoders) = &*loaded {
            return Ok(encoders.clone());
        }
        let VisionSettings { onnxruntime, network_memory, .. } = &self.settings;
        let runtime = Runtime::find_within(onnxruntime, *network_memory)?;
        let encoders = Arc::new(ClipEncoders::load(&runtime, &self.files, &self.settings)?);
        Ok(loaded.insert(encoders).clone())
    }
}

impl TextEmbedder for ClipOnDemand {
    fn key(&self) -> Result<String, VisionError> {
        Ok(self.loaded()?.key().to_owned())
    }

    fn embed_images(&self, images: &[Image]) -> Result<Vec<Vec<f32>>, VisionError> {
        self.loaded()?.images(images)
    }

    fn embed_texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>, VisionError> {
        self.loaded()?.texts(texts)
    }
}
