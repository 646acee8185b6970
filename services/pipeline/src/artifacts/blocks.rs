//! `blocks.json`: in how many blocks the scene is trained, where the memory budget decides that.

use crate::{RunError, RunFolder};
use serde::{Deserialize, Serialize};

/// The file in the run folder.
const RECORD: &str = "blocks.json";
/// Most blocks that the setting allows: a number beyond comes from elsewhere.
const MOST: usize = 64;

/// What was decided for the training in the run folder.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
struct DecidedBlocks {
    blocks: usize,
}

/// Records the number that was decided.
///
/// # Errors
/// When it cannot be written.
pub(crate) fn write(folder: &RunFolder, blocks: usize) -> Result<(), RunError> {
    folder.write_json(RECORD, &DecidedBlocks { blocks })
}

/// The number that was decided for what the run has trained so far; `None` where nothing is trained yet, or no number
/// was decided.
pub(crate) fn of(folder: &RunFolder) -> Option<usize> {
    let holds = std::fs::read_dir(folder.checkpoints()).is_ok_and(|mut entries| entries.next().is_some());
    let trained = holds || folder.path().join("model.bin").is_file();
    let DecidedBlocks { blocks } = folder.read_json(RECORD).ok()?;
    (trained && (1..=MOST).contains(&blocks)).then_some(blocks)
}
