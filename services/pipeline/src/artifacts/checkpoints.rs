//! The checkpoints from which an interrupted training continues.

use super::folder::CHECKPOINT;
use crate::{RunError, RunFolder};
use segwild_flow::codec::StreamedRecord;
use segwild_flow::files::FileError;
use segwild_flow::ledger::CheckpointRow;
use segwild_flow::{Events, Key, Ledger, codec, fault};
use segwild_trainer::Checkpoint;
use std::path::PathBuf;

/// Keeps the checkpoints of one training, files in the run folder and their digests in the ledger.
pub struct Keeper<'a> {
    /// The run.
    pub folder: &'a RunFolder,
    /// Its ledger.
    pub ledger: &'a Ledger,
    /// Receives a warning for each checkpoint that is passed over.
    pub events: &'a Events,
    /// The training that they belong to.
    pub key: &'a Key,
    /// How many are kept: the last one, and earlier ones to fall back on.
    pub kept: usize,
}

impl Keeper<'_> {
    /// Writes a checkpoint and removes those that are too old.
    pub fn save(&self, checkpoint: &Checkpoint) -> Result<(), RunError> {
        fault::point("checkpoint.save")
            .map_err(|e| FileError::new("write", &self.folder.checkpoints(), e))?;
        let name = format!("{}{:08}.bin", self.prefix(), checkpoint.step());
        let path = self.folder.checkpoints().join(&name);
        // A checkpoint of millions of splats has gigabytes: it is not held beside the training.
        let record = StreamedRecord::of(CHECKPOINT, checkpoint)
            .map_err(|source| RunError::Record { path: path.clone(), source })?;
        let digest = record.write_file(&path)?;
        self.ledger.record_checkpoint(&CheckpointRow {
            stage: "geometry".into(),
            key: self.key.to_string(),
            step: checkpoint.step().into(),
            file: name,
            digest: blake3::Hash::from_bytes(digest).to_hex().to_string(),
        })?;
        for old in self.ledger.checkpoints("geometry", self.key)?.into_iter().skip(self.kept.max(1)) {
            // The file may be gone already.
            let _ = self.folder.checkpoint(&old).map(std::fs::remove_file);
            self.ledger.forget_checkpoint(&old)?;
        }
        Ok(())
    }

    /// The checkpoints of this training, newest first. Files without a row, as after the ledger was lost, get one: the
    /// file name holds the key of the training, and the record's own check sum shows whether it is whole.
    pub fn rows(&self) -> Result<Vec<CheckpointRow>, RunError> {
        let known = self.ledger.checkpoints("geometry", self.key)?;
        let prefix = self.prefix();
        let mut found = false;
        for entry in std::fs::read_dir(self.folder.checkpoints()).into_iter().flatten().flatten() {
            let file = entry.file_name().to_string_lossy().into_owned();
            let step = file.strip_prefix(&prefix).and_then(|rest| rest.strip_suffix(".bin"));
            let Some(step) = step.and_then(|step| step.parse::<u32>().ok()) else { continue };
            if known.iter().any(|row| row.file == file) {
                continue;
            }
            let Ok(bytes) = codec::read_file(&entry.path()) else { continue };
            self.ledger.record_checkpoint(&CheckpointRow::new(
                "geometry",
                self.key,
                step.into(),
                &file,
                &bytes,
            ))?;
            let message =
                format!("checkpoint {file} was found in the folder, and not in the ledger: it is used");
            self.events.info(Some("geometry"), message);
            found = true;
        }
        Ok(if found { self.ledger.checkpoints("geometry", self.key)? } else { known })
    }

    /// Start of the names of this training's checkpoints. Trainings with other settings keep theirs in the same folder.
    fn prefix(&self) -> String {
        format!("geometry-{}-", &self.key.hex()[..8])
    }

    /// The last checkpoint before step `before` that reads back whole; damaged ones are named and passed over.
    pub fn last_before(&self, before: u32) -> Result<Option<Checkpoint>, RunError> {
        let mut damaged: Vec<(PathBuf, String)> = Vec::new();
        let mut last = None;
        for row in self.rows()? {
            let Some(path) = self.folder.checkpoint(&row) else {
                // This program did not write it: it is not read, and above all not removed.
                self.ledger.forget_checkpoint(&row)?;
                damaged.push((row.file.into(), "the ledger names a file elsewhere".to_owned()));
                continue;
            };
            let read = codec::read_file(&path).map_err(|e| e.to_string()).and_then(|bytes| {
                if !row.fits(&bytes) {
                    return Err("its content has changed".into());
                }
                codec::decode::<Checkpoint>(CHECKPOINT, &bytes).map_err(|e| e.to_string())
            });
            match read {
                Ok(checkpoint) if checkpoint.step() < before => {
                    last = Some(checkpoint);
                    break;
                }
                Ok(_) => {}
                Err(reason) => {
                    // It may be gone already, and it is of no use.
                    let _ = std::fs::remove_file(&path);
                    self.ledger.forget_checkpoint(&row)?;
                    damaged.push((path, reason));
                }
            }
        }
        let instead = match last {
            Some(_) => "the one before it is used",
            None => "there is none before it: the training starts again from step 0",
        };
        for (path, reason) in damaged {
            let message = format!("checkpoint {} is passed over ({reason}): {instead}", path.display());
            self.events.warn(Some("geometry"), message);
        }
        Ok(last)
    }
}
