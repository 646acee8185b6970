//! Answers that became objects: to write such an object as a selection of the run needs no second answer.

use segwild_pipeline::{Answer, Replay, Selected, Session};
use std::collections::VecDeque;
use std::sync::Arc;

/// Bytes of answers in memory at most.
const MOST_BYTES: usize = 128 << 20;

/// Answers in memory at most.
const MOST_ANSWERS: usize = 16;

/// The answers that were kept last.
#[derive(Default)]
pub(super) struct KeptAnswers(VecDeque<Arc<Answer>>);

impl KeptAnswers {
    /// Adds an answer; those that were kept first make space for it.
    pub fn add(&mut self, answer: Arc<Answer>) {
        self.0.push_back(answer);
        while self.0.len() > MOST_ANSWERS || self.bytes() > MOST_BYTES {
            self.0.pop_front();
        }
    }

    /// The answer to a query, if it selected these splats.
    pub fn find(&self, replay: &Replay, selected: &Selected) -> Option<Arc<Answer>> {
        let fits = |answer: &&Arc<Answer>| answer.replay == *replay && Session::selected(answer) == *selected;
        self.0.iter().rev().find(fits).cloned()
    }

    /// About how many bytes they take in memory.
    pub fn bytes(&self) -> usize {
        self.0.iter().map(|answer| answer.bytes()).sum()
    }

    /// The same with a further answer, unless it is one of them.
    pub fn bytes_with(&self, present: Option<&Arc<Answer>>) -> usize {
        let further = present.filter(|present| !self.0.iter().any(|answer| Arc::ptr_eq(answer, present)));
        self.bytes() + further.map_or(0, |answer| answer.bytes())
    }

    /// Forgets all: what they were made from has changed.
    pub fn clear(&mut self) {
        self.0.clear();
    }
}
