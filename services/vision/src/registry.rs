//! The network files of a folder: what each is, and what it is used for.
//!
//! Segwild ships none of them. A licence here is the one that the published project states for its weights; whoever uses a file
//! is responsible for its origin.

use crate::VisionError;
use crate::family::Family;
use crate::model_file::{ModelFileError, inspect};
use crate::survey::{FileUse, survey};
use std::path::Path;

/// A network file that was found.
#[derive(Debug)]
pub struct ModelFile {
    /// Its name.
    pub name: String,
    /// Bytes, without those of weights kept beside it.
    pub bytes: u64,
    /// BLAKE3 of the file, and of the files with its weights; or why it cannot be used.
    pub hash: Result<String, ModelFileError>,
    /// Where it comes from, going by its name.
    pub family: Option<Family>,
    /// What it is for, going by its name.
    pub role: Option<&'static str>,
    /// Which member of the SAM family its inputs and outputs are those of, or CLIP; `None` where of neither.
    pub interface: Option<&'static str>,
    /// What a run makes of it, if no setting names another pair.
    pub usage: FileUse,
}

/// The network files of a folder, by name. Reads all of each.
pub fn models_in(folder: &Path) -> Result<Vec<ModelFile>, VisionError> {
    let files = survey(folder, "")?.files.into_iter();
    let model = |file: crate::survey::SurveyedFile| ModelFile {
        bytes: std::fs::metadata(&file.path).map_or(0, |m| m.len()),
        hash: inspect(&file.path).map(|found| found.hash),
        family: file.family(),
        role: file.role(),
        interface: file.interface(),
        usage: file.usage,
        name: file.name,
    };
    Ok(files.map(model).collect())
}
