//! Where an interrupted training goes on from.

use crate::{RunError, RunFolder};
use segwild_flow::files::FileError;
use segwild_flow::ledger::CheckpointRow;
use segwild_flow::{Events, Key, Ledger, codec, fault, files};
use segwild_trainer::Checkpoint;

/// Kind of the records.
const CHECKPOINT: &str = "checkpoint";

/// Keeps the checkpoints of one training, files in the run folder and their digests in the ledger.
pub struct Keeper<'a> {
    /// The run.
    pub folder: &'a RunFolder,
    /// Its ledger.
    pub ledger: &'a Ledger,
    /// Told of checkpoints that are passed over.
    pub events: &'a Events,
    /// The training that they belong to.
    pub key: &'a Key,
    /// How many are kept: the last, and those to fall back on.
    pub kept: usize,
}

impl Keeper<'_> {
    /// Writes a checkpoint and removes those that are too old.
    pub fn save(&self, checkpoint: &Checkpoint) -> Result<(), RunError> {
        fault::point("checkpoint.save")
            .map_err(|e| FileError::new("write", &self.folder.checkpoints(), e))?;
        // Trainings under other settings have checkpoints here, too.
        let name = format!("geometry-{}-{:08}.bin", &self.key.hex()[..8], checkpoint.step());
        let path = self.folder.checkpoints().join(&name);
        let bytes = codec::encode(CHECKPOINT, checkpoint)
            .map_err(|source| RunError::Record { path: path.clone(), source })?;
        files::write_atomic(&path, &bytes)?;
        self.ledger.record_checkpoint(&CheckpointRow {
            stage: "geometry".into(),
            key: self.key.to_string(),
            step: checkpoint.step().into(),
            file: name,
            digest: blake3::hash(&bytes).to_hex().to_string(),
        })?;
        for old in self.ledger.checkpoints("geometry", self.key)?.into_iter().skip(self.kept.max(1)) {
            // A file that is gone already is what was wanted.
            let _ = std::fs::remove_file(self.folder.checkpoints().join(&old.file));
            self.ledger.forget_checkpoint(&old)?;
        }
        Ok(())
    }

    /// The last checkpoint before step `before` that reads back whole; damaged ones are named and passed over.
    pub fn last_before(&self, before: u32) -> Result<Option<Checkpoint>, RunError> {
        for row in self.ledger.checkpoints("geometry", self.key)? {
            let path = self.folder.checkpoints().join(&row.file);
            let read = std::fs::read(&path).map_err(|e| e.to_string()).and_then(|bytes| {
                if blake3::hash(&bytes).to_hex().as_str() != row.digest {
                    return Err("its content has changed".into());
                }
                codec::decode::<Checkpoint>(CHECKPOINT, &bytes).map_err(|e| e.to_string())
            });
            match read {
                Ok(checkpoint) if checkpoint.step() < before => return Ok(Some(checkpoint)),
                Ok(_) => {}
                Err(reason) => {
                    let message = format!(
                        "checkpoint {} is passed over, the one before it serves: {reason}",
                        path.display()
                    );
                    self.events.warn(Some("geometry"), message);
                    // It may be gone already, and it is of no use.
                    let _ = std::fs::remove_file(&path);
                    self.ledger.forget_checkpoint(&row)?;
                }
            }
        }
        Ok(None)
    }
}
