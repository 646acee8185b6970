//! Continued training: after a person has corrected masks of transients, the training goes on from where it ended.
//!
//! With `--continue-share SHARE` a correction does not train the scene from step 0. The training continues from the
//! last step of the training before, with the corrected photos, for that share of its steps and at its last learning
//! rates. The proposed masks of the photos stay. Its key depends on the training before, the corrections and the step
//! it ends at. `transients/continued.json` records the training before, so that the same command finds it again.

use crate::artifacts::cache::present_training;
use crate::artifacts::keys::{End, Keys, TrainingOrigin};
use crate::transients::Corrections;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::{Cache, Key, Ledger};
use serde::{Deserialize, Serialize};

/// The file of the record in the run folder.
const RECORD: &str = "transients/continued.json";

/// The record of the last continued training.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct ContinuedRecord {
    /// Key of the training with the same settings and without corrections.
    root: String,
    /// Hash of the corrections.
    corrections: String,
    /// Key of the training before, and the step it ended at.
    from: String,
    step: u32,
    /// Key of the continued training itself.
    training: String,
}

/// A continued training.
pub struct ContinuedTraining {
    /// The training before.
    pub origin: TrainingOrigin,
    /// The keys of this training and of what depends on it.
    pub keys: Keys,
    record: ContinuedRecord,
}

impl ContinuedTraining {
    /// Finds the training that the run is to continue. Returns `None` where the run trains from step 0: no mask was
    /// corrected, no training that fits is left, or a training from step 0 with these corrections is there already.
    /// `name` computes the keys of a run with given corrections and end.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn find(
        folder: &RunFolder,
        ledger: &Ledger,
        cache: &Cache,
        settings: &Settings,
        corrections: &Corrections,
        name: &dyn Fn(&Corrections, &End) -> Keys,
    ) -> Result<Option<ContinuedTraining>, RunError> {
        let share = settings.run.continue_share;
        let Some(corrected) = corrections.digest_of_all().filter(|_| share > 0.0) else { return Ok(None) };
        let root = name(&Corrections::default(), &End::Settings);
        let from_the_start = name(corrections, &End::Settings).geometry;
        if cache.contains(&from_the_start) || !cache.contains(&root.snapshot) {
            return Ok(None);
        }
        let root_name = root.training.to_string();
        let before = folder.read_json::<ContinuedRecord>(RECORD).ok().filter(|r| r.root == root_name);
        let start = match before {
            Some(before) if before.corrections == corrected => Some((before.from, before.step)),
            before => {
                let fits = |n: &String| *n == root_name || before.is_some_and(|b| b.training == *n);
                let present = present_training(ledger)?.filter(fits);
                let ended = present.map(|n| last_step(ledger, &n).map(|step| (n, step))).transpose()?;
                ended.filter(|(_, step)| *step >= settings.train.steps)
            }
        };
        let Some((from, step)) = start else { return Ok(None) };
        let Some(training) = Key::parse("geometry", &from) else { return Ok(None) };
        let steps = (share * settings.train.steps as f32).round().max(1.0) as u32;
        let origin =
            TrainingOrigin { training, step, end: step.saturating_add(steps), snapshot: root.snapshot };
        let keys = name(corrections, &End::ContinuedTraining(origin.clone()));
        let kept = |key: &Key, step: Option<u32>| -> Result<bool, RunError> {
            let rows = ledger.checkpoints("geometry", key)?;
            Ok(rows.iter().any(|row| step.is_none_or(|step| row.step == u64::from(step))))
        };
        if !(cache.contains(&keys.geometry) || kept(&keys.training, None)? || kept(&training, Some(step))?) {
            return Ok(None);
        }
        let record = ContinuedRecord {
            root: root_name,
            corrections: corrected,
            from,
            step,
            training: keys.training.to_string(),
        };
        Ok(Some(ContinuedTraining { origin, keys, record }))
    }

    /// Records which training the run continues.
    pub fn remember(&self, folder: &RunFolder) -> Result<(), RunError> {
        folder.write_json(RECORD, &self.record)
    }
}

/// The step of a training's last checkpoint; 0 where it has none.
fn last_step(ledger: &Ledger, training: &str) -> Result<u32, RunError> {
    let Some(key) = Key::parse("geometry", training) else { return Ok(0) };
    let rows = ledger.checkpoints("geometry", &key)?;
    Ok(rows.iter().map(|row| row.step as u32).max().unwrap_or(0))
}
