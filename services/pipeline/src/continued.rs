//! Trainings that go on once a person has put masks of transients right.
//!
//! Under `--continue-share SHARE` a correction does not train the scene from the start: the training goes on from where the one
//! before ended, with the photos as they were put right, for that share of its steps at its last rates. The masks that
//! were proposed for the photos stay. What comes of it is named after the training that it went on from, the corrections
//! and the step it ends at; `transients/continued.json` says which that was, so that the same command finds it again.

use crate::artefacts::{End, Keys};
use crate::keep::present_training;
use crate::transients::Corrections;
use crate::{RunError, RunFolder, Settings};
use segwild_flow::{Cache, Key, Ledger};
use serde::{Deserialize, Serialize};

/// Where the record is in the run folder.
const RECORD: &str = "transients/onward.json";

/// What a training goes on from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Origin {
    /// The training before.
    pub training: Key,
    /// The step it ended at.
    pub step: u32,
    /// The step to end at now.
    pub end: u32,
    /// The scene that masks are proposed in: that of the training without any correction.
    pub snapshot: Key,
}

/// The last training that went on.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Record {
    /// The training of the same settings without any correction.
    root: String,
    /// What was put right.
    corrections: String,
    /// The training before, and the step it ended at.
    from: String,
    step: u32,
    /// Its own name.
    training: String,
}

/// A training that goes on.
pub struct ContinuedTraining {
    /// From where.
    pub origin: Origin,
    /// The names of what comes of it.
    pub keys: Keys,
    record: Record,
}

impl ContinuedTraining {
    /// Finds what the run's training is to go on from; `None` where it begins at the start: because nothing was put right,
    /// or nothing that fits is there any more, or the start was begun from already. `name` names what is made with
    /// corrections by a training that ends somewhere.
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
        let before = folder.read_json::<Record>(RECORD).ok().filter(|r| r.root == root_name);
        let begun = match before {
            Some(before) if before.corrections == corrected => Some((before.from, before.step)),
            before => {
                let fits = |n: &String| *n == root_name || before.is_some_and(|b| b.training == *n);
                let present = present_training(ledger)?.filter(fits);
                let ended = present.map(|n| last_step(ledger, &n).map(|step| (n, step))).transpose()?;
                ended.filter(|(_, step)| *step >= settings.train.steps)
            }
        };
        let Some((from, step)) = begun else { return Ok(None) };
        let Some(training) = Key::parse("geometry", &from) else { return Ok(None) };
        let steps = (share * settings.train.steps as f32).round().max(1.0) as u32;
        let origin = Origin { training, step, end: step.saturating_add(steps), snapshot: root.snapshot };
        let keys = name(corrections, &End::ContinuedTraining(origin.clone()));
        let kept = |key: &Key, step: Option<u32>| -> Result<bool, RunError> {
            let rows = ledger.checkpoints("geometry", key)?;
            Ok(rows.iter().any(|row| step.is_none_or(|step| row.step == u64::from(step))))
        };
        if !(cache.contains(&keys.geometry) || kept(&keys.training, None)? || kept(&training, Some(step))?) {
            return Ok(None);
        }
        let record = Record {
            root: root_name,
            corrections: corrected,
            from,
            step,
            training: keys.training.to_string(),
        };
        Ok(Some(ContinuedTraining { origin, keys, record }))
    }

    /// Writes down what the run's training goes on from.
    pub fn remember(&self, folder: &RunFolder) -> Result<(), RunError> {
        folder.write_json(RECORD, &self.record)
    }
}

/// The last step that a training has a checkpoint of; 0 where it has none.
fn last_step(ledger: &Ledger, training: &str) -> Result<u32, RunError> {
    let Some(key) = Key::parse("geometry", training) else { return Ok(0) };
    let rows = ledger.checkpoints("geometry", &key)?;
    Ok(rows.iter().map(|row| row.step as u32).max().unwrap_or(0))
}
