//! What a cache holds: listed, verified, swept.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::{Cache, CacheError, check};
use crate::files::FileError;

/// An artefact's file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Artefact {
    /// What it is: the key's domain, as its folder has it.
    pub domain: String,
    /// The key's hash in hexadecimal digits.
    pub hash: String,
    /// The file's size in bytes.
    pub bytes: u64,
    /// When it was written.
    pub written: SystemTime,
    path: PathBuf,
}

impl Artefact {
    /// The key as the ledger writes it.
    pub fn key(&self) -> String {
        format!("{}:{}", self.domain, self.hash)
    }
}

/// What was removed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Swept {
    /// Artefacts, and litter of killed writers and damaged files that were moved aside.
    pub files: usize,
    /// Their bytes.
    pub bytes: u64,
}

fn entries(folder: &Path) -> Result<Vec<fs::DirEntry>, FileError> {
    match fs::read_dir(folder).and_then(Iterator::collect) {
        Ok(entries) => Ok(entries),
        Err(e) if matches!(e.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            Ok(Vec::new())
        }
        Err(e) => Err(FileError::new("read", folder, e)),
    }
}

impl Cache {
    /// Every artefact, oldest first.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn list(&self) -> Result<Vec<Artefact>, CacheError> {
        let mut found = Vec::new();
        for domain in entries(&self.root)? {
            let name = domain.file_name().to_string_lossy().into_owned();
            let Some(kind) = name.strip_suffix(".d") else { continue };
            for folder in entries(&domain.path())? {
                for file in entries(&folder.path())? {
                    // Gone meanwhile: another process sweeps.
                    let Ok(data) = file.metadata() else { continue };
                    found.push(Artefact {
                        domain: kind.to_owned(),
                        hash: file.file_name().to_string_lossy().into_owned(),
                        bytes: data.len(),
                        written: data.modified().unwrap_or(SystemTime::UNIX_EPOCH),
                        path: file.path(),
                    });
                }
            }
        }
        found.sort_by(|a, b| (a.written, &a.path).cmp(&(b.written, &b.path)));
        Ok(found)
    }

    /// Reads an artefact and compares its hash; `Some` says what is wrong with it, and it is then moved aside: the
    /// next run makes it again.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn verify(&self, artefact: &Artefact) -> Result<Option<&'static str>, CacheError> {
        let bytes = match crate::codec::read_file(&artefact.path) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(FileError::new("read", &artefact.path, e).into()),
        };
        let wrong = check(&bytes).err();
        if let Some(reason) = wrong {
            self.move_file_aside(&artefact.path, &artefact.key(), reason);
        }
        Ok(wrong)
    }

    /// Removes artefacts that are not to be kept, oldest first, until the cache holds at most `limit` bytes (0: all of
    /// them). `keep` says which must stay whatever the limit. Litter and damaged files that were moved aside go in
    /// any case. With `pretend` nothing is removed, only counted.
    ///
    /// # Errors
    /// When a file cannot be removed.
    pub fn sweep(
        &self,
        limit: u64,
        keep: impl Fn(&Artefact) -> bool,
        pretend: bool,
    ) -> Result<Swept, CacheError> {
        let mut swept = Swept::default();
        let mut remove = |path: &Path, bytes: u64| -> Result<(), FileError> {
            swept.files += 1;
            swept.bytes += bytes;
            match if pretend { Ok(()) } else { fs::remove_file(path) } {
                Err(e) if e.kind() != io::ErrorKind::NotFound => Err(FileError::new("remove", path, e)),
                _ => Ok(()),
            }
        };
        for aside in ["tmp", "corrupt"] {
            for file in entries(&self.root.join(aside))? {
                remove(&file.path(), file.metadata().map_or(0, |m| m.len()))?;
            }
        }
        let all = self.list()?;
        let mut held: u64 = all.iter().map(|a| a.bytes).sum();
        for artefact in &all {
            if held <= limit {
                break;
            }
            if !keep(artefact) {
                remove(&artefact.path, artefact.bytes)?;
                held -= artefact.bytes;
            }
        }
        Ok(swept)
    }
}
