//! `seams.json`: how well the photos are shown at the seams of a scene that was trained by blocks.

use super::cache::present_training;
use crate::{RunError, RunFolder};
use segwild_flow::{Key, Ledger};
use segwild_trainer::SeamCheck;
use serde::{Deserialize, Serialize};

/// The file in the run folder.
const RECORD: &str = "seams.json";

/// The comparison with the training that it is of: one with other settings may have followed in the same folder.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct SeamRecord {
    training: String,
    #[serde(flatten)]
    check: SeamCheck,
}

/// Writes the comparison of a training.
///
/// # Errors
/// When it cannot be written.
pub(crate) fn write(folder: &RunFolder, training: &Key, check: &SeamCheck) -> Result<(), RunError> {
    folder.write_json(RECORD, &SeamRecord { training: training.to_string(), check: check.clone() })
}

/// The comparison of the run's present training; `None` where that was trained as a whole, or is not over.
pub(crate) fn of(folder: &RunFolder) -> Option<SeamCheck> {
    let record = folder.read_json::<SeamRecord>(RECORD).ok()?;
    let ledger = Ledger::open_read_only(folder.ledger()).ok()?;
    let present = present_training(&ledger).ok()??;
    (present == record.training).then_some(record.check)
}
