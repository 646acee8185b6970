//! A folder as a list of files. Manifests come from elsewhere: nothing in one is believed.

use std::collections::HashSet;

use segwild_flow::files::name::{is_plain, one_line};
use serde::{Deserialize, Serialize};

use super::digest::ArtefactDigest;

/// Version of the format.
const FORMAT: u32 = 1;
/// Longest path in a manifest, in bytes.
const LONGEST_PATH: usize = 1024;
/// Longest part of a path, in bytes: file systems take no more.
const LONGEST_PART: usize = 255;

/// The most that a folder may have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FolderLimits {
    /// Files.
    pub files: usize,
    /// Their bytes in all.
    pub bytes: u64,
    /// Bytes of the manifest.
    pub manifest_bytes: u64,
    /// Folders in each other.
    pub depth: usize,
}

impl Default for FolderLimits {
    /// More than any scene has, and less than fills a large disk.
    fn default() -> Self {
        Self { files: 200_000, bytes: 1 << 40, manifest_bytes: 64 << 20, depth: 32 }
    }
}

/// Why a manifest is refused.
#[derive(Debug, thiserror::Error)]
pub enum FolderManifestError {
    /// Its text is too long.
    #[error("its manifest has more than {0} bytes")]
    Long(u64),
    /// Its text is no manifest.
    #[error("its manifest cannot be read: {0}")]
    Text(#[source] serde_json::Error),
    /// It is of another version.
    #[error("it has format {0}, and this program knows format {FORMAT}")]
    Format(u32),
    /// It has too many files.
    #[error("it has {found} files, more than {most}")]
    Files {
        /// How many.
        found: usize,
        /// How many it may have.
        most: usize,
    },
    /// Its files are too large.
    #[error("its files have {found} bytes, more than {most}")]
    Bytes {
        /// How many.
        found: u64,
        /// How many they may have.
        most: u64,
    },
    /// A path is unfit.
    #[error("the path `{path}` {reason}")]
    Path {
        /// As it is safe to show.
        path: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A path is not after the one before it.
    #[error("`{0}` is there twice, or out of order")]
    Order(String),
    /// A file is where a folder would have to be.
    #[error("`{0}` lies in a file")]
    InFile(String),
}

/// A file of a folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FolderEntry {
    /// Its path in the folder, with `/`.
    pub path: String,
    /// Its artefact.
    pub digest: ArtefactDigest,
    /// Its length in bytes.
    pub bytes: u64,
}

/// The files of a folder, sorted by path. The same files make the same bytes of JSON, and so the same digest.
///
/// ```
/// use segwild_farm::{ArtefactDigest, FolderEntry, FolderLimits, FolderManifest};
/// let entry = |path: &str| FolderEntry { path: path.into(), digest: ArtefactDigest::of(b"x"), bytes: 1 };
/// let manifest = FolderManifest::new(vec![entry("sparse/0/images.bin"), entry("a.jpg")]);
/// assert_eq!(FolderManifest::parse(&manifest.to_json(), &FolderLimits::default())?, manifest);
/// let evil = FolderManifest::new(vec![entry("../../.ssh/authorized_keys")]);
/// assert!(FolderManifest::parse(&evil.to_json(), &FolderLimits::default()).is_err());
/// # Ok::<(), segwild_farm::FolderManifestError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FolderManifest {
    format: u32,
    files: Vec<FolderEntry>,
}

impl FolderManifest {
    /// The manifest of files in any order.
    pub fn new(mut files: Vec<FolderEntry>) -> Self {
        files.sort_by(|a, b| a.path.cmp(&b.path));
        Self { format: FORMAT, files }
    }

    /// The files, by path.
    pub fn files(&self) -> &[FolderEntry] {
        &self.files
    }

    /// Its text.
    pub fn to_json(&self) -> Vec<u8> {
        // Text and numbers alone always have a text.
        serde_json::to_vec(self).unwrap_or_default()
    }

    /// A manifest from its text.
    ///
    /// # Errors
    /// What is wrong with it: another format, a path that leads out of the folder, two files of one name, beyond the limits.
    pub fn parse(json: &[u8], limits: &FolderLimits) -> Result<Self, FolderManifestError> {
        if json.len() as u64 > limits.manifest_bytes {
            return Err(FolderManifestError::Long(limits.manifest_bytes));
        }
        let manifest: Self = serde_json::from_slice(json).map_err(FolderManifestError::Text)?;
        manifest.check(limits)?;
        Ok(manifest)
    }

