//! The name of an artefact.

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use segwild_flow::FileError;
use segwild_scene::hash_file;
use serde::{Deserialize, Serialize};

/// The BLAKE3 of an artefact's bytes. As text it has 64 hexadecimal digits, small letters alone: it becomes part of a name
/// in a store, and one artefact has one name.
///
/// ```
/// use segwild_farm::ArtefactDigest;
/// let digest = ArtefactDigest::of(b"splats");
/// assert_eq!(digest.to_string().parse(), Ok(digest));
/// for text in ["", "../../etc/passwd", &digest.to_string()[1..], &digest.to_string().to_uppercase()] {
///     assert!(text.parse::<ArtefactDigest>().is_err(), "{text}");
/// }
/// ```
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct ArtefactDigest([u8; 32]);

/// Text that is no digest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("it is no digest: that has 64 hexadecimal digits, with small letters")]
pub struct DigestError;

impl ArtefactDigest {
    /// The digest of bytes.
    pub fn of(bytes: &[u8]) -> Self {
        Self(*blake3::hash(bytes).as_bytes())
    }

    /// The digest of a file and its length in bytes; the file is read in pieces.
    ///
    /// # Errors
    /// When it cannot be read, or is a pipe or a device.
    pub fn of_file(path: &Path) -> Result<(Self, u64), FileError> {
        let mut hasher = blake3::Hasher::new();
        hash_file(&mut hasher, path).map_err(|e| FileError::new("read", path, e))?;
        Ok((Self::finish(&hasher), hasher.count()))
    }

    /// The digest of what was hashed.
    pub(super) fn finish(hasher: &blake3::Hasher) -> Self {
        Self(*hasher.finalize().as_bytes())
    }

    /// Its bytes.
    pub fn bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl fmt::Display for ArtefactDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&blake3::Hash::from_bytes(self.0).to_hex())
    }
}

impl fmt::Debug for ArtefactDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

impl FromStr for ArtefactDigest {
    type Err = DigestError;

    fn from_str(text: &str) -> Result<Self, DigestError> {
        if text.bytes().any(|b| b.is_ascii_uppercase()) {
            return Err(DigestError);
        }
        blake3::Hash::from_hex(text).map(|hash| Self(*hash.as_bytes())).map_err(|_| DigestError)
    }
}

impl TryFrom<String> for ArtefactDigest {
    type Error = DigestError;

    fn try_from(text: String) -> Result<Self, DigestError> {
        text.parse()
    }
}

impl From<ArtefactDigest> for String {
    fn from(digest: ArtefactDigest) -> String {
        digest.to_string()
    }
}
