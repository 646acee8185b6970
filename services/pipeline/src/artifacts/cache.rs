//! The content of a run's cache: listing, verifying, removing what is unused.

use crate::artifacts::keys::history_of;
use crate::artifacts::region_cache::REGIONS;
use crate::{RunError, RunFolder};
use segwild_flow::ledger::CheckpointRow;
use segwild_flow::{Artefact, Cache, Ledger, LedgerError, Swept};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Name under which the ledger records the present training and its snapshot, beside the stages.
pub(crate) const SNAPSHOT: &str = "snapshot";
/// Name under which the ledger records the keys of the transient network's masks.
pub(crate) const TRANSIENTS: &str = "transients";
/// The training's row there.
pub(crate) const TRAINING: &str = "training";
/// Domain of the embeddings of the scene tree's groups. They count as used by the run, since texts read them.
pub(crate) const DESCRIBED: &str = "described";

/// One kind of artefact in a run's cache.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct CacheLine {
    /// The kind: `sky`, `embedding`, `masks`, ..
    pub kind: String,
    /// Artefacts.
    pub files: usize,
    /// Their bytes.
    pub bytes: u64,
    /// How many of them the run uses as it stands; the others were made under other settings.
    pub used: usize,
    /// Bytes of those used.
    pub used_bytes: u64,
}

/// Whether the run uses an artefact as it stands. Regions of photos and embeddings of groups always count as used: clicks and texts
/// read them.
fn in_use(ledger: &Ledger) -> Result<impl Fn(&Artefact) -> bool + use<>, LedgerError> {
    let keys = keys_in_use(ledger)?;
    let of_queries = |domain: &str| domain == REGIONS || domain == DESCRIBED;
    Ok(move |artefact: &Artefact| of_queries(&artefact.domain) || keys.contains(&artefact.key()))
}

/// The artefacts that the run uses as it stands, as the ledger writes their keys.
fn keys_in_use(ledger: &Ledger) -> Result<BTreeSet<String>, LedgerError> {
    let mut keys = BTreeSet::new();
    keys.extend(ledger.views("visibility")?.into_iter().map(|view| view.key));
    keys.extend(ledger.views(TRANSIENTS)?.into_iter().map(|view| view.key));
    keys.extend(ledger.views(SNAPSHOT)?.into_iter().map(|view| view.key));
    for stage in ledger.stages()? {
        for view in ledger.views(&stage.name)? {
            keys.insert(view.key);
        }
        if stage.name == "geometry" {
            keys.insert(history_of(&stage.key).to_string());
        }
        keys.insert(stage.key);
    }
    Ok(keys)
}

/// Key of the run's present training, whichever step the last command was to stop at.
pub(crate) fn present_training(ledger: &Ledger) -> Result<Option<String>, LedgerError> {
    if let Some(row) = ledger.views(SNAPSHOT)?.into_iter().find(|row| row.view == TRAINING) {
        return Ok(Some(row.key));
    }
    // Earlier versions recorded no training, and trained no further than the steps of the settings.
    Ok(ledger.stages()?.into_iter().find(|stage| stage.name == "geometry").map(|stage| stage.key))
}

/// What a run's cache holds, by kind. Works while another process uses the run.
pub fn cache_list(folder: &RunFolder) -> Result<Vec<CacheLine>, RunError> {
    let used = in_use(&Ledger::open_read_only(folder.ledger())?)?;
    let mut lines: BTreeMap<String, CacheLine> = BTreeMap::new();
    for artefact in folder.cache()?.list()? {
        let line = lines.entry(artefact.domain.clone()).or_default();
        line.kind.clone_from(&artefact.domain);
        line.files += 1;
        line.bytes += artefact.bytes;
        if used(&artefact) {
            line.used += 1;
            line.used_bytes += artefact.bytes;
        }
    }
    Ok(lines.into_values().collect())
}

/// Reads every artefact and compares its hash. Damaged ones are moved aside, and the next run makes them again;
/// `on_damage` is called for each with the reason. Returns how many artefacts were read.
///
/// # Errors
/// When the cache cannot be read.
pub fn cache_verify(
    folder: &RunFolder,
    mut on_damage: impl FnMut(&Artefact, &str),
) -> Result<usize, RunError> {
    let cache = folder.cache()?;
    let all = cache.list()?;
    for artefact in &all {
        if let Some(reason) = cache.verify(artefact)? {
            on_damage(artefact, reason);
        }
    }
    Ok(all.len())
}

/// Removes what the run does not use, until the cache holds at most `limit` bytes (0: all of it). Refuses while
/// another process uses the run.
pub fn cache_gc(folder: &RunFolder, limit: u64, pretend: bool) -> Result<Swept, RunError> {
    let ledger = Ledger::open(folder.ledger())?;
    let mut swept = sweep(&ledger, &folder.cache()?, limit, pretend)?;
    // Checkpoints of trainings under other settings than the present ones.
    let present = present_training(&ledger)?;
    let other = |c: &CheckpointRow| Some(&c.key) != present.as_ref();
    for old in ledger.all_checkpoints("geometry")?.into_iter().filter(other) {
        let path = folder.checkpoint(&old);
        swept.files += usize::from(path.is_some());
        swept.bytes += path.as_ref().and_then(|path| std::fs::metadata(path).ok()).map_or(0, |m| m.len());
        if !pretend {
            // The file may be gone already; a path outside of the folder is never removed.
            let _ = path.map(std::fs::remove_file);
            ledger.forget_checkpoint(&old)?;
        }
    }
    Ok(swept)
}

/// As [`cache_gc`], by the process that holds the run.
pub(crate) fn sweep(ledger: &Ledger, cache: &Cache, limit: u64, pretend: bool) -> Result<Swept, RunError> {
    Ok(cache.sweep(limit, in_use(ledger)?, pretend)?)
}
