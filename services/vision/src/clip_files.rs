//! The files of a CLIP model in a folder: its encoders, its tokenizer, and how it wants images.

use std::path::{Path, PathBuf};

/// The files of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct ClipFiles {
    /// The stem of its files' names; empty for names without one.
    pub stem: String,
    /// The image encoder.
    pub images: PathBuf,
    /// The text encoder; the same file where one has both.
    pub texts: PathBuf,
    pub tokenizer: TokenizerFiles,
    /// `preprocessor_config.json`, if it is there.
    pub scaling: Option<PathBuf>,
}

/// The files of a tokenizer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum TokenizerFiles {
    /// `tokenizer.json`.
    Whole(PathBuf),
    /// `vocab.json` and `merges.txt`.
    Parts { vocabulary: PathBuf, merges: PathBuf },
}

/// The name of the file that says how images are scaled.
const SCALING: &str = "preprocessor_config.json";

/// The usual name of a tokenizer's file, for messages.
pub(crate) const TOKENIZER: &str = "tokenizer.json";

/// A file of a folder, under the stem of a model or without one.
fn beside(folder: &Path, stem: &str, name: &str) -> Option<PathBuf> {
    let named = ['_', '.', '-'].map(|joint| format!("{stem}{joint}{name}"));
    let named = named.into_iter().filter(|_| !stem.is_empty());
    named.chain([name.to_owned()]).map(|name| folder.join(name)).find(|path| path.is_file())
}

/// The tokenizer of the model with this stem; `None` where there is none, or half of one.
pub(crate) fn tokenizer_of(folder: &Path, stem: &str) -> Option<TokenizerFiles> {
    if let Some(whole) = beside(folder, stem, TOKENIZER) {
        return Some(TokenizerFiles::Whole(whole));
    }
    let (vocabulary, merges) = (beside(folder, stem, "vocab.json")?, beside(folder, stem, "merges.txt")?);
    Some(TokenizerFiles::Parts { vocabulary, merges })
}

/// How the model with this stem wants images.
pub(crate) fn scaling_of(folder: &Path, stem: &str) -> Option<PathBuf> {
    beside(folder, stem, SCALING)
}

impl ClipFiles {
    /// How images are scaled, if the file may be another model's: its name is of none.
    pub fn bare_scaling(&self) -> Option<&Path> {
        self.scaling.as_deref().filter(|file| file.file_name().is_some_and(|name| name == SCALING))
    }
}
