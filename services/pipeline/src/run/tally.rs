//! What a run counts: photos made, cached, given up and left out.

use super::stage::Stage;
use segwild_flow::{ActorFailure, Quarantined};
use segwild_scene::Skipped;
use std::collections::BTreeMap;

/// The counts of a run.
#[derive(Default)]
pub struct Tally {
    /// Photos that are left out of a stage, and why.
    pub skipped: Vec<Skipped>,
    /// Per-photo artefacts that were made.
    pub made: usize,
    /// Per-photo artefacts that were in the cache.
    pub cached: usize,
    /// A stage that failed, and why.
    pub failed: Option<(Stage, ActorFailure)>,
    /// Per stage, how many photos were given up, and the first one with its error.
    failures: BTreeMap<Stage, (usize, String)>,
}

impl Tally {
    /// Counts a photo that a stage has given up.
    pub fn give_up(&mut self, stage: Stage, photo: &str, error: &Quarantined) {
        let first = || (0, format!("{photo}: {}", error.error));
        self.failures.entry(stage).or_insert_with(first).0 += 1;
    }

    /// Adds a photo that is left out, unless it is known. Returns whether it was added.
    pub fn skip(&mut self, skipped: Skipped) -> bool {
        let known = self.skipped.iter().any(|known| known.name == skipped.name);
        if !known {
            self.skipped.push(skipped);
        }
        !known
    }

    /// Fails a stage, unless one has failed before.
    pub fn fail(&mut self, stage: Stage, failure: ActorFailure) {
        self.failed.get_or_insert((stage, failure));
    }

    /// Fails a stage that has given up all of its photos: the photos are hardly the cause. Returns a warning where it
    /// has given up more than half of them.
    pub fn weigh(&mut self, stage: Stage, photos: usize) -> Option<String> {
        let (failed, first) = self.failures.get(&stage).cloned()?;
        if failed == photos {
            let reason = format!("not one of {photos} photos could be done ({stage}); the first: {first}");
            self.fail(stage.listed(), ActorFailure::fatal(reason));
            return None;
        }
        let warning =
            || format!("{failed} of {photos} photos could not be done ({stage}); the first: {first}");
        (failed * 2 > photos).then(warning)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn given_up(error: &str) -> Quarantined {
        Quarantined { label: String::new(), error: error.into(), attempts: 3 }
    }

    #[test]
    fn a_stage_without_a_photo_left_fails_and_half_of_them_are_a_warning() {
        let mut tally = Tally::default();
        assert_eq!(tally.weigh(Stage::Visibility, 3), None);
        tally.give_up(Stage::Visibility, "a", &given_up("odd"));
        assert_eq!(tally.weigh(Stage::Visibility, 3), None);
        tally.give_up(Stage::Visibility, "b", &given_up("odder"));
        let warning = tally.weigh(Stage::Visibility, 3).expect("most of them");
        assert_eq!(warning, "2 of 3 photos could not be done (visibility); the first: a: odd");
        tally.give_up(Stage::Visibility, "c", &given_up("oddest"));
        assert_eq!(tally.weigh(Stage::Visibility, 3), None);
        let (stage, failure) = tally.failed.expect("none is left");
        assert_eq!(stage, Stage::Features);
        assert!(failure.to_string().starts_with("not one of 3 photos"), "{failure}");
    }
}
