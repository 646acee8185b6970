//! How long a scene stands still after the worker that had it failed.

use segwild_farm::{ChangeKind, JobChange};
use segwild_flow::clock;
use std::collections::BTreeMap;

/// Workers that failed, or were cut off, at a moment.
#[derive(Clone, Debug)]
pub(super) struct Strike {
    /// Seconds since 1970.
    pub at: f64,
    /// Their names.
    pub workers: Vec<String>,
}

impl Strike {
    /// One of this moment.
    pub fn now(workers: Vec<String>) -> Strike {
        Strike { at: clock::now(), workers }
    }
}

/// For each scene that a struck worker had and did not end itself: the time from the strike until a worker took it again, in
/// seconds. `changes` are those of the farm, in order; its server has the clock of this machine.
pub(super) fn recoveries(changes: &[JobChange], strikes: &[Strike]) -> Vec<f64> {
    let mut found = Vec::new();
    for strike in strikes {
        let (before, after): (Vec<_>, Vec<_>) = changes.iter().partition(|change| change.time <= strike.at);
        let mut holders = BTreeMap::<&str, &str>::new();
        for change in before {
            match change.kind {
                ChangeKind::Claimed => drop(holders.insert(&change.job, &change.detail)),
                ChangeKind::Published | ChangeKind::Waits | ChangeKind::Began => {}
                _ => drop(holders.remove(&*change.job)),
            }
        }
        for (job, _) in holders.into_iter().filter(|(_, holder)| strike.workers.iter().any(|w| w == holder)) {
            let ends = |kind| !matches!(kind, ChangeKind::Published | ChangeKind::Waits | ChangeKind::Began);
            let of_it = || after.iter().filter(move |change| change.job == job);
            if of_it().find(|change| ends(change.kind)).is_some_and(|c| c.kind == ChangeKind::Completed) {
                continue;
            }
            let again = of_it().find(|change| change.kind == ChangeKind::Claimed);
            found.extend(again.map(|change| change.time - strike.at));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recovery_lasts_from_the_failure_until_a_worker_takes_the_scene_again() {
        let change = |time: f64, job: &str, kind: ChangeKind, detail: &str| JobChange {
            revision: 1,
            time,
            job: job.into(),
            kind,
            attempt: 1,
            detail: detail.into(),
        };
        let changes = [
            change(1.0, "a", ChangeKind::Claimed, "first"),
            change(1.0, "b", ChangeKind::Claimed, "second"),
            change(1.5, "a", ChangeKind::Waits, "no memory"),
            change(2.0, "c", ChangeKind::Claimed, "first"),
            change(2.5, "c", ChangeKind::Completed, "{}"),
            change(62.0, "a", ChangeKind::Expired, "first fell silent"),
            change(62.0, "a", ChangeKind::Retried, "first fell silent"),
            change(63.0, "b", ChangeKind::Completed, "{}"),
            change(67.0, "a", ChangeKind::Claimed, "second"),
            change(80.0, "a", ChangeKind::Completed, "{}"),
        ];
        let strike = |at: f64, worker: &str| Strike { at, workers: vec![worker.into()] };
        // `c` was done before, `b` is another worker's.
        assert_eq!(recoveries(&changes, &[strike(3.0, "first")]), [64.0]);
        // What a worker ends itself was not interrupted, and what it lost before is not its own.
        assert!(recoveries(&changes, &[strike(3.0, "second"), strike(70.0, "first")]).is_empty());
        assert_eq!(recoveries(&changes, &[strike(2.25, "first"), strike(68.0, "second")]), [64.75]);
    }
}
