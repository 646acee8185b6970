//! A copy of a ledger, taken while its process writes it.

use std::path::Path;

use rusqlite::Connection;

use super::schema::LIVE_TABLES;
use super::{Ledger, LedgerError};

/// What only the process that writes a run knows of itself: its number, its memory, what its workers do now.
const OF_THE_PROCESS: &str =
    "DELETE FROM live; DELETE FROM actors; DELETE FROM workers; DELETE FROM mailboxes;";

impl Ledger {
    /// Writes the ledger as it is at one moment into a new file, in which everything committed so far is merged: no log
    /// beside it is needed. Whoever writes the run goes on meanwhile. The copy holds no lock and no traces of the
    /// process: who opens it for writing is its owner, and a stage that was running is continued.
    ///
    /// # Errors
    /// When the ledger cannot be read, or there is a file of that name, or it cannot be written.
    pub fn copy_to(&self, path: &Path) -> Result<(), LedgerError> {
        let name = path.to_string_lossy();
        self.read(|c| c.execute("VACUUM INTO ?1", [&name]))?;
        let clear = || {
            let copy = Connection::open(path)?;
            copy.execute_batch(LIVE_TABLES)?;
            copy.execute_batch(OF_THE_PROCESS)?;
            copy.close().map_err(|(_, error)| error)
        };
        clear().map_err(|e| LedgerError::sqlite(path, e))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use crate::ledger::{CheckpointRow, State};

    #[test]
    fn a_copy_has_what_was_committed_and_no_owner() {
        let dir = tempfile::tempdir().unwrap();
        let (path, copied) = (dir.path().join("a/run.sqlite"), dir.path().join("b.sqlite"));
        let key = Key::of("geometry").value("steps", 10).finish();
        let ledger = Ledger::open(&path).unwrap();
        ledger.start_stage("geometry", &key).unwrap();
        let row = CheckpointRow::new("geometry", &key, 5, "five.bin", b"five");
        ledger.record_checkpoint(&row).unwrap();
        Ledger::open_read_only(&path).unwrap().copy_to(&copied).unwrap();
        // What comes later is not in it.
        ledger.finish_stage("geometry", &key, None).unwrap();
        assert!(ledger.copy_to(&copied).is_err(), "a file is there");

        let copy = Ledger::open_read_only(&copied).unwrap();
        assert_eq!(copy.stages().unwrap()[0].state, State::Running);
        assert_eq!(copy.checkpoints("geometry", &key).unwrap(), [row]);
        assert!(copy.owner().is_none() && copy.live().unwrap().is_none());
        drop(copy);
        let copy = Ledger::open(&copied).unwrap();
        assert_eq!(copy.stages().unwrap()[0].state, State::Pending);
    }
}