    /// Whether all paths are fit and it is within the limits.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn check(&self, limits: &FolderLimits) -> Result<(), FolderManifestError> {
        if self.format != FORMAT {
            return Err(FolderManifestError::Format(self.format));
        }
        if self.files.len() > limits.files {
            return Err(FolderManifestError::Files { found: self.files.len(), most: limits.files });
        }
        let mut bytes = 0u64;
        for file in &self.files {
            fit(&file.path, limits.depth)
                .map_err(|reason| FolderManifestError::Path { path: shown(&file.path), reason })?;
            bytes = bytes.saturating_add(file.bytes);
        }
        if bytes > limits.bytes {
            return Err(FolderManifestError::Bytes { found: bytes, most: limits.bytes });
        }
        if let Some(pair) = self.files.windows(2).find(|pair| pair[0].path >= pair[1].path) {
            return Err(FolderManifestError::Order(shown(&pair[1].path)));
        }
        let paths: HashSet<&str> = self.files.iter().map(|file| file.path.as_str()).collect();
        let folders = |path: &str| path.match_indices('/').any(|(at, _)| paths.contains(&path[..at]));
        match self.files.iter().find(|file| folders(&file.path)) {
            Some(file) => Err(FolderManifestError::InFile(shown(&file.path))),
            None => Ok(()),
        }
    }
}

/// A path as it is safe to show.
fn shown(path: &str) -> String {
    one_line(&path.chars().take(120).collect::<String>()).into_owned()
}

/// Whether a path names a file in a folder, on every system.
///
/// # Errors
/// What is wrong with it, to be put after the path.
pub(super) fn fit(path: &str, depth: usize) -> Result<(), &'static str> {
    if path.len() > LONGEST_PATH || path.split('/').any(|part| part.len() > LONGEST_PART) {
        return Err("is too long");
    }
    if path.split('/').count() > depth {
        return Err("lies too deep");
    }
    if path.chars().any(char::is_control) || path.contains('\\') || !path.split('/').all(is_plain) {
        return Err("names no file inside of the folder");
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(path: &str) -> FolderEntry {
        FolderEntry { path: path.into(), digest: ArtefactDigest::of(path.as_bytes()), bytes: 10 }
    }

    fn refusal(files: &[&str]) -> String {
        let manifest = FolderManifest::new(files.iter().map(|path| entry(path)).collect());
        FolderManifest::parse(&manifest.to_json(), &FolderLimits::default()).unwrap_err().to_string()
    }

    #[test]
    fn paths_that_leave_the_folder_are_refused() {
        let long = "n".repeat(256);
        let deep = "a/".repeat(40) + "b";
        for path in [
            "",
            "/etc/passwd",
            "..",
            "../x",
            "a/../../x",
            "a/./x",
            "./x",
            "a//x",
            "a/",
            "a\\..\\x",
            "nul\0",
            "line\nend",
            &long,
            &deep,
        ] {
            assert!(refusal(&[path]).contains("the path"), "{path}");
        }
    }

    #[test]
    fn a_file_that_is_there_twice_and_a_file_in_a_file_are_refused() {
        assert!(refusal(&["a", "a"]).contains("twice"));
        assert!(refusal(&["a", "a-b", "a/b"]).contains("lies in a file"));
    }

    #[test]
    fn the_limits_hold() {
        let manifest = FolderManifest::new((0..5).map(|i| entry(&i.to_string())).collect());
        let refused = |limits| manifest.check(&limits).unwrap_err().to_string();
        let limits = FolderLimits::default();
        assert!(refused(FolderLimits { files: 4, ..limits }).contains("5 files"));
        assert!(refused(FolderLimits { bytes: 49, ..limits }).contains("50 bytes"));
        let two = FolderManifest::new(vec![
            FolderEntry { bytes: u64::MAX, ..entry("a") },
            FolderEntry { bytes: 2, ..entry("b") },
        ]);
        assert!(two.check(&limits).is_err(), "the sum must not wrap");
        let json = manifest.to_json();
        assert!(FolderManifest::parse(&json, &FolderLimits { manifest_bytes: 9, ..limits }).is_err());
    }

    #[test]
    fn other_formats_fields_and_digests_are_refused() {
        for json in [
            r#"{"format":2,"files":[]}"#,
            r#"{"format":1,"files":[],"links":[]}"#,
            r#"{"format":1,"files":[{"path":"a","digest":"../../x","bytes":1}]}"#,
            r#"{"format":1,"files":[{"path":"a","bytes":1}]}"#,
            "[",
        ] {
            assert!(FolderManifest::parse(json.as_bytes(), &FolderLimits::default()).is_err(), "{json}");
        }
    }
}
