//! Files piece by piece, hashed on the way.

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use segwild_flow::FileError;
use segwild_flow::files::{open_plain, write_with};

use super::digest::ArtefactDigest;
use super::error::ArtefactError;

/// A file that is sent.
pub(super) struct Outgoing {
    path: PathBuf,
    file: File,
    digest: ArtefactDigest,
    hasher: blake3::Hasher,
}

impl Outgoing {
    pub fn open(digest: &ArtefactDigest, path: &Path) -> Result<Self, ArtefactError> {
        let file = open_plain(path).map_err(|e| FileError::new("read", path, e))?;
        Ok(Self { path: path.to_owned(), file, digest: *digest, hasher: blake3::Hasher::new() })
    }

    /// Its length in bytes, as it is now.
    pub fn length(&self) -> Result<u64, ArtefactError> {
        Ok(self.file.metadata().map_err(|e| FileError::new("read", &self.path, e))?.len())
    }

    /// The next piece; one that is shorter than `most` bytes is the last.
    pub fn piece(&mut self, most: usize) -> Result<Vec<u8>, ArtefactError> {
        let mut piece = Vec::new();
        let read = (&mut self.file).take(most as u64).read_to_end(&mut piece);
        read.map_err(|e| FileError::new("read", &self.path, e))?;
        self.hasher.update(&piece);
        Ok(piece)
    }

    /// Whether all that was read is the artefact.
    pub fn check(&self) -> Result<(), ArtefactError> {
        if ArtefactDigest::finish(&self.hasher) == self.digest {
            return Ok(());
        }
        Err(ArtefactError::Changed { path: self.path.clone(), digest: self.digest })
    }
}

/// Writes the pieces of an artefact into a file, which appears only if they are the artefact.
pub(super) fn receive<P: AsRef<[u8]>>(
    store: &str,
    digest: &ArtefactDigest,
    to: &Path,
    mut next: impl FnMut() -> Option<Result<P, ArtefactError>>,
) -> Result<(), ArtefactError> {
    write_with(to, |file| {
        let mut hasher = blake3::Hasher::new();
        while let Some(piece) = next() {
            let piece = piece?;
            hasher.update(piece.as_ref());
            file.write_all(piece.as_ref()).map_err(|e| FileError::new("write", to, e))?;
        }
        let found = ArtefactDigest::finish(&hasher);
        if found == *digest {
            return Ok(());
        }
        Err(ArtefactError::Damaged { store: store.to_owned(), digest: *digest, found })
    })
}
