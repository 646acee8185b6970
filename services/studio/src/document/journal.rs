//! `studio/session.jsonl` of a run: every operation, one JSON object per line.
//!
//! The file is only appended to. A kill may cut the last line short; it is then removed before the next one is written.

use super::Document;
use super::operation::JournalEntry;
use segwild_flow::{FileError, files};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Bytes of a journal at most.
const MOST_BYTES: u64 = 256 << 20;

/// Version of the format.
const VERSION: u32 = 1;

/// Why a journal cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// It cannot be read or written.
    #[error(transparent)]
    File(#[from] FileError),
    /// Another process has it open.
    #[error("{0}: another `segwild serve` works on this run; open its page, or end it")]
    Busy(PathBuf),
    /// A later version of segwild wrote it.
    #[error("{path}: it has version {found}, this segwild reads {VERSION}: use a newer one")]
    Version {
        /// The file.
        path: PathBuf,
        /// Its version.
        found: u32,
    },
}

/// The first line of a journal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JournalStart {
    /// Version of the format.
    pub segwild_session: u32,
    /// Key of the training whose splats the selections are of; empty where no ledger names it.
    pub scene: String,
}

/// A journal that is being written.
pub struct Journal {
    path: PathBuf,
    file: File,
    /// Whether a part of a line may lie at the end: the next one then begins with a newline.
    torn: bool,
}

impl Journal {
    /// Opens a journal, or makes one, and reads back what it holds. A journal of another training is put aside, as
    /// `session-N.jsonl`; what it held is returned, for its prompts can be answered again.
    ///
    /// # Errors
    /// When it cannot be read or written, another process has it open, or a later version wrote it.
    pub fn open(path: &Path, scene: &str) -> Result<OpenedJournal, JournalError> {
        let file = lock(path)?;
        let bytes = files::read_within(path, MOST_BYTES).map_err(|e| FileError::new("read", path, e))?;
        let (start, document, skipped, whole) = replay(&bytes);
        if let Some(start) = start.as_ref().filter(|start| start.segwild_session > VERSION) {
            let found = start.segwild_session;
            return Err(JournalError::Version { path: path.to_owned(), found });
        }
        let known = start.is_some_and(|start| start.scene == scene);
        if known {
            if whole < bytes.len() {
                file.set_len(whole as u64).map_err(|e| FileError::new("write", path, e))?;
            }
            let journal = Journal { path: path.to_owned(), file, torn: false };
            return Ok(OpenedJournal { journal, document, skipped, earlier: None });
        }
        let earlier = match bytes.is_empty() {
            true => None,
            false => {
                put_aside(path)?;
                Some(document)
            }
        };
        let file = if earlier.is_some() { lock(path)? } else { file };
        let mut journal = Journal { path: path.to_owned(), file, torn: false };
        journal.line(&JournalStart { segwild_session: VERSION, scene: scene.to_owned() })?;
        Ok(OpenedJournal { journal, document: Document::default(), skipped: 0, earlier })
    }

    /// Appends an entry.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn append(&mut self, entry: &JournalEntry) -> Result<(), FileError> {
        self.line(entry)
    }

    fn line(&mut self, value: &impl Serialize) -> Result<(), FileError> {
        let failed = |e| FileError::new("write", &self.path, e);
        let mut line = serde_json::to_vec(value).map_err(|e| failed(e.into()))?;
        line.push(b'\n');
        if self.torn {
            line.insert(0, b'\n');
        }
        let length = self.file.metadata().map_err(failed)?.len();
        if length.saturating_add(line.len() as u64) > MOST_BYTES {
            // A larger one would not be read again.
            let why = format!(
                "it is full: a session has {} MiB at most. To go on, export its objects, end `segwild serve`, rename \
                 the file, and serve the run again: it starts without objects",
                MOST_BYTES >> 20
            );
            return Err(failed(std::io::Error::new(std::io::ErrorKind::FileTooLarge, why)));
        }
        let written = self.file.write_all(&line).and_then(|()| self.file.sync_data());
        if written.is_ok() {
            self.torn = false;
        } else {
            // What there is of it would be glued to the next one, and both be lost.
            self.torn |= self.file.set_len(length).is_err();
        }
        written.map_err(failed)
    }
}

/// A journal with what it held.
pub struct OpenedJournal {
    /// The journal.
    pub journal: Journal,
    /// The document after all its operations.
    pub document: Document,
    /// Lines that are no operation or did not fit.
    pub skipped: usize,
    /// The document of an earlier training, whose selections fit no more.
    pub earlier: Option<Document>,
}

fn lock(path: &Path) -> Result<File, JournalError> {
    let file = files::open_to_append(path)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => Err(JournalError::Busy(path.to_owned())),
        Err(std::fs::TryLockError::Error(e)) => Err(FileError::new("lock", path, e).into()),
    }
}

/// Renames a journal to the first free `session-N.jsonl`.
fn put_aside(path: &Path) -> Result<(), FileError> {
    let free = (1..).map(|n| path.with_file_name(format!("session-{n}.jsonl"))).find(|name| !name.exists());
    let target = free.expect("some number is free");
    std::fs::rename(path, &target).map_err(|e| FileError::new("rename", path, e))
}

/// Reads a journal: its first line, the document, the number of lines that are skipped, and the bytes of all whole lines.
fn replay(bytes: &[u8]) -> (Option<JournalStart>, Document, usize, usize) {
    let whole = bytes.iter().rposition(|b| *b == b'\n').map_or(0, |at| at + 1);
    let mut lines = bytes[..whole].split(|b| *b == b'\n').filter(|line| !line.is_empty());
    let start = lines.next().and_then(|line| serde_json::from_slice(line).ok());
    let (mut document, mut skipped) = (Document::default(), 0);
    for line in lines {
        let entered =
            serde_json::from_slice::<JournalEntry>(line).is_ok_and(|entry| document.enter(&entry).is_ok());
        skipped += usize::from(!entered);
    }
    (start, document, skipped, whole)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::document::Operation;

    #[test]
    fn an_entry_after_one_that_failed_is_not_lost() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("session.jsonl");
        let mut journal = Journal::open(&path, "scene").unwrap().journal;
        let entry = JournalEntry::Apply(Operation::CutSpikes { cut: true });
        // A handle that can neither write nor shorten the file.
        let able = std::mem::replace(&mut journal.file, File::open(&path).unwrap());
        assert!(journal.append(&entry).is_err());
        journal.file = able;
        // As if a part of it had been written.
        journal.file.write_all(b"{\"app").unwrap();
        journal.append(&entry).unwrap();
        drop(journal);
        let opened = Journal::open(&path, "scene").unwrap();
        assert_eq!((opened.skipped, opened.document.undo_label()), (1, Some("spike cut")));
    }
}
