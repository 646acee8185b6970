//! An answer that grows: earlier answers are published while more photos are queried.

use serde::Serialize;

/// How far an answer to prompts has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum AnswerStep {
    /// The scene tree answered; no photo was queried.
    Tree,
    /// The masks of the prompted photos decide.
    Prompted,
    /// So many other photos were queried.
    Photos(usize),
    /// The last one: all photos were queried and spikes are cut. How sure it is is not known yet.
    Selected,
}

/// Follows a selection while it is made.
pub trait AnswerSteps: Sync {
    /// Receives an earlier answer: whether each splat belongs to the object, before spikes are cut.
    fn publish(&self, step: AnswerStep, labels: Vec<bool>);
    /// Whether nobody waits for the selection any more. It ends with [`SegmentError::Cancelled`](crate::SegmentError::Cancelled)
    /// before the next photo is queried.
    fn cancelled(&self) -> bool;
}

/// Photos after which an earlier answer is published, and after which the photos are selected again.
pub(crate) const PUBLISHED_AFTER: usize = 8;
