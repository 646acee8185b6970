//! Where the results of a stage are kept: by which key the ledger names them, and what of them is there before a run.

use super::situation::{KeptResults, Situation};
use crate::RunError;
use crate::artifacts::keys::Keys;
use segwild_flow::Key;
use serde::Serialize;

/// What a run would do with a stage.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "verdict")]
pub enum StageVerdict {
    /// The whole result is in the cache.
    Reused,
    /// The results of some photos are in the cache.
    Partly {
        /// Photos whose results would be made.
        made: usize,
        /// Photos in all.
        of: usize,
    },
    /// An interrupted training continues.
    GoesOn {
        /// From this step.
        step: u32,
    },
    /// The training has reached the requested step, and is not over.
    Stands {
        /// At this step.
        step: u32,
    },
    /// The trained scene is there, and its snapshot is not. Masks are proposed from the snapshot, so that the training
    /// is repeated up to it.
    SnapshotAgain {
        /// From the checkpoint at this step; 0 without one.
        from: u32,
        /// To this step.
        to: u32,
    },
    /// The training stops before the snapshot that the stage needs.
    NotReached,
    /// The stage would be computed from the start.
    Made,
}

/// Where the results of a stage are kept.
#[derive(Clone, Copy)]
pub enum StageResults {
    /// In the cache, one for each photo.
    PerPhoto {
        /// Domain of the key that stands for all of them.
        domain: &'static str,
        /// Their keys, by view.
        keys: fn(&Keys) -> &[Key],
        /// Whether held-out photos have one.
        held_out: bool,
        /// Whether those photos alone have one that masks and descriptors are made of.
        described: bool,
        /// Whether they are made from the training's snapshot, which a run that stops early does not reach.
        from_snapshot: bool,
    },
    /// In the cache, under one key.
    Cached(fn(&Keys) -> Key),
    /// In files of the run folder. The ledger has the key that they were made with.
    Files(fn(&Keys) -> Key),
    /// In files that every run writes again.
    Rewritten(fn(&Keys) -> Key),
    /// Where `verdict` finds them.
    Found {
        /// The key of the whole.
        key: fn(&Keys) -> Key,
        /// What a run would do.
        verdict: fn(&Situation, &KeptResults<'_>) -> Result<StageVerdict, RunError>,
    },
}

impl StageResults {
    /// The key of the stage in the ledger.
    pub fn key(&self, keys: &Keys) -> Key {
        match self {
            StageResults::PerPhoto { domain, keys: of, described, .. } => {
                let all = of(keys).iter().enumerate();
                let made = all.filter(|(view, _)| !described || keys.is_described(*view));
                made.fold(Key::of(domain), |key, (_, artefact)| key.key(&artefact.hex(), artefact)).finish()
            }
            StageResults::Cached(key)
            | StageResults::Files(key)
            | StageResults::Rewritten(key)
            | StageResults::Found { key, .. } => key(keys),
        }
    }

    /// What a run would do with the stage named `stage`.
    ///
    /// # Errors
    /// When the ledger cannot be read.
    pub fn verdict(
        &self,
        stage: &str,
        now: &Situation,
        kept: &KeptResults<'_>,
    ) -> Result<StageVerdict, RunError> {
        let made = |there: bool| if there { StageVerdict::Reused } else { StageVerdict::Made };
        Ok(match self {
            StageResults::PerPhoto { from_snapshot: true, .. }
                if now.goal < now.snapshot_step && !kept.cache.contains(&now.keys.snapshot) =>
            {
                StageVerdict::NotReached
            }
            StageResults::PerPhoto { keys, held_out, described, .. } => {
                let (views, keys) = (&now.scene.views, keys(&now.keys));
                let usable = |&i: &usize| {
                    let made = !described || now.keys.is_described(i);
                    made && (*held_out || !views[i].test) && now.keys.unreadable(i).is_none()
                };
                let usable: Vec<usize> = (0..views.len()).filter(usable).collect();
                match usable.iter().filter(|&&i| !kept.cache.contains(&keys[i])).count() {
                    0 => StageVerdict::Reused,
                    all if all == usable.len() => StageVerdict::Made,
                    some => StageVerdict::Partly { made: some, of: usable.len() },
                }
            }
            StageResults::Cached(key) => made(kept.cache.contains(&key(&now.keys))),
            StageResults::Files(key) => made(match kept.ledger {
                Some(ledger) => ledger.stage_is_done(stage, &key(&now.keys))?,
                None => false,
            }),
            StageResults::Rewritten(_) => StageVerdict::Made,
            StageResults::Found { verdict, .. } => verdict(now, kept)?,
        })
    }
}
