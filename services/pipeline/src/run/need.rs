//! What a stage needs of another one.

use super::stage::Stage;

/// How much of a stage another one needs before it may start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Extent {
    /// That it has started. The other stage waits for the result of each photo when it comes to it.
    PerPhoto,
    /// The part of its result that is there before its end: the skies of the photos that are trained on, or the
    /// snapshot of the training.
    Part,
    /// Its whole result.
    Whole,
}

/// What a stage needs of another one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Need {
    /// The other stage.
    pub stage: Stage,
    /// How much of it.
    pub extent: Extent,
    /// What flows from it; `*` stands for one message per photo. Empty where only the order matters.
    pub what: &'static str,
}
