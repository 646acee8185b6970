//! One query of a run: a selection without a session that stays.

use super::resident::{Session, SessionOptions};
use super::save::SegmentOutcome;
use crate::artifacts::prompts::check_all;
use crate::{Replay, RunError, RunFolder};
use segwild_flow::Stopper;
use segwild_segmenter::{FirstAnswer, SegmentError, SegmentSettings};
use segwild_vision::Providers;

/// Opens a session for one query, and saves its last answer as the selection `name`. Without `providers` it uses those of
/// [`crate::providers_for`], with the networks that the environment names.
///
/// # Errors
/// When the name or the prompts cannot be used, nothing is selected, the setting `alternative` is beyond what the prompts may select,
/// a file cannot be written, or `stopper` stops it.
pub fn segment(
    folder: &RunFolder,
    name: &str,
    replay: &Replay,
    settings: &SegmentSettings,
    providers: Option<&Providers>,
    stopper: &Stopper,
) -> Result<SegmentOutcome, RunError> {
    RunFolder::can_name(name)?;
    check_all(&replay.prompts)?;
    let tree = settings.first_answer == FirstAnswer::Tree || replay.needs_tree();
    let providers = providers.cloned();
    let session = Session::open(
        folder,
        SessionOptions { providers, tree, stopper: stopper.clone(), ..SessionOptions::default() },
    )?;
    // Before anything is computed.
    session.files.fit(&folder.selection(name))?;
    let answer = session.ask(replay, settings, stopper)?.wait(|_, _| ())?;
    // A session on a page takes the last instead: a further click may leave fewer.
    let (requested, offered) = (settings.alternative, answer.segmented.alternatives.len());
    if requested as usize >= offered.max(1) {
        return Err(SegmentError::NoAlternative { requested, offered }.into());
    }
    session.save_watched(name, &answer, stopper, &|_, _| ())
}
